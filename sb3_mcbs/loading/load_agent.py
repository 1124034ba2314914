"""Loads an agent from a file of an untrusted author."""

import functools
import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

from sb3_mcbs.agents.hyperparameters import MOVED, group_flat
from sb3_mcbs.agents.learned_model import EnsembleSettings
from sb3_mcbs.agents.mcbs import MCBS
from sb3_mcbs.agents.registry import ALGORITHMS
from sb3_mcbs.loading.agent_file import AgentFile, is_pickled, read_agent_file
from sb3_mcbs.loading.architecture import Architecture, check_spaces, read_architecture
from sb3_mcbs.loading.archive import AgentFileError, about
from sb3_mcbs.loading.network_settings import is_number, network_settings
from sb3_mcbs.networks.functions import STOCHASTIC
from sb3_mcbs.search import SearchSettings, make_settings
from sb3_mcbs.search.settings import KEYWORDS

logger = logging.getLogger("sb3_mcbs")


def load_agent(
    path: str | Path,
    env: GymEnv | str,
    algo: str | None = None,
    policy_kwargs: dict[str, Any] | None = None,
    device: th.device | str = "auto",
) -> OffPolicyAlgorithm:
    """
    Load an agent from an SB3 model file without running code from the file, to act (not to train).

    SB3's ``load`` opens the pickles in the file, which can run any code. This function reads only tensors and
    a few checked numbers: it infers the networks' sizes and the algorithm from the tensors, and takes the
    spaces from ``env``. The agent can ``predict`` and be given to :class:`~sb3_mcbs.SearchPolicy`; it has
    neither optimisers nor a replay buffer, so ``learn``, ``train`` and ``save`` raise an error.

    The agent's attribute ``not_taken_over`` lists what was not taken over, a dictionary of reasons by the
    name of the entry or member. It is also logged (``sb3_mcbs``), as a warning if it may change how the agent
    acts.

    :param path: the file, as ``save`` of TD3, DDPG, SAC, TQC, CrossQ or one of their MCBS agents wrote it,
        with an ``MlpPolicy``
    :param env: the environment to act in; its spaces must be those of the training
    :param algo: ``"td3"``, ``"ddpg"``, ``"sac"``, ``"tqc"``, ``"crossq"``, or one of these after
        ``"mcbs_"``; by default it is inferred from the file
    :param policy_kwargs: those of the training, for files that hold no readable copy of them. Only those are
        needed that cannot be inferred from tensors: ``activation_fn``, with gSDE ``clip_mean`` and
        ``use_expln``, of CrossQ ``batch_norm_eps``.
    :param device: device on which the networks run
    :return: the agent, ready to act
    :raises FileNotFoundError: if there is no such file
    :raises AgentFileError: if the file is damaged, too large, of another kind or not for this environment
    :raises ValueError: if ``algo`` or ``env`` cannot be used, or the file lacks settings that
        ``policy_kwargs`` must give
    """
    env = maybe_make_env(env, verbose=0)
    check_spaces(env.observation_space, env.action_space)
    file = read_agent_file(path)
    with about(file.path):
        shapes = {name: tuple(tensor.shape) for name, tensor in file.tensors.items()}
        architecture = read_architecture(shapes, env.observation_space, env.action_space)
        name = _algorithm(file, architecture, algo)
        networks = network_settings(file.data, architecture, policy_kwargs)
        if issubclass(ALGORITHMS[name], TQC):
            networks["n_quantiles"] = architecture.n_outputs
        numbers, warnings = _numbers(file, name, architecture)
    warnings += _differing_bounds(file, env.action_space)
    agent = _build(ALGORITHMS[name], env, networks, numbers, architecture.use_sde, device, file.tensors)
    for warning in warnings:
        logger.warning("%s: %s", file.path, warning)
    taken = {"use_sde", *numbers, *(name for name, group in MOVED.items() if group in numbers)}
    left = _not_taken_over(file, taken - set(EnsembleSettings.names()), policy_kwargs)
    agent.not_taken_over = left  # type: ignore[attr-defined]
    kind, activation = type(agent).__name__, networks["activation_fn"].__name__
    logger.info("%s: loaded as %s with %s. Not taken over: %s", file.path, kind, activation, list(left))
    return agent


def _algorithm(file: AgentFile, architecture: Architecture, algo: str | None) -> str:
    if algo is None:
        if architecture.stochastic:
            is_tqc = architecture.n_outputs > 1 or "top_quantiles_to_drop_per_net" in file.data
            algo = "tqc" if is_tqc else "sac" if architecture.has_targets else "crossq"
        else:
            algo = "ddpg" if architecture.n_critics == 1 else "td3"
        if "beam_width" in file.data:
            algo = f"mcbs_{algo}"
    if algo not in ALGORITHMS:
        raise ValueError(f"algo must be one of {list(ALGORITHMS)}, got {algo!r}.")
    cls = ALGORITHMS[algo]
    one_output = architecture.n_outputs == 1 or issubclass(cls, TQC)
    targets = architecture.has_targets != issubclass(cls, CrossQ)
    if architecture.stochastic != issubclass(cls, STOCHASTIC) or not one_output or not targets:
        kind = "a stochastic" if architecture.stochastic else "a deterministic"
        raise AgentFileError(
            f"The file is not of the algorithm {algo!r}: it has {kind} actor, critics with "
            f"{architecture.n_outputs} output(s), and {'' if architecture.has_targets else 'no '}target "
            "networks."
        )
    return algo


def _is_entropy_coefficient(value: Any) -> bool:
    if isinstance(value, str):
        return re.fullmatch(r"auto(_(\d+\.?\d*|\.\d+)(e[-+]?\d+)?)?", value[:80]) is not None
    return is_number(value) and value >= 0


