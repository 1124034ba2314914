"""Numbers over seeds: interquartile means with bootstrap intervals, probabilities of improvement."""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sb3_mcbs.experiments.report.runs import Competitor, Result, Results, at
from sb3_mcbs.zoo.evaluations import interquartile_mean

#: With fewer seeds there is no interval: it would pretend to know more than anybody does.
MIN_SEEDS = 3
#: Resamples of a bootstrap.
_REPEATS = 2000


class MissingPackageError(RuntimeError):
    """A package of the extra ``report`` is not installed; the message says how to install it."""


class Estimate(NamedTuple):
    """
    A number over seeds.

    :param value: the number
    :param low: lower end of its 95 % interval; None: too few seeds for one
    :param high: upper end
    :param n: seeds (per environment)
    """

    value: float
    low: float | None
    high: float | None
    n: int


@dataclass(frozen=True)
class Curve:
    """
    What all runs of a competitor in one task have reached.

    :param evaluations: index of each common evaluation, by run
    :param steps: environment steps of the common evaluations
    :param centre: interquartile mean
    :param low: of its interval; None: too few seeds
    :param high: of its interval; None: too few seeds
    :param n: seeds
    """

    evaluations: list[np.ndarray]
    steps: np.ndarray
    centre: np.ndarray
    low: np.ndarray | None
    high: np.ndarray | None
    n: int


def common_step(results: Results, task: str) -> int:
    """
    :param results: of a folder
    :param task: environment or agent
    :return: the largest step that all evaluated runs have reached
    """
    return min(run.last_step for run in results.of(task))


def finals(results: Results, task: str, competitor: Competitor) -> list[float]:
    """
    :param results: of a folder
    :param task: environment or agent
    :param competitor: arm and policy
    :return: of each run the mean return of the last evaluation until the common step, if it has one
    """
    step = common_step(results, task)
    policies = [run.policies[competitor.policy] for run in results.of(task, competitor)]
    return [float(each.means[index]) for each in policies if (index := at(each, step)) is not None]


def final_estimate(results: Results, task: str, competitor: Competitor) -> Estimate | None:
    """
    :param results: of a folder
    :param task: environment or agent
    :param competitor: arm and policy
    :return: interquartile mean of the final returns; None: there is no such run
    """
    values = finals(results, task, competitor)
    return _single(tuple(values)) if values else None


@functools.cache
def _single(values: tuple[float, ...]) -> Estimate:
    if len(values) == 1:
        return Estimate(values[0], None, None, 1)
    return _estimate([np.array(values)[:, None]], lambda scores: [_iqm(scores[:, :, None])[0]])


def _iqm(scores: np.ndarray) -> np.ndarray:
    """As rliable's ``aggregate_iqm`` of ``[runs, tasks, n]``, for each of the n at once."""
    return interquartile_mean(scores.reshape(-1, scores.shape[2]))


def _estimate(scores: list[np.ndarray], statistic: Callable[..., Any]) -> Estimate:
    """A statistic of one or two matrices ``[runs, tasks]``."""
    n = min(len(each) for each in scores)
    if n < MIN_SEEDS:
        return Estimate(float(statistic(*scores)[0]), None, None, n)
    value, (low, high) = _bootstrap(scores, statistic)
    if low[0] == high[0]:  # so few runs that all resamples agree, which is no certainty
        return Estimate(float(value[0]), None, None, n)
    return Estimate(float(value[0]), float(low[0]), float(high[0]), n)


def _bootstrap(scores: list[np.ndarray], statistic: Callable[..., Any]) -> tuple[np.ndarray, np.ndarray]:
    rliable = import_rliable()
    with _seeded():
        values, intervals = rliable.get_interval_estimates(
            {"": scores if len(scores) > 1 else scores[0]},
            lambda *each: np.array(statistic(*each)),
            reps=_REPEATS,
        )
    return values[""], intervals[""]


def import_rliable() -> Any:
    """
    :return: ``rliable.library``
    :raises MissingPackageError: if it is not installed
    """
    try:
        import rliable.library
    except ImportError as error:
        raise MissingPackageError(
            f"A report of several runs needs rliable ({error}). Install it: pip install 'sb3-mcbs[report]'"
        ) from error
    return rliable.library


@contextmanager
def _seeded() -> Iterator[None]:
    """The same report twice: rliable draws from NumPy's global generator."""
    state = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(state)


