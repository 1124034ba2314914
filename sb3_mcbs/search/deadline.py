"""Search until a deadline: rounds of candidates are added while the next is expected to finish in time."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sb3_mcbs.models.base import ForwardModel, Observations
from sb3_mcbs.search.beam import (
    Agent,
    FirstStep,
    OutOfTimeError,
    SearchResult,
    choose,
    draw_noise,
    propose,
    rollout_values,
)
from sb3_mcbs.search.settings import SearchSettings

#: How many past rounds a forecast looks at, and which share of them it covers.
_MEMORY, _SHARE = 64, 0.9


class Pace:
    """Forecasts how long rounds take, from those that were done.

    :param clock: seconds, rising.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock = clock
        self._rounds: dict[int, deque[float]] = {}
        self._ending: deque[float] = deque(maxlen=_MEMORY)

    def note_round(self, width: int, seconds: float) -> None:
        """Learn from a round.

        :param width: its candidates.
        :param seconds: what it took, or what had passed when it was given up.
        """
        self._rounds.setdefault(width, deque(maxlen=_MEMORY)).append(seconds)

    def note_no_round(self) -> None:
        """Forget the oldest single-candidate round, so that one hiccup does not end all searching."""
        if self._rounds.get(1):
            self._rounds[1].popleft()
        if not self._rounds.get(1):
            self._rounds.clear()

    def note_ending(self, seconds: float) -> None:
        """Learn what it takes to choose after the last round."""
        self._ending.append(seconds)

    @property
    def ending(self) -> float:
        """Seconds to reserve for choosing."""
        return _high(self._ending) if self._ending else 0.0

    def forecast(self, width: int) -> float | None:
        """Seconds that a round will probably not exceed.

        :param width: its candidates.
        :return: ``None`` if no round was done yet.
        """
        if width in self._rounds:
            return _high(self._rounds[width])
        if not self._rounds:
            return None
        # A round has fixed costs, so that n times the candidates take less than n times as long.
        narrower = [known for known in self._rounds if known < width]
        nearest = max(narrower) if narrower else min(self._rounds)
        return _high(self._rounds[nearest]) * max(1.0, width / nearest)

    def affordable(self, seconds: float, most: int) -> int:
        """The number of candidates for the next round.

        A round that is given up is lost, so none but the narrowest takes more than half of the time left.

        :param seconds: time left.
        :param most: candidates that are still wanted.
        :return: a power of two or ``most``; 0 if not even one candidate is expected to finish.
        """
        seconds -= self.ending
        one = self.forecast(1)
        if seconds <= 0 or (one is not None and one > seconds):
            return 0
        width = 1
        while width < most:
            wider = min(2 * width, most)
            expected = self.forecast(wider)
            if expected is None or expected > seconds / 2:
                break
            width = wider
        return min(width, most)


def _high(durations: Sequence[float]) -> float:
    return sorted(durations)[int(_SHARE * (len(durations) - 1) + 0.5)]


def deadline_search(
    model: ForwardModel,
    roots: Sequence[Any],
    observations: Observations,
    agent: Agent,
    settings: SearchSettings,
    deadline: float,
    pace: Pace,
    rng: np.random.Generator,
) -> SearchResult:
    """Choose one action per environment from as many candidates as there is time for.

    A round takes some candidates through all depths. Only finished rounds count; if there is none, the
    policy's own action is taken. The result depends on how fast the machine was.

    :param model: simulates the candidates.
    :param roots: present states of the environments.
    :param observations: ``[n_envs, *obs_shape]``, present observations.
    :param agent: networks, discount and scales.
    :param settings: depth, simulations, noise, and the number of candidates that is enough.
    :param deadline: when to be done, on the clock of ``pace``.
    :param pace: forecasts of this search, kept from decision to decision.
    :param rng: of the search: draws the noise, and is given to a model with random dynamics.
    :return: actions, and what the search found.
    """
    policy_actions = agent.policy(observations)
    n_envs, act_dim = policy_actions.shape
    enough = settings.max_beam_width or settings.beam_width
    candidates: list[np.ndarray] = []
    values: list[np.ndarray] = []
    first_steps: list[FirstStep] = []
    simulated_steps = done = 0
    while done < enough:
        start = pace.clock()
        width = pace.affordable(deadline - start, enough - done)
        if width == 0:
            break
        noise = draw_noise(rng, replace(settings, beam_width=width, max_beam_width=None), n_envs, act_dim)
        proposed = propose(policy_actions, noise.beam, settings.include_policy_action and done == 0)
        try:
            round_values, first_step, steps = rollout_values(
                model, roots, proposed, agent, settings, noise, rng, lambda: pace.clock() > deadline
            )
        except OutOfTimeError as reason:
            simulated_steps += reason.simulated_steps
            pace.note_round(width, pace.clock() - start)
            break
        pace.note_round(width, pace.clock() - start)
        candidates.append(proposed)
        values.append(round_values)
        first_steps.append(first_step)
        simulated_steps += steps
        done += width

    start = pace.clock()
    if not done:
        pace.note_no_round()
        return _policy_alone(policy_actions, simulated_steps)
    merged = choose(
        policy_actions,
        np.concatenate(candidates, axis=1),
        np.concatenate(values, axis=1),
        _merge(first_steps, n_envs),
        simulated_steps,
    )
    pace.note_ending(pace.clock() - start)
    return merged._replace(rounds=len(candidates))


def _policy_alone(policy_actions: np.ndarray, simulated_steps: int) -> SearchResult:
    n_envs, act_dim = policy_actions.shape
    nothing = np.zeros((n_envs, 0))
    return SearchResult(
        actions=policy_actions,
        chosen=np.full(n_envs, -1),
        candidates=np.zeros((n_envs, 0, act_dim), dtype=policy_actions.dtype),
        values=nothing,
        first_step=None,
        simulated_steps=simulated_steps,
        invalid_rollouts=0,
        rounds=0,
    )


def _merge(first_steps: list[FirstStep], n_envs: int) -> FirstStep:
    """Put the first steps of several rounds, each ``[n_envs * width]``, into the order of one."""

    def join(arrays: list[Any]) -> np.ndarray:
        by_env = [array.reshape(n_envs, -1, *array.shape[1:]) for array in arrays]
        return np.concatenate(by_env, axis=1).reshape(-1, *arrays[0].shape[1:])

    seen: list[Any] = [step.observations for step in first_steps]
    observations = (
        {key: join([one[key] for one in seen]) for key in seen[0]}
        if isinstance(seen[0], dict)
        else join(seen)
    )
    return FirstStep(observations, join([step.rewards for step in first_steps]))
