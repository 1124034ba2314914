"""Search until a deadline: adds rounds of candidates while the next is expected to finish in time."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sb3_mcbs.search.beam import choose, join_rounds, short_horizon
from sb3_mcbs.search.interface import (
    CountedValue,
    PolicyFunctions,
    Rollouts,
    Roots,
    SearchResult,
    policy_alone,
)
from sb3_mcbs.search.proposals import draw_noise, propose
from sb3_mcbs.search.strategy_settings import BeamSettings
from sb3_mcbs.types import ForwardModel, Transition

#: Number of past durations in a forecast, and the quantiles for rounds and for single steps, which make
#: decisions late.
_MEMORY, _SHARE_OF_ROUNDS, _SHARE_OF_STEPS = 64, 0.75, 0.95
#: Known durations before a forecast may skip anything: the first ones are slow.
_WARM_UP = 10
#: Factors applied to a forecast each time it skips something: the machine may be faster now.
_RELAX_ROUND, _RELAX_STEP = 0.99, 0.98


class _Durations:
    """The last durations of a repeated operation."""

    def __init__(self) -> None:
        self._last: deque[float] = deque(maxlen=_MEMORY)

    def note(self, seconds: float) -> None:
        self._last.append(seconds)

    def relax(self, factor: float) -> None:
        """Lower the forecast, since skipped operations are not measured again."""
        self._last = deque((factor * seconds for seconds in self._last), maxlen=_MEMORY)

    def forecast(self, share: float) -> float:
        """The quantile of the durations; 0 if there are none yet."""
        return sorted(self._last)[int(share * (len(self._last) - 1) + 0.5)] if self._last else 0.0

    def known(self) -> bool:
        """Whether there are enough durations to skip something."""
        return len(self._last) >= _WARM_UP


class LatencyForecast:
    """Forecasts how long rounds take, from earlier ones.

    :param clock: returns monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock = clock
        self._rounds: dict[int, _Durations] = {}
        self._steps: dict[tuple[int, int], _Durations] = {}
        self.ending = _Durations()

    def note_round(self, width: int, seconds: float) -> None:
        """Record a round.

        :param width: number of candidates.
        :param seconds: its duration, or a lower bound if it was abandoned.
        """
        self._rounds.setdefault(width, _Durations()).note(seconds)

    def of_step(self, width: int, depth: int) -> _Durations:
        """The durations of one step of rounds."""
        return self._steps.setdefault((width, depth), _Durations())

    def of_round(self, width: int) -> float | None:
        """Seconds that a round will probably not exceed.

        :param width: number of candidates.
        :return: ``None`` before the first round.
        """
        if width in self._rounds:
            return self._rounds[width].forecast(_SHARE_OF_ROUNDS)
        if not self._rounds:
            return None
        # A round has fixed costs, so n times the candidates take less than n times as long.
        narrower = [known for known in self._rounds if known < width]
        nearest = max(narrower) if narrower else min(self._rounds)
        return self._rounds[nearest].forecast(_SHARE_OF_ROUNDS) * max(1.0, width / nearest)

    def affordable(self, seconds: float, most: int) -> int:
        """The number of candidates for the next round.

        An abandoned round is lost, so only the narrowest may take more than half of the remaining time.

        :param seconds: remaining time.
        :param most: number of remaining candidates.
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


class OutOfTimeError(Exception):
    """A round was abandoned before its rollouts were finished."""


class _WatchedModel(ForwardModel):
    """A forward model that abandons a round before a step that would be late, and measures steps.

    :param model: simulates.
    :param pace: forecasts durations.
    :param width: candidates of the round.
    :param deadline: on the clock of ``pace``.

    :ivar simulated_steps: steps so far.
    """

    def __init__(self, model: ForwardModel, pace: LatencyForecast, width: int, deadline: float) -> None:
        self.deterministic = model.deterministic
        self._model, self._pace, self._width, self._deadline = model, pace, width, deadline
        self._start = self._step_start = pace.clock()
        self._depth = -1
        self._expected = 0.0
        self.simulated_steps = 0

    @property
    def n_rows(self) -> int:
        return self._model.n_rows

    def read_roots(self, env_indices: Sequence[int]) -> list[Any]:
        return self._model.read_roots(env_indices)

    def set_roots(self, roots: Sequence[Any], index: np.ndarray, rng: np.random.Generator) -> None:
        self._model.set_roots(roots, index, rng)

    def select(self, index: np.ndarray) -> None:
        self._model.select(index)

    def step(self, actions: np.ndarray) -> Transition:
        if self._is_late():
            self._pace.note_round(self._width, self._expected)
            self._pace.of_step(self._width, self._depth).relax(_RELAX_STEP)
            raise OutOfTimeError
        self.simulated_steps += len(actions)
        return self._model.step(actions)

    def finish(self) -> None:
        """Record the finished round."""
        now = self._pace.clock()
        self._record_duration(now)
        self._pace.note_round(self._width, now - self._start)

    def _is_late(self) -> bool:
        now = self._pace.clock()
        self._record_duration(now)
        self._depth += 1
        self._step_start = now
        steps = self._pace.of_step(self._width, self._depth)
        step = steps.forecast(_SHARE_OF_STEPS)
        self._expected = now - self._start + step
        if not steps.known():
            return now > self._deadline
        return now + step + self._pace.ending.forecast(_SHARE_OF_STEPS) > self._deadline

    def _record_duration(self, now: float) -> None:
        if self._depth >= 0:
            self._pace.of_step(self._width, self._depth).note(now - self._step_start)


def deadline_search(
    roots: Roots,
    functions: PolicyFunctions,
    settings: BeamSettings,
    deadline: float,
    pace: LatencyForecast,
    rng: np.random.Generator,
    directions: np.ndarray | None = None,
) -> SearchResult:
    """Choose one action per environment from as many candidates as there is time for.

    A round rolls some candidates out to the full depth. Only finished rounds count; if there is none, the
    policy's own action is executed. The result depends on the machine's speed.

    :param roots: where the rollouts start.
    :param functions: networks, discount and scales.
    :param settings: depth, simulations, noise, and the largest number of candidates.
    :param deadline: latest end, on the clock of ``pace``.
    :param pace: forecasts of this search, kept between decisions.
    :param rng: draws the noise, and is given to a model with random dynamics.
    :param directions: ``[proposal_dims, act_dim]``, in which candidates differ; ``None``: all.
    :return: actions and details of the search.
    """
    assert roots.model is not None
    policy_actions = functions.policy(roots.observations)
    n_envs, act_dim = policy_actions.shape
    value = CountedValue(functions.value)
    functions = functions._replace(value=value, rollout=None)  # a round can be abandoned between its steps
    enough = settings.max_beam_width or settings.beam_width
    rounds: list[Rollouts] = []
    given_up = done = 0
    while done < enough:
        width = pace.affordable(deadline - pace.clock(), enough - done)
        if width == 0:
            break
        watched = _WatchedModel(roots.model, pace, width, deadline)
        noise = draw_noise(rng, settings, n_envs, act_dim, width, directions)
        with_policy = settings.include_policy_action and done == 0
        candidates, beam_noise = propose(policy_actions, noise.beam, with_policy)
        noise = noise._replace(beam=beam_noise)
        try:
            evaluated = short_horizon(
                roots._replace(model=watched), candidates, functions, settings, noise, rng
            )
        except OutOfTimeError:
            given_up = watched.simulated_steps
            break
        watched.finish()
        rounds.append(evaluated)
        done += width

    start = pace.clock()
    if rounds:
        joined = join_rounds(rounds)
        joined = joined._replace(simulated_steps=joined.simulated_steps + given_up)
        result = choose(policy_actions, joined)._replace(rounds=len(rounds))
        pace.ending.note(pace.clock() - start)
    else:
        result = policy_alone(policy_actions, given_up)
    return result._replace(critic_evaluations=value.evaluations)
