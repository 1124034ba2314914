"""Learning from what the search simulated: its rollouts as transitions of several steps.

A search rolls every candidate out with the present actor. Each rollout is a transition of ``rollout_depth``
steps whose later actions are the actor's own (with ``rollout_noise=0``; otherwise with that noise, like the
smoothing of TD3's targets), so that the critics learn the values of actions around the policy, at states that
were really visited, from rewards of the exact simulator. Rollouts are stored beside
the transition of the same step, in arrays of their own: they are never taken for experience.
"""

import logging
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import get_obs_shape
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs.agents.mixed_batches import Outcome, Samples, as_samples
from sb3_mcbs.search import Rollouts, SearchSettings
from sb3_mcbs.search.checks import CheckedSettings
from sb3_mcbs.types import Observations, map_arrays, put_rows

logger = logging.getLogger("sb3_mcbs")

#: Below this share of places that hold a rollout they are looked up, above it they are found by trying.
_SPARSE = 0.02


@dataclass(frozen=True)
class RolloutReplaySettings(CheckedSettings):
    """Whether the agent learns from the search's rollouts.

    :param rollout_replay: the share of every batch that is taken from the rollouts of the search instead of
        the agent's own transitions. Every decision is then simulated, also where ``search_share`` leaves the
        action to the agent without search. 0: rollouts are not kept.
    :raises TypeError: if a value has the wrong type.
    :raises ValueError: if a value is out of range.
    """

    rollout_replay: float = 0.0

    def __post_init__(self) -> None:
        self._set_number("rollout_replay", 1.0)

    def check_search(self, settings: SearchSettings) -> None:
        """Refuse searches whose rollouts do not follow the actor.

        :param settings: of the search.
        :raises ValueError: says which setting, and why.
        """
        if not self.rollout_replay:
            return
        if settings.rollout_depth == 0:
            raise ValueError(
                "rollout_replay needs a rollout_depth of 1 or more: with 0 there are no rollouts."
            )
        if settings.forward_model == "ensemble":
            raise ValueError(
                "rollout_replay learns from exact simulations; those of forward_model='ensemble' are not: "
                "leave one of the two out."
            )
        if settings.strategy != "beam" or settings.time_budget is not None:
            raise ValueError(
                "rollout_replay needs strategy='beam' without a time_budget: only there are rollouts those "
                "of the actor, and equally many at every decision."
            )
        if settings.noise_hold > 1:
            raise ValueError(
                "rollout_replay needs noise_hold=1: rollouts that hold noise do not follow the actor."
            )


