"""
Samples hyperparameters for ``-optimize``, and converts a trial's parameters to constructor arguments.

By default only the size and noise of the search are tuned; other settings of the hyperparameter file are
held. ``SB3_MCBS_TUNE=strategies`` also tunes the strategy, ``SB3_MCBS_TUNE=schedules`` the schedule and
value expansion, ``SB3_MCBS_TUNE=all`` what RL Zoo tunes of the algorithm without search. Trials have no
``preset``, since it would change settings that are not sampled.
"""

import os
from types import SimpleNamespace
from typing import Any

import optuna

from sb3_mcbs.agents.hyperparameters import MOVED, REMOVED, SETTINGS
from sb3_mcbs.agents.schedule import SCHEDULES, UNITS, ScheduleSettings
from sb3_mcbs.agents.value_expansion import ValueExpansionSettings
from sb3_mcbs.search import SearchSettings
from sb3_mcbs.search.settings import present_name

SWITCH = "SB3_MCBS_TUNE"
SCOPES = ("search", "strategies", "schedules", "all")

BEAM_WIDTHS = (3, 6, 12, 18)
ROLLOUT_DEPTHS = (0, 1, 2, 3, 4, 6)
N_SIMULATIONS = (1, 3, 5, 10)
BEAM_NOISE = (0.01, 0.5)
STRATEGIES = ("beam", "tree", "cem")
PROPOSAL_FACTORS = (1, 4, 8)
BRANCHING = (2, 3, 5)
N_ROUNDS = (2, 3, 4)
NOISE_HOLD = (1, 2, 3)
PROPOSAL_DIMS = (None, 1, 2, 3)
SEARCH_SHARES = (0.25, 0.5, 1.0)
#: Fractions of ``search_share``.
FINAL_SEARCH_SHARES = (0.0, 0.2, 0.5)
VALUE_EXPANSION = (0, 1, 2, 4)

#: Simulated steps per decision; with more, a trial would take days.
MAX_SIMULATED_STEPS = 600

#: Parameters of trials that are not settings themselves.
_HELPERS = ("proposal_factor", "noise_free_rollouts", "final_share_factor")

_NO_PRESET: dict[str, Any] = {"preset": None}

#: The user attribute of a trial with the hyperparameter file's settings of the search.
HELD = "held_settings"
#: Limits are kept from the file when the scope "strategies" samples the rest of ``search_kwargs``.
#: The last belongs to the cross-entropy method only.
_LIMITS = ("noise_clip", "time_budget", "max_beam_width", "min_noise")
#: Keys of ``schedule_kwargs`` that the scope "schedules" replaces.
_ENDS = ("final_search_share", "final_beam_width", "final_rollout_depth")
#: Parameters of trials that are not keywords.
_STORED = (*_HELPERS, *MOVED, *REMOVED)


def tuning_scope() -> str:
    """
    :return: the value of the environment variable ``SB3_MCBS_TUNE``, one of ``SCOPES``
    :raises ValueError: for any other value
    """
    scope = os.environ.get(SWITCH) or "search"
    if scope not in SCOPES:
        raise ValueError(f"{SWITCH} must be one of {', '.join(SCOPES)}, got {scope!r}.")
    return scope