def common_steps(runs: list[Result], policy: str) -> list[int]:
    """
    :param runs: of one arm in one task
    :param policy: that was evaluated
    :return: the steps at which every run was
    """
    return sorted(set.intersection(*(set(run.policies[policy].timesteps.tolist()) for run in runs)))


def learning_curve(runs: list[Result], policy: str) -> Curve | None:
    """
    :param runs: of one arm in one task
    :param policy: of which the returns are
    :return: over the steps at which every run was evaluated; None: there are no such steps
    """
    steps = common_steps(runs, policy)
    if not steps:
        return None
    evaluations = [run.policies[policy] for run in runs]
    indices = [np.searchsorted(each.timesteps, steps) for each in evaluations]
    scores = np.stack([each.means[index] for each, index in zip(evaluations, indices, strict=True)])[:, None]
    low = high = None
    if len(runs) >= MIN_SEEDS:
        _, (low, high) = _bootstrap([scores], _iqm)
    centre = scores[0, 0] if len(runs) == 1 else _iqm(scores)
    return Curve(indices, np.array(steps), centre, low, high, len(runs))


def rival(results: Results, competitor: Competitor) -> Competitor | None:
    """
    :param results: of a folder
    :param competitor: arm and policy
    :return: the first arm with the same policy, or else alone; None: it is that itself
    """
    first = results.competitors[0].arm
    policies = [each.policy for each in results.competitors if each.arm == first]
    found = Competitor(first, competitor.policy if competitor.policy in policies else policies[0])
    return None if found == competitor else found


def matrix(results: Results, competitor: Competitor, scales: dict[str, float]) -> np.ndarray | None:
    """
    :param results: of a folder
    :param competitor: arm and policy
    :param scales: what returns are divided by, for each task
    :return: ``[runs, tasks]``, as many runs as every task has; None: a task has none
    """
    columns = [
        [value / scale for value in finals(results, task, competitor)] for task, scale in scales.items()
    ]
    n = min(len(column) for column in columns)
    return np.array([column[:n] for column in columns]).T if n else None


def overall(results: Results, competitor: Competitor, scales: dict[str, float]) -> Estimate | None:
    """
    :param results: of a folder
    :param competitor: arm and policy
    :param scales: what returns are divided by, for each task
    :return: interquartile mean over seeds and tasks; None: it has no runs in some task
    """
    scores = matrix(results, competitor, scales)
    if scores is None:
        return None
    return _estimate([scores], lambda each: [_iqm(each[:, :, None])[0]])


def improvement(
    results: Results, competitor: Competitor, other: Competitor, tasks: list[str]
) -> Estimate | None:
    """
    :param results: of a folder
    :param competitor: arm and policy
    :param other: that it is compared with
    :param tasks: environments or agents
    :return: the probability that a run of the one returns more than one of the other; None: some are missing
    """
    pair = [matrix(results, each, dict.fromkeys(tasks, 1.0)) for each in (competitor, other)]
    scores = [each for each in pair if each is not None]
    if len(scores) < 2:
        return None
    return _estimate(scores, _probability)


def _probability(ours: np.ndarray, theirs: np.ndarray) -> list[float]:
    """As rliable's ``probability_of_improvement``, without its test of significance, which takes long."""
    differences = ours[:, None] - theirs[None]
    return [float(np.mean((differences > 0) + 0.5 * (differences == 0)))]


def first_at(evaluations: Any, threshold: float) -> int | None:
    """
    :param evaluations: of one policy of a run
    :param threshold: a mean return
    :return: the first evaluation that reaches it; None: none does
    """
    reached = np.flatnonzero(evaluations.means >= threshold)
    return int(reached[0]) if reached.size else None


def first_near_best(evaluations: Any) -> int | None:
    """
    :param evaluations: of one policy of a run
    :return: the first evaluation at 90 % of the run's best; None: the best is not above zero
    """
    best = float(evaluations.means.max())
    return first_at(evaluations, 0.9 * best) if best > 0 else None


def falls(run: Result, evaluations: Any, index: int) -> float | None:
    """
    :param run: of the episodes
    :param evaluations: of one of its policies
    :param index: of the evaluation
    :return: the share of episodes that ended before the time limit; None: nobody knows
    """
    if evaluations.lengths is None or run.time_limit is None:
        return None
    return float(np.mean(evaluations.lengths[index] < run.time_limit))