class RolloutReplay:
    """The rollouts beside the rows of a replay buffer.

    They are attributes of the buffer, so that they are saved and loaded with it: for every row, environment
    and rollout the first action, the rewards, how many there are (0: no rollout), whether the environment
    ended it, and the last observation.

    :param buffer: the replay buffer; gets the arrays if it does not have them.
    :param n_rollouts: of one decision.
    :param rollout_depth: steps of a rollout.
    """

    def __init__(self, buffer: ReplayBuffer, n_rollouts: int, rollout_depth: int) -> None:
        self.buffer = cast(Any, buffer)  # with attributes that SB3's class does not declare
        self._shapes = get_obs_shape(buffer.observation_space)
        shape = (buffer.buffer_size, buffer.n_envs, n_rollouts)
        held = getattr(buffer, "rollout_rewards", None)
        if held is not None and held.shape == (*shape, rollout_depth):
            return
        if held is not None and self.buffer.rollout_count:
            logger.warning(
                "The %d rollouts of the replay buffer are dropped: they are %d of %d steps per decision, and "
                "the search now has %d of %d.",
                self.buffer.rollout_count,
                *held.shape[2:],
                n_rollouts,
                rollout_depth,
            )
        self.buffer.rollout_actions = np.zeros((*shape, buffer.action_dim), dtype=np.float32)
        self.buffer.rollout_rewards = np.zeros((*shape, rollout_depth), dtype=np.float32)
        self.buffer.rollout_lengths = np.zeros(shape, dtype=np.int32)
        self.buffer.rollout_terminated = np.zeros(shape, dtype=bool)
        self.buffer.rollout_observations = _zeros(buffer.observation_space, shape)
        self.buffer.rollout_count = 0

    @property
    def count(self) -> int:
        """How many rollouts are held."""
        return self.buffer.rollout_count

    def put(self, row: int, rollouts: Rollouts | None) -> None:
        """Store the rollouts of one step, in place of those that the row held before.

        :param row: of the replay buffer.
        :param rollouts: of all environments; ``None`` if there are none.
        """
        buffer = self.buffer
        self._forget(row)
        if (
            buffer.optimize_memory_usage
        ):  # the last observation of this step takes the place of the next row's
            self._forget((row + 1) % buffer.buffer_size)
        if rollouts is None:
            return
        n, depth = rollouts.rewards.shape[1:]
        at = (row, slice(None), slice(None, n))
        buffer.rollout_actions[at] = rollouts.actions
        buffer.rollout_rewards[(*at, slice(None, depth))] = rollouts.rewards
        buffer.rollout_terminated[at] = rollouts.terminated
        put_rows(buffer.rollout_observations, at, _as_kept(rollouts.observations, self._shapes), slice(None))
        buffer.rollout_lengths[at] = rollouts.lengths
        buffer.rollout_count += int(np.count_nonzero(rollouts.lengths))

    def _forget(self, row: int) -> None:
        self.buffer.rollout_count -= int(np.count_nonzero(self.buffer.rollout_lengths[row]))
        self.buffer.rollout_lengths[row] = 0

    def sample(self, n: int, gamma: float, rng: np.random.Generator, env: VecNormalize | None) -> Samples:
        """Draw rollouts, each equally likely.

        :param n: how many.
        :param gamma: discount factor per step.
        :param rng: draws them.
        :param env: normalises observations and rewards.
        :return: as of a buffer of transitions over several steps.
        """
        buffer = self.buffer
        places = self._draw(n, rng)
        at, lengths = places[:2], buffer.rollout_lengths[places]
        rewards = buffer._normalize_reward(buffer.rollout_rewards[places], env)
        steps = np.arange(rewards.shape[1])
        discounted = rewards * np.where(steps < lengths[:, None], gamma**steps, 0.0)
        outcome = Outcome(
            discounted.sum(axis=1),
            lengths,
            buffer.rollout_terminated[places],
            map_arrays(itemgetter(places), buffer.rollout_observations),
        )
        return as_samples(buffer, at, buffer.rollout_actions[places], outcome, gamma, env)

    def _draw(self, n: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        """Draw places that hold a rollout: rows, environments and numbers, each ``[n]``."""
        lengths = self.buffer.rollout_lengths
        held = len(lengths) if self.buffer.full else self.buffer.pos
        shape = (held, *lengths.shape[1:])
        n_places = held * lengths[0].size
        if self.count < _SPARSE * n_places:
            drawn = rng.choice(np.flatnonzero(lengths[:held]), n)
            return np.unravel_index(drawn, shape)
        drawn = np.zeros(0, dtype=np.int64)
        while len(drawn) < n:
            tried = rng.integers(0, n_places, 2 * n)
            drawn = np.concatenate([drawn, tried[lengths[np.unravel_index(tried, shape)] > 0]])
        return np.unravel_index(drawn[:n], shape)


def _as_kept(observations: Observations, shapes: Any) -> Observations:
    """Observations ``[n_envs, rollouts, *]`` in the shapes of SB3's buffers: discrete ones have an axis."""
    if isinstance(observations, dict):
        return {key: _as_kept(part, shapes[key]) for key, part in observations.items()}  # type: ignore[misc]
    return observations.reshape(*observations.shape[:2], *shapes)


def _zeros(space: spaces.Space, shape: tuple[int, ...]) -> Observations:
    if isinstance(space, spaces.Dict):
        return {key: _zeros(part, shape) for key, part in space.items()}  # type: ignore[misc]
    # Networks see float32; there are many more rollouts than transitions.
    dtype = np.float32 if space.dtype == np.float64 else space.dtype
    return np.zeros((*shape, *cast(tuple[int, ...], get_obs_shape(space))), dtype)
