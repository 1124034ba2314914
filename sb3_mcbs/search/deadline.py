"""Search until a deadline: rounds of candidates are added while the next is expected to finish in time."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sb3_mcbs.search.beam import OutOfTimeError, choose, join_rounds, rollout_values
from sb3_mcbs.search.interface import CountedValue, FirstStep, PolicyFunctions, SearchResult
from sb3_mcbs.search.proposals import draw_noise, propose, without_first
from sb3_mcbs.search.strategy_settings import BeamSettings
from sb3_mcbs.types import ForwardModel, Observations

#: How many past durations a forecast looks at, and which share of them it covers: of rounds, and of single
#: steps, which are what makes a decision late.
_MEMORY, _SHARE_OF_ROUNDS, _SHARE_OF_STEPS = 64, 0.75, 0.95
#: So many durations must be known before anything is refused because of them: the first ones are slow.
_WARM_UP = 10
#: Factors of a forecast each time that something was not done because of it: the machine may be quicker now.
_RELAX_ROUND, _RELAX_STEP = 0.99, 0.98


class _Durations:
    """The last durations of something that is done again and again."""

    def __init__(self) -> None:
        self._last: deque[float] = deque(maxlen=_MEMORY)

    def note(self, seconds: float) -> None:
        self._last.append(seconds)

    def relax(self, factor: float) -> None:
        """Make the forecast less strict: what is not done any more cannot be learned again."""
        self._last = deque((factor * seconds for seconds in self._last), maxlen=_MEMORY)

    def forecast(self, share: float) -> float:
        """What that share of the durations did not exceed; 0 if there are none yet."""
        return sorted(self._last)[int(share * (len(self._last) - 1) + 0.5)] if self._last else 0.0

    def known(self) -> bool:
        """Whether there are enough to refuse something because of them."""
        return len(self._last) >= _WARM_UP


class LatencyForecast:
    """Forecasts how long rounds take, from those that were done.

    :param clock: seconds, rising.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock = clock
        self._rounds: dict[int, _Durations] = {}
        self._steps: dict[tuple[int, int], _Durations] = {}
        self.ending = _Durations()

    def note_round(self, width: int, seconds: float) -> None:
        """Learn from a round.

        :param width: its candidates.
        :param seconds: what it took, or would have taken at least if it had not been given up.
        """
        self._rounds.setdefault(width, _Durations()).note(seconds)

    def of_step(self, width: int, depth: int) -> _Durations:
        """The durations of one step of rounds."""
        return self._steps.setdefault((width, depth), _Durations())

    def of_round(self, width: int) -> float | None:
        """Seconds that a round will probably not exceed.

        :param width: its candidates.
        :return: ``None`` if no round was done yet.
        """
        if width in self._rounds:
            return self._rounds[width].forecast(_SHARE_OF_ROUNDS)
        if not self._rounds:
            return None
        # A round has fixed costs, so that n times the candidates take less than n times as long.
        narrower = [known for known in self._rounds if known < width]
        nearest = max(narrower) if narrower else min(self._rounds)
        return self._rounds[nearest].forecast(_SHARE_OF_ROUNDS) * max(1.0, width / nearest)

    def affordable(self, seconds: float, most: int) -> int:
        """The number of candidates for the next round.

        A round that is given up is lost, so none but the narrowest takes more than half of the time left.

        :param seconds: time left.
        :param most: candidates that are still wanted.
        :return: a power of two or ``most``; 0 if not even one candidate is expected to finish.
        """
        seconds -= self.ending.forecast(_SHARE_OF_STEPS)
        if seconds <= 0:
            return 0
        single = self._rounds.get(1)
        if single is not None and single.known() and single.forecast(_SHARE_OF_ROUNDS) > seconds:
            single.relax(_RELAX_ROUND)
            return 0
        width = 1
        while width < most:
            wider = min(2 * width, most)
            expected = self.of_round(wider)
            if expected is None or expected > seconds / 2:
                break
            width = wider
        return width


