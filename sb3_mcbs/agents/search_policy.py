"""Search around any trained agent."""

import operator
from collections.abc import Collection, Mapping
from copy import copy, deepcopy
from types import MappingProxyType
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import maybe_transpose
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_mcbs.agents.hyperparameters import (
    MOVED,
    REMOVED,
    SETTINGS,
    RefusesOldNames,
    refuse_old_names,
)
from sb3_mcbs.agents.mcbs import MCBS
from sb3_mcbs.agents.planner import Planner
from sb3_mcbs.agents.presets import settings_of_preset
from sb3_mcbs.agents.resumable import Searching
from sb3_mcbs.search import SearchResult, SearchSettings, make_settings, with_preset
from sb3_mcbs.search.settings import KEYWORDS, merged
from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.types import Backend, MatmulPrecision, Preset, Strategy

#: Attributes with special handling when they are set.
_HELD = ("model", "vec_env", "settings", "preset")


class SearchPolicy(RefusesOldNames, Searching):
    """
    A trained agent that looks ahead before it acts, with SB3's ``predict`` signature.

    Every call of :meth:`predict` plans from the current states of ``vec_env``, so the actions are valid in
    that environment only::

        policy = SearchPolicy(model, vec_env, beam_width=6, rollout_depth=3)
        evaluate_policy(policy, vec_env)

    SAC, TQC and CrossQ propose their mean action; TQC's value is the mean over all quantiles.
    Settings are attributes: setting one (``policy.beam_width = 20``) applies from the next decision on, and
    ``policy.settings = ...`` sets them all. Other attributes are those of the agent (``save``, ``get_env``,
    ``logger``, ...).

    :param model: a TD3, DDPG, SAC, TQC or CrossQ agent, or one that searched in training (
        :class:`~sb3_mcbs.MCBS`)
    :param vec_env: the environment to act in. Further ``VecEnv`` wrappers around it must not alter anything.
        Environments in this process are wrapped for snapshots in place. A ``gym.Env`` must have
        :class:`~sb3_mcbs.SnapshotEnvWrapper` outermost.
    :param seed: seed of the search's own generator; None: random
    :param normalize_reward: whether the critics were trained on rewards that ``VecNormalize`` scaled.
        None: inferred from the environment that the agent was trained in, or from the statistics
    :param beam_width: this and the following are those of :class:`~sb3_mcbs.MCBSTD3`. Those that are not
        given, including keys of ``search_kwargs`` and ``model_kwargs``, are the agent's, or with ``preset``
        those of the preset, or the defaults
    :param rollout_depth: simulated steps per rollout
    :param n_simulations: rollouts per candidate
    :param beam_noise: standard deviation of candidates, in scaled actions
    :param strategy: ``"beam"``, ``"tree"`` or ``"cem"``
    :param search_kwargs: additional settings of the strategy, see :class:`~sb3_mcbs.BeamSettings`,
        :class:`~sb3_mcbs.TreeSettings` and :class:`~sb3_mcbs.CEMSettings`
    :param preset: one of :data:`~sb3_mcbs.search.PRESETS`, from which the settings start instead of the
        agent's
    :param forward_model: the simulator
    :param model_kwargs: ``n_threads``
    :param matmul_precision: precision of the networks' float32 products
    """

    #: Attributes that exact checkpoints do not contain, and why.
    not_checkpointed: ClassVar[Collection[str]] = {
        "planner": "its forward model is made from the environments; its memory is saved",
        "last_result": "of the last step; computed again before it is read",
    }
    # The settings, which ``__getattr__`` reads.
    beam_width: int
    rollout_depth: int
    n_simulations: int
    beam_noise: float
    strategy: Strategy
    search_kwargs: Mapping[str, Any] | None
    preset: Preset | None
    forward_model: Backend
    model_kwargs: Mapping[str, Any] | None
    matmul_precision: MatmulPrecision | None
    planner: Planner

    def __init__(
        self,
        model: OffPolicyAlgorithm,
        vec_env: VecEnv | gym.Env,
        seed: int | None = None,
        normalize_reward: bool | None = None,
        *,
        beam_width: int | None = None,
        rollout_depth: int | None = None,
        n_simulations: int | None = None,
        beam_noise: float | None = None,
        strategy: Strategy | None = None,
        search_kwargs: dict[str, Any] | None = None,
        preset: Preset | None = None,
        forward_model: Backend | None = None,
        model_kwargs: dict[str, Any] | None = None,
        matmul_precision: MatmulPrecision | None = None,
    ) -> None:
        arguments = locals()
        given = {name: arguments[name] for name in KEYWORDS if arguments[name] is not None}
        if normalize_reward is not None and not isinstance(normalize_reward, bool):
            raise TypeError(f"normalize_reward must be True, False or None, got {normalize_reward!r}.")
        self.model = model
        if preset is None and isinstance(model, MCBS):
            if rollout_depth == 0:  # nothing is simulated, so no learned model is used
                given = {"forward_model": "auto", **given}
            self.settings = make_settings(**merged(model.search_settings.grouped(), given))
        else:
            self.settings = make_settings(**with_preset(preset, given))
        self.vec_env = _as_agents_vec_env(vec_env, model)
        self.rng = np.random.default_rng(seed)
        self.last_result: SearchResult | None = None
        # A copy, so that acting here does not change the training.
        recent_actions = deepcopy(model.recent_actions) if isinstance(model, MCBS) else None
        self.planner = Planner(model, self.vec_env, self.settings, normalize_reward, recent_actions)

    def __setattr__(self, name: str, value: Any) -> None:
        attributes = vars(self)
        if "planner" not in attributes or (name in attributes and name not in _HELD):
            super().__setattr__(name, value)
        elif name in ("model", "vec_env"):
            raise AttributeError(f"The {name} of a SearchPolicy cannot be exchanged: make another one.")
        elif name == "settings":
            self._change_settings(value)
        elif name == "preset":
            if value is not None:
                self._change(settings_of_preset(value))
            attributes["preset"] = value
        elif name in KEYWORDS:
            changes = {name: value}
            if changes == {"rollout_depth": 0} and self.settings.forward_model == "ensemble":
                changes["forward_model"] = "auto"  # nothing is simulated
            self._change(changes)
        elif name in REMOVED or name in MOVED:
            refuse_old_names({name: value})
        elif hasattr(self.model, name):
            setattr(self.model, name, value)
        elif name in SETTINGS:
            raise AttributeError(f"{name} is for agents that search while they train.")
        else:
            super().__setattr__(name, value)

    def __copy__(self) -> "SearchPolicy":
        made = type(self).__new__(type(self))
        vars(made).update(vars(self))
        vars(made)["planner"] = copy(self.planner)
        return made

    def _change(self, changes: dict[str, Any]) -> None:
        own = {name: value for name, value in changes.items() if name in KEYWORDS}
        self.settings = make_settings(**{**self.settings.grouped(), **own})

    def _change_settings(self, settings: SearchSettings) -> None:
        if not isinstance(settings, SearchSettings):
            raise TypeError(f"Expected BeamSettings, TreeSettings or CEMSettings, got {settings!r}.")
        self.planner.follow(settings)
        vars(self)["settings"] = settings

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Search for the best actions in the current states of ``vec_env``.

        :param observation: the current observations of ``vec_env``; images also with the channels last
        :param state: not used
        :param episode_start: not used
        :param deterministic: has no effect. The best candidate is always taken, without exploration noise;
            candidates are sampled from this object's own generator, so the same ``seed`` and the same calls
            give the same actions.
        :return: the actions and ``state``
        """
        space = self.model.observation_space
        batched, is_single = _add_batch_axis(_channels_first(observation, space), space)
        self.last_result = self.planner.plan(batched, self.rng)
        self.planner.remember_actions(self.last_result.actions)
        actions = self.planner.unscale(self.last_result.actions)
        return (actions[0] if is_single else actions), state

    def _follow_settings(self) -> None:
        self.planner.follow(self.settings)

    def close(self) -> None:
        """Release the forward model. The agent and the environment stay open."""
        self.planner.close()

    def __getattr__(self, name: str) -> Any:
        if name in ("model", "settings") or name.startswith("__"):
            raise AttributeError(name)
        if name not in KEYWORDS:
            return getattr(self.model, name)
        value = self.settings.grouped()[name]
        return MappingProxyType(value) if isinstance(value, dict) else value


def _as_vec_env(env: VecEnv | gym.Env) -> VecEnv:
    if isinstance(env, VecEnv):
        return env
    if isinstance(env, SnapshotEnvWrapper):
        return DummyVecEnv([lambda: env])
    raise TypeError(
        f"SearchPolicy plans from the states of a vectorized environment, got {type(env).__name__}. Pass "
        "make_vec_env(...), or a gym.Env wrapped in SnapshotEnvWrapper outermost, and act in the same object."
    )


def _as_agents_vec_env(env: VecEnv | gym.Env, model: OffPolicyAlgorithm) -> VecEnv:
    """Return an environment to act in, in the agent's form.

    :raises ValueError: if its spaces are not the agent's.
    """
    vec_env = OffPolicyAlgorithm._wrap_env(_as_vec_env(env), monitor_wrapper=False)  # transposes images
    for what, ours, its, alike in (
        ("observation", vec_env.observation_space, model.observation_space, _are_alike),
        ("action", vec_env.action_space, model.action_space, operator.eq),
    ):
        if not alike(ours, its):
            raise ValueError(
                f"The agent was trained with the {what} space {its}, and vec_env has {ours}. Make the "
                "environment with the same id, arguments and wrappers as for the training."
            )
    return vec_env


def _are_alike(one: gym.Space, other: gym.Space) -> bool:
    """Whether observations of two spaces have the same entries; their bounds do not matter."""
    if isinstance(one, gym.spaces.Dict) and isinstance(other, gym.spaces.Dict):
        return one.spaces.keys() == other.spaces.keys() and all(_are_alike(one[k], other[k]) for k in one)
    if isinstance(one, gym.spaces.Box) and isinstance(other, gym.spaces.Box):
        return one.shape == other.shape
    return one == other


def _channels_first(observation: Any, space: gym.Space) -> Any:
    """Transpose images as SB3's ``predict`` does."""
    if isinstance(space, gym.spaces.Dict):
        return {key: _channels_first(value, space[key]) for key, value in observation.items()}
    return maybe_transpose(np.asarray(observation), space)


def _add_batch_axis(observation: Any, space: gym.Space) -> tuple[Any, bool]:
    """Add the environments' axis to a single observation.

    :return: the batched observation, and whether the axis was added.
    """
    if isinstance(space, gym.spaces.Dict):
        key = next(iter(space.spaces))
        is_single = np.ndim(observation[key]) == len(space[key].shape or ())
        return (
            {k: np.asarray(v)[None] for k, v in observation.items()} if is_single else observation
        ), is_single
    is_single = np.ndim(observation) == len(space.shape or ())
    return (np.asarray(observation)[None] if is_single else observation), is_single
