"""
What ``-optimize`` draws for ``mcbs_td3``, and how a trial's parameters become constructor arguments.

By default only the search is tuned and the TD3 settings of the hyperparameter file are held, so that trials
differ in one thing. ``SB3_MCBS_TUNE=all`` tunes RL Zoo's TD3 parameters as well.
"""

import os
from typing import Any

import optuna

SWITCH = "SB3_MCBS_TUNE"
SCOPES = ("search", "all")

BEAM_WIDTHS = (3, 6, 12, 18)
ROLLOUT_DEPTHS = (0, 1, 2, 3, 4, 6)
N_SIMULATIONS = (1, 3, 5, 10)
BEAM_NOISE = (0.01, 0.5)

#: A trial whose decisions cost more simulated steps than this would take days.
MAX_SIMULATED_STEPS = 600

#: The combinations that are pruned before anything is built: a test on the parameters, and the reason.
INVALID_COMBINATIONS = (
    (
        lambda p: p["rollout_depth"] == 0 and p["n_simulations"] > 1,
        "nothing is simulated at rollout_depth 0, so n_simulations above 1 repeats another trial",
    ),
    (
        lambda p: p["beam_width"] * p["rollout_depth"] * p["n_simulations"] > MAX_SIMULATED_STEPS,
        f"beam_width * rollout_depth * n_simulations is above {MAX_SIMULATED_STEPS}",
    ),
)


def tuning_scope() -> str:
    """
    :return: ``search`` or ``all``, as the environment variable ``SB3_MCBS_TUNE`` says
    :raises ValueError: if it says anything else
    """
    scope = os.environ.get(SWITCH) or "search"
    if scope not in SCOPES:
        raise ValueError(f"{SWITCH} must be one of {', '.join(SCOPES)}, got {scope!r}.")
    return scope


def sample_mcbs_td3_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    Sampler for MCBSTD3 hyperparameters.

    :param trial: Optuna's trial
    :param n_actions: number of entries of an action, for TD3's noise
    :param n_envs: number of training environments
    :param additional_args: what RL Zoo's samplers need to know of the replay buffer
    :return: constructor arguments
    :raises optuna.TrialPruned: for a combination in ``INVALID_COMBINATIONS``
    """
    params: dict[str, Any] = {
        "beam_width": trial.suggest_categorical("beam_width", BEAM_WIDTHS),
        "rollout_depth": trial.suggest_categorical("rollout_depth", ROLLOUT_DEPTHS),
        "n_simulations": trial.suggest_categorical("n_simulations", N_SIMULATIONS),
        "beam_noise": trial.suggest_float("beam_noise", *BEAM_NOISE, log=True),
    }
    for is_invalid, reason in INVALID_COMBINATIONS:
        if is_invalid(params):
            trial.set_user_attr("pruned", reason)
            raise optuna.TrialPruned(f"{reason}: {params}")
    if tuning_scope() == "all":
        from rl_zoo3.hyperparams_opt import sample_td3_params

        params.update(sample_td3_params(trial, n_actions, n_envs, additional_args))
    return params


def convert_mcbs_td3_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    Turn the parameters that a trial stored back into constructor arguments.

    :param sampled_params: ``trial.params``
    :return: constructor arguments, as the sampler returned them
    """
    search_names = ("beam_width", "rollout_depth", "n_simulations", "beam_noise")
    search = {name: value for name, value in sampled_params.items() if name in search_names}
    td3 = {name: value for name, value in sampled_params.items() if name not in search_names}
    if not td3:
        return search
    from rl_zoo3.hyperparams_opt import convert_offpolicy_params

    td3 = convert_offpolicy_params(td3)
    if td3.get("noise_type", "") is None:
        # The trial ran with the file's noise then: RL Zoo's sampler gives no noise for None.
        del td3["noise_type"]
        td3.pop("noise_std", None)
    return {**td3, **search}