def sample_mcbs_params(
    base: str, trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    Sampler for the hyperparameters of an agent that searches.

    :param base: RL Zoo's name of the algorithm without search
    :param trial: Optuna's trial
    :param n_actions: number of action dimensions, for the noise of TD3 and DDPG
    :param n_envs: number of training environments
    :param additional_args: arguments of RL Zoo's samplers
    :return: constructor arguments
    :raises optuna.TrialPruned: for conflicting settings, or too many simulated steps
    """
    scope = tuning_scope()
    held = trial.user_attrs.get(HELD, {})
    sampled: dict[str, Any] = {
        "beam_width": trial.suggest_categorical("beam_width", BEAM_WIDTHS),
        "rollout_depth": trial.suggest_categorical("rollout_depth", ROLLOUT_DEPTHS),
        "beam_noise": trial.suggest_float("beam_noise", *BEAM_NOISE, log=True),
    }
    rollout_noise = (held.get("search_kwargs") or {}).get("rollout_noise")
    simulations_differ = held.get("strategy", "beam") == "beam" and rollout_noise != 0
    if scope == "strategies" or simulations_differ:
        sampled["n_simulations"] = trial.suggest_categorical("n_simulations", N_SIMULATIONS)
    if scope == "strategies":
        sampled |= _sample_strategy(trial)
    if scope == "schedules":
        sampled |= _sample_schedule(trial)
    params = with_limits(_search_settings(sampled), held)
    reason = _why_senseless({**held, **params}, sampled, n_actions)
    if reason is not None:
        trial.set_user_attr("pruned", reason)
        raise optuna.TrialPruned(f"{reason}: {params}")
    if scope == "all":
        params.update(_sample_base(base, trial, n_actions, n_envs, additional_args))
    return {**params, **_NO_PRESET}


def _sample_base(base: str, trial: optuna.Trial, *arguments: Any) -> dict[str, Any]:
    """Sample what RL Zoo tunes of the algorithm without search."""
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER, convert_offpolicy_params

    if base != "crossq":
        return HYPERPARAMS_SAMPLER[base](trial, *arguments)
    # RL Zoo has no sampler for CrossQ: as its one for SAC, without target networks and HER.
    return convert_offpolicy_params(
        {
            "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.0001, 0.03, log=True),
            "learning_rate": trial.suggest_float("learning_rate", 1e-5, 0.002, log=True),
            "batch_size_pow": trial.suggest_int("batch_size_pow", 2, 11),
            "train_freq": trial.suggest_int("train_freq", 1, 10),
            "net_arch": trial.suggest_categorical("net_arch", ["small", "medium", "big"]),
        }
    )


def _sample_strategy(trial: optuna.Trial) -> dict[str, Any]:
    """Sample the strategy, by the trial's parameter names."""
    strategy = trial.suggest_categorical("strategy", STRATEGIES)
    sampled: dict[str, Any] = {
        "strategy": strategy,
        "antithetic": trial.suggest_categorical("antithetic", (False, True)),
        "proposal_factor": trial.suggest_categorical("proposal_factor", PROPOSAL_FACTORS),
        "noise_hold": trial.suggest_categorical("noise_hold", NOISE_HOLD),
        "proposal_dims": trial.suggest_categorical("proposal_dims", PROPOSAL_DIMS),
    }
    if strategy == "beam":
        for name in ("noise_free_rollouts", "include_policy_action"):
            sampled[name] = trial.suggest_categorical(name, (False, True))
    elif strategy == "tree":
        sampled["branching"] = trial.suggest_categorical("branching", BRANCHING)
    else:
        sampled["n_rounds"] = trial.suggest_categorical("n_rounds", N_ROUNDS)
    return sampled


def _sample_schedule(trial: optuna.Trial) -> dict[str, Any]:
    """Sample the schedule and value expansion, by the trial's parameter names."""
    sampled: dict[str, Any] = {
        "search_schedule": trial.suggest_categorical("search_schedule", SCHEDULES),
        "search_share": trial.suggest_categorical("search_share", SEARCH_SHARES),
        "search_unit": trial.suggest_categorical("search_unit", UNITS),
        "value_expansion": trial.suggest_categorical("value_expansion", VALUE_EXPANSION),
    }
    if sampled["search_schedule"] != "constant":
        sampled["final_share_factor"] = trial.suggest_categorical("final_share_factor", FINAL_SEARCH_SHARES)
    return sampled


def _search_settings(sampled: dict[str, Any]) -> dict[str, Any]:
    """Convert a trial's parameters of the search to constructor arguments."""
    settings = {name: value for name, value in sampled.items() if name not in _STORED}
    kwargs = {name: value for name, value in sampled.items() if MOVED.get(name) == "search_kwargs"}
    if sampled.get("noise_free_rollouts"):
        kwargs["rollout_noise"] = 0.0
    if settings.get("strategy", "beam") != "beam":
        settings["n_simulations"] = 1  # more are only needed for random dynamics
    if sampled.get("proposal_factor", 1) > 1:
        n_kept = settings["beam_width"] * kwargs.get("branching", 1)
        kwargs["n_proposals"] = sampled["proposal_factor"] * n_kept
    if settings.get("value_expansion") == 0:
        settings["branch_length"] = 0  # the file's would not go with it
    if "strategy" in sampled:
        settings["strategy"] = present_name(sampled["strategy"])
        settings["search_kwargs"] = kwargs
    if "search_schedule" in sampled:
        settings["schedule_kwargs"] = {}
    if "final_share_factor" in sampled:
        share = sampled["final_share_factor"] * settings["search_share"]
        settings["schedule_kwargs"] = {"final_search_share": share}
    return settings


def with_limits(params: dict[str, Any], held: dict[str, Any]) -> dict[str, Any]:
    """
    Keep keys of the file's dictionaries that trials do not sample, since a trial's dictionaries replace them.

    :param params: constructor arguments
    :param held: the hyperparameter file's settings of the search
    :return: the arguments with the held limits
    """
    kwargs, ends = held.get("search_kwargs") or {}, held.get("schedule_kwargs") or {}
    params = dict(params)
    if "search_kwargs" in params:
        limits = _LIMITS if params["strategy"] == "cem" else _LIMITS[:-1]
        kept = {name: value for name, value in kwargs.items() if name in limits}
        params["search_kwargs"] = {**kept, **params["search_kwargs"]}
    if "schedule_kwargs" in params:
        kept = {name: value for name, value in ends.items() if name not in _ENDS}
        params["schedule_kwargs"] = {**kept, **params["schedule_kwargs"]}
    return params


def _why_senseless(params: dict[str, Any], sampled: dict[str, Any], n_actions: int) -> str | None:
    drawn = sampled.get("n_simulations", 1)
    kwargs = params.get("search_kwargs") or {}
    if params["rollout_depth"] == 0 and drawn > 1:
        return "nothing is simulated at rollout_depth 0, so n_simulations above 1 repeats another trial"
    if drawn > 1 and (params["n_simulations"] == 1 or kwargs.get("rollout_noise") == 0):
        return "n_simulations above 1 needs a beam with noise in its rollouts, else it repeats another trial"
    if (kwargs.get("proposal_dims") or 0) >= n_actions:
        return f"proposal_dims of {n_actions} or more repeats another trial: actions have no more directions"
    if params.get("strategy", "beam") != "beam" and (
        kwargs.get("time_budget") or kwargs.get("max_beam_width")
    ):
        return "time_budget works with strategy='beam' only"
    agent = SimpleNamespace(**{**SETTINGS, **params})
    try:
        settings = SearchSettings.of(agent)
        ScheduleSettings.of(agent).check_search(settings)
        expansion = ValueExpansionSettings.of(agent)
        expansion.check_search(settings)
        expansion.check_buffer(params.get("optimize_memory_usage", False))
    except ValueError as error:
        return str(error)
    if settings.simulated_steps(deterministic=False) > MAX_SIMULATED_STEPS:
        return f"a decision would simulate more than {MAX_SIMULATED_STEPS} steps"
    return None


def convert_mcbs_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    Convert a trial's stored parameters back to constructor arguments.

    :param sampled_params: ``trial.params``
    :return: constructor arguments, as the sampler returned them
    """
    search_names = {*_STORED, *SETTINGS}
    search = _search_settings({name: v for name, v in sampled_params.items() if name in search_names})
    search |= _NO_PRESET
    others = {name: value for name, value in sampled_params.items() if name not in search_names}
    if not others:
        return search
    from rl_zoo3.hyperparams_opt import convert_offpolicy_params

    others = convert_offpolicy_params(others)
    if others.get("noise_type", "") is None:
        # The trial then used the file's noise: RL Zoo's sampler returns no noise for None.
        del others["noise_type"]
        others.pop("noise_std", None)
    return {**others, **search}
