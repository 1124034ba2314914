"""Batches of which a part comes from simulations instead of the replay buffer."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from operator import itemgetter
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs.types import Observations, map_arrays

Samples = ReplayBufferSamples | DictReplayBufferSamples


class Outcome(NamedTuple):
    """What transitions of several steps came to.

    :param returns: ``[n]``, discounted sums of rewards as the networks are given them.
    :param lengths: ``[n]``, steps.
    :param terminated: ``[n]`` bool, whether the environment ended the episode.
    :param observations: ``[n, *]``, the last ones, as replay buffers keep them.
    """

    returns: np.ndarray
    lengths: np.ndarray
    terminated: np.ndarray
    observations: Observations


def as_samples(
    buffer: Any,
    at: tuple[np.ndarray, ...],
    actions: np.ndarray,
    outcome: Outcome,
    gamma: float,
    env: VecNormalize | None,
) -> Samples:
    """Make a batch, as replay buffers do.

    :param buffer: the replay buffer.
    :param at: rows and environments ``[n]`` where the transitions begin.
    :param actions: ``[n, act_dim]``, the first ones.
    :param outcome: ``[n]``.
    :param gamma: discount factor per step.
    :param env: normalises observations.
    :return: the batch, with discounts for the next observations' values.
    """
    first = buffer._normalize_obs(map_arrays(itemgetter(at), buffer.observations), env)
    last = buffer._normalize_obs(outcome.observations, env)
    samples = DictReplayBufferSamples if isinstance(first, dict) else ReplayBufferSamples
    return samples(
        map_arrays(buffer.to_torch, first),
        buffer.to_torch(actions),
        map_arrays(buffer.to_torch, last),
        buffer.to_torch(outcome.terminated.astype(np.float32)[:, None]),
        buffer.to_torch(outcome.returns.astype(np.float32)[:, None]),
        buffer.to_torch((gamma**outcome.lengths).astype(np.float32)[:, None]),
    )


class Simulations(Protocol):
    """What transitions of several steps can be drawn from."""

    def sample(self, n: int, gamma: float, rng: np.random.Generator, env: VecNormalize | None) -> Samples:
        """Draw transitions.

        :param n: how many.
        :param gamma: discount factor per step.
        :param rng: draws them.
        :param env: normalises observations and rewards.
        :return: as of a buffer of transitions over several steps.
        """
        ...


class Part(NamedTuple):
    """A part of every batch.

    :param simulations: where it comes from.
    :param share: of the batch.
    """

    simulations: Simulations
    share: float


class _Mixture:
    """A replay buffer whose batches are its own transitions and those of simulations."""

    def __init__(self, agent: OffPolicyAlgorithm, parts: Sequence[Part], rng: np.random.Generator) -> None:
        self._agent, self._parts, self._rng = agent, parts, rng
        self._buffer: Any = agent.replay_buffer

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        counts, n_own = [], batch_size
        for part in self._parts:  # rounded up, two parts could be more than the batch
            counts.append(min(round(part.share * batch_size), n_own))
            n_own -= counts[-1]
        samples = []
        if n_own:
            own = self._buffer.sample(n_own, env=env)
            if own.discounts is None:
                own = own._replace(discounts=th.full_like(own.rewards, self._agent.gamma))
            samples.append(own)
        samples += [
            part.simulations.sample(count, self._agent.gamma, self._rng, env)
            for part, count in zip(self._parts, counts, strict=True)
            if count
        ]
        return type(samples[0])(*(_joined(fields) for fields in zip(*samples, strict=True)))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._buffer, name)


@contextmanager
def mixed_batches(
    agent: OffPolicyAlgorithm, parts: Sequence[Part], rng: np.random.Generator
) -> Iterator[None]:
    """Let an agent's gradient steps draw parts of every batch from simulations.

    :param agent: the agent.
    :param parts: those parts; the rest is drawn from its replay buffer.
    :param rng: draws from the simulations.
    """
    buffer = agent.replay_buffer
    agent.replay_buffer = _Mixture(agent, parts, rng)  # type: ignore[assignment]
    try:
        yield
    finally:
        agent.replay_buffer = buffer


def _joined(fields: Sequence[Any]) -> Any:
    if isinstance(fields[0], dict):
        return {key: th.cat([field[key] for field in fields]) for key in fields[0]}
    return th.cat(list(fields))