class _Watch:
    """Asked before every step of a round whether to give up; learns how long the steps take."""

    def __init__(self, pace: LatencyForecast, width: int, deadline: float) -> None:
        self._pace, self._width, self._deadline = pace, width, deadline
        self._start = self._step_start = pace.clock()
        self._depth = -1
        self.expected = 0.0

    def __call__(self) -> bool:
        now = self._pace.clock()
        self._note_step(now)
        self._depth += 1
        self._step_start = now
        steps = self._pace.of_step(self._width, self._depth)
        step = steps.forecast(_SHARE_OF_STEPS)
        self.expected = now - self._start + step
        if not steps.known():
            return now > self._deadline
        return now + step + self._pace.ending.forecast(_SHARE_OF_STEPS) > self._deadline

    def finish(self) -> None:
        """The round is finished."""
        now = self._pace.clock()
        self._note_step(now)
        self._pace.note_round(self._width, now - self._start)

    def give_up(self) -> None:
        """The round was given up."""
        self._pace.note_round(self._width, self.expected)
        self._pace.of_step(self._width, self._depth).relax(_RELAX_STEP)

    def _note_step(self, now: float) -> None:
        if self._depth >= 0:
            self._pace.of_step(self._width, self._depth).note(now - self._step_start)


def deadline_search(
    model: ForwardModel,
    roots: Sequence[Any],
    observations: Observations,
    functions: PolicyFunctions,
    settings: BeamSettings,
    deadline: float,
    pace: LatencyForecast,
    rng: np.random.Generator,
    directions: np.ndarray | None = None,
) -> SearchResult:
    """Choose one action per environment from as many candidates as there is time for.

    A round takes some candidates through all depths. Only finished rounds count; if there is none, the
    policy's own action is taken. The result depends on how fast the machine was.

    :param model: simulates the candidates.
    :param roots: present states of the environments.
    :param observations: ``[n_envs, *obs_shape]``, present observations.
    :param functions: networks, discount and scales.
    :param settings: depth, simulations, noise, and the number of candidates that is enough.
    :param deadline: when to be done, on the clock of ``pace``.
    :param pace: forecasts of this search, kept from decision to decision.
    :param rng: of the search: draws the noise, and is given to a model with random dynamics.
    :param directions: ``[proposal_dims, act_dim]``, in which candidates differ; ``None``: in all.
    :return: actions, and what the search found.
    """
    policy_actions = functions.policy(observations)
    value = CountedValue(functions.value)
    functions = functions._replace(value=value)
    n_envs, act_dim = policy_actions.shape
    enough = settings.max_beam_width or settings.beam_width
    candidates: list[np.ndarray] = []
    values: list[np.ndarray] = []
    first_steps: list[FirstStep] = []
    simulated_steps = done = 0
    while done < enough:
        width = pace.affordable(deadline - pace.clock(), enough - done)
        if width == 0:
            break
        watch = _Watch(pace, width, deadline)
        noise = draw_noise(rng, settings, n_envs, act_dim, width, directions)
        with_policy = settings.include_policy_action and done == 0
        if with_policy:
            noise = noise._replace(beam=without_first(noise.beam))
        proposed = propose(policy_actions, noise.beam, with_policy)
        try:
            round_values, first_step, steps = rollout_values(
                model, roots, proposed, functions, settings, noise, rng, out_of_time=watch
            )
        except OutOfTimeError as reason:
            simulated_steps += reason.simulated_steps
            watch.give_up()
            break
        watch.finish()
        candidates.append(proposed)
        values.append(round_values)
        first_steps.append(first_step)
        simulated_steps += steps
        done += width

    start = pace.clock()
    if not done:
        return _policy_alone(policy_actions, simulated_steps)._replace(critic_evaluations=value.evaluations)
    merged = choose(
        policy_actions,
        np.concatenate(candidates, axis=1),
        np.concatenate(values, axis=1),
        join_rounds(first_steps, n_envs),
        simulated_steps,
    )
    pace.ending.note(pace.clock() - start)
    return merged._replace(rounds=len(candidates), critic_evaluations=value.evaluations)


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