def _numbers(file: AgentFile, algo: str, architecture: Architecture) -> tuple[dict[str, Any], list[str]]:
    """The settings to take over from the file, by name, and warnings about those that cannot be."""
    checks: dict[str, tuple[Callable[[Any], bool], str]] = {
        "gamma": (lambda value: is_number(value) and 0 < value <= 1, "a number above 0 and up to 1")
    }
    if issubclass(ALGORITHMS[algo], STOCHASTIC):
        checks["ent_coef"] = (_is_entropy_coefficient, "a number from 0 or 'auto'")
    if issubclass(ALGORITHMS[algo], TQC):
        checks["top_quantiles_to_drop_per_net"] = (
            lambda value: type(value) is int and 0 <= value < architecture.n_outputs,
            f"an integer from 0 to below the number of quantiles, {architecture.n_outputs}",
        )
    searches = "beam_width" in file.data and issubclass(ALGORITHMS[algo], MCBS)
    names = (*checks, *(KEYWORDS if searches else ()))
    expected = (*checks, *SearchSettings.flat, "strategy")  # older files lack the dictionaries
    data = {name: value for name, value in file.data.items() if not is_pickled(value)}
    warnings = [
        f"{name} is not there as a plain value; the default is used. Set it on the agent."
        for name in (*names, *(MOVED if searches else ()))
        if name not in data and (name in file.data or name in expected)
    ]
    for name, (check, words) in checks.items():
        if name in data and not check(data[name]):
            raise AgentFileError(f"{name} must be {words}, got {str(data[name])[:80]!r}.")
    group_flat(data)
    values = {name: data[name] for name in names if name in data}
    try:
        if isinstance(values.get("model_kwargs"), dict):  # no learned model is read
            values["model_kwargs"] = {
                key: value
                for key, value in values["model_kwargs"].items()
                if key not in EnsembleSettings.in_group()
            }
        make_settings(**{name: value for name, value in values.items() if name in KEYWORDS})
    except (TypeError, ValueError, OverflowError) as reason:
        raise AgentFileError(f"search settings: {str(reason)[:300]}") from reason
    return values, warnings


def _differing_bounds(file: AgentFile, action_space: Any) -> list[str]:
    """Compare the action bounds with the readable copy in the file, as far as it can be parsed."""
    space = file.data.get("action_space")
    for name in ("low", "high"):
        text = str(space.get(name)) if isinstance(space, dict) else ""
        try:
            declared = np.array(re.sub(r"[\[\],]", " ", text).split(), dtype=np.float64)
        except ValueError:  # not there, or shortened
            continue
        bound = getattr(action_space, name).ravel()
        if declared.shape == bound.shape and not np.allclose(declared, bound, rtol=1e-4):
            return [
                f"the environment's actions end at {name}={bound.tolist()}, those of the training at "
                f"{declared.tolist()}; the agent's actions are scaled to the environment's."
            ]
    return []


class NoOptimizer:
    """Replaces the optimiser in the policy of an agent that only acts."""

    def __init__(self, parameters: Any, lr: float) -> None:
        pass


def _build(
    cls: type[Any],
    env: GymEnv,
    networks: dict[str, Any],
    numbers: dict[str, Any],
    use_sde: bool,
    device: th.device | str,
    tensors: dict[str, th.Tensor],
) -> OffPolicyAlgorithm:
    settings = numbers | ({"use_sde": use_sde} if issubclass(cls, STOCHASTIC) else {})
    agent = cls(
        "MlpPolicy",
        env,
        policy_kwargs={**networks, "optimizer_class": NoOptimizer},
        device=device,
        _init_setup_model=False,
        **settings,
    )
    # Drawing initial weights, which are replaced, must not advance the caller's random numbers.
    with th.random.fork_rng(devices=[]):
        policy = agent.policy_class(
            agent.observation_space, agent.action_space, lambda _: 0.0, **agent.policy_kwargs
        )
    policy.load_state_dict(tensors)
    policy.set_training_mode(False)
    agent.policy = policy.to(agent.device)
    agent._create_aliases()
    if use_sde:
        agent.policy.reset_noise()
    for method in ("learn", "train", "save"):
        setattr(agent, method, functools.partial(_refuse, method, cls.__name__))
    return agent


def _refuse(method: str, algorithm: str, *args: Any, **kwargs: Any) -> NoReturn:
    raise RuntimeError(
        f"An agent of load_agent only acts: it has no optimiser and no replay buffer to {method} with. If "
        f"you trust the file's author, use {algorithm}.load(path, env=env): it runs code from the file."
    )


def _not_taken_over(file: AgentFile, taken: set[str], policy_kwargs: dict[str, Any] | None) -> dict[str, str]:
    reasons = {
        name: "a pickle, which is not opened" if is_pickled(value) else "not needed to act"
        for name, value in file.data.items()
        if name not in taken
    }
    reasons |= dict.fromkeys(
        reasons.keys() & {"observation_space", "action_space"}, "the environment's is used"
    )
    if policy_kwargs is not None:
        reasons["policy_kwargs"] = "those of the caller are used"
    elif is_pickled(file.data["policy_kwargs"]):
        reasons["policy_kwargs"] = "a pickle, which is not opened; the readable copy beside it is used"
    else:
        del reasons["policy_kwargs"]
    if "activation_fn" not in (file.data["policy_kwargs"] if policy_kwargs is None else policy_kwargs):
        reasons["policy_kwargs: activation_fn"] = "not there, so it is SB3's default, ReLU"
    reasons |= dict.fromkeys(file.unread, "a member that is not read")
    return {name[:80]: reason for name, reason in reasons.items()}
