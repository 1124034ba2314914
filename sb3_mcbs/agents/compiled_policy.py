"""An agent's networks, with all that lies between them and its environments, for compiled rollouts."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from sb3_contrib import TQC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_mcbs.agents.observation_pipeline import EnvironmentPipeline, ObservationPipeline
from sb3_mcbs.models import MujocoBatchModel
from sb3_mcbs.models.compiled_networks import actions_of, values_of
from sb3_mcbs.networks.functions import actor_of, unscales_as_sb3
from sb3_mcbs.networks.mlp import MLP, tables
from sb3_mcbs.networks.plain_networks import actor_mlp, critic_mlps
from sb3_mcbs.types import ForwardModel, PolicyArrays, PolicyRollouts

logger = logging.getLogger("sb3_mcbs")


class CompiledPolicy:
    """The functions of :class:`~sb3_mcbs.search.PolicyFunctions` that run in compiled code.

    :param agent: a supported agent.
    :param model: simulates.
    :param view: turns simulated observations and rewards into those of the networks.
    :param target: the target actor, if there is one, without critics.
    :raises TypeError: says what compiled code does not cover.
    """

    def __init__(
        self, agent: Any, model: ForwardModel, view: ObservationPipeline, target: bool = False
    ) -> None:
        if not isinstance(model, MujocoBatchModel):
            raise TypeError(f"the forward model is {model.kind!r}, not 'mujoco'")
        self._model, self._view = model, view
        critics = [] if target else critic_mlps(agent.policy.critic)
        #: The arrays are valid as long as the weights live.
        self._arrays, self._weights = policy_arrays(agent, view, actor_mlp(actor_of(agent, target)), critics)

    def policy(self, observations: Any) -> np.ndarray:
        """The actor's actions ``[rows, act_dim]`` for observations of the environment."""
        arrays = self._arrays
        actions: np.ndarray = actions_of(arrays, _rows(observations), len(arrays.low))
        return actions

    def value(self, observations: Any, actions: np.ndarray) -> np.ndarray:
        """The critics' values ``[rows]`` for observations of the environment and scaled actions."""
        rows = np.ascontiguousarray(actions, dtype=np.float32)
        values: np.ndarray = values_of(self._arrays, _rows(observations), rows)
        return values

    def rollout(
        self, roots: Sequence[Any], index: np.ndarray, actions: np.ndarray, noise: np.ndarray, n_shared: int
    ) -> PolicyRollouts:
        """See :meth:`MujocoBatchModel.roll_out`."""
        return self._model.roll_out(roots, index, self._arrays, actions, noise, n_shared)

    def follow(self, states: Sequence[Any], observations: np.ndarray, n_steps: int) -> PolicyRollouts:
        """Follow the actor without noise, one rollout from each state, without the critics' values.

        :param states: ``[rows]``, from :meth:`MujocoBatchModel.read_roots`.
        :param observations: ``[rows, obs_dim]`` there.
        :param n_steps: their length.
        """
        actions = self.policy(observations)
        no_noise = np.zeros((n_steps, len(states), 1, actions.shape[1]), dtype=np.float32)
        index = np.arange(len(states))
        return self._model.roll_out(states, index, self._arrays, actions, no_noise, 1, bootstraps=False)

    def normalizes_like(self, env: VecNormalize | None) -> bool:
        """Whether observations and rewards are normalised as by a ``VecNormalize``.

        :param env: the ``VecNormalize``; ``None``: not at all.
        """
        normalizer = env if env is not None and env.norm_reward else None
        layers = getattr(self._view, "layers", [])
        return self._view.reward_normalizer is normalizer and layers == ([] if env is None else [env])


def way(reason: str) -> str:
    """How rollouts go, in words.

    :param reason: why they do not go in compiled code; empty: they do.
    """
    return f"go step by step: {reason}" if reason else "are compiled"


def _rows(observations: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(observations, dtype=np.float64)


def policy_arrays(
    agent: Any, view: ObservationPipeline, actor: MLP, critics: list[MLP]
) -> tuple[PolicyArrays, list[th.Tensor]]:
    """An agent's networks and pipeline as arrays.

    :param agent: a supported agent.
    :param view: turns simulated observations and rewards into those of the networks.
    :param actor: the actor.
    :param critics: the critics; may be empty.
    :return: the arrays, and the weights behind their addresses.
    :raises TypeError: says what compiled code does not cover.
    """
    if not unscales_as_sb3(agent):
        raise TypeError("actions are not scaled as by SB3")
    space, normalizer = agent.policy.action_space, view.reward_normalizer
    scale, reward_clip = 1.0, np.inf
    if normalizer is not None:
        scale = float(np.sqrt(normalizer.ret_rms.var + normalizer.epsilon))
        reward_clip = float(normalizer.clip_reward)
    (actor_table, *critic_tables), weights = tables([actor, *critics])
    arrays = PolicyArrays(
        actor_table,
        np.stack(critic_tables) if critics else np.zeros((0, *actor_table.shape), dtype=np.int64),
        isinstance(agent, TQC),
        *_observation_scale(view),
        space.low.ravel(),
        0.5 * (space.high - space.low).ravel(),
        scale,
        reward_clip,
        float(agent.gamma),
    )
    return arrays, weights


def _observation_scale(view: ObservationPipeline) -> tuple[np.ndarray, np.ndarray, float]:
    assert isinstance(view, EnvironmentPipeline)
    if isinstance(view.base, DummyVecEnv) and view.base.observation_space.dtype != np.float64:
        raise TypeError("observations are rounded on their way to the networks")
    if any(type(layer) is not VecNormalize for layer in view.layers) or len(view.layers) > 1:
        raise TypeError("vectorized wrappers other than one VecNormalize alter observations")
    nothing = np.zeros(0)
    if not view.layers:
        return nothing, nothing, np.inf
    normalizer: Any = view.layers[0]
    if not normalizer.norm_obs:
        return nothing, nothing, np.inf
    deviation = np.sqrt(normalizer.obs_rms.var + normalizer.epsilon)
    mean = np.asarray(normalizer.obs_rms.mean, dtype=np.float64)
    return mean, np.asarray(deviation, dtype=np.float64), float(normalizer.clip_obs)
