"""Learning curves, and the numbers beside each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from sb3_mcbs.experiments.report.content import (
    Picture,
    Table,
    estimate_text,
    legend,
    looks,
    name_of,
    number,
    slug,
)
from sb3_mcbs.experiments.report.drawing import Line, draw_curves
from sb3_mcbs.experiments.report.references import published_curves
from sb3_mcbs.experiments.report.runs import Competitor, Result, Results
from sb3_mcbs.experiments.report.statistics import Curve, Estimate, learning_curve
from sb3_mcbs.zoo.evaluations import Evaluations

#: The curves of a task, with the runs that they are of.
Curves = dict[Competitor, tuple[Curve, list[Result]]]


@dataclass(frozen=True)
class Axis:
    """
    What returns are drawn over.

    :param name: in names of files
    :param title: in titles
    :param label: of the axis
    :param of: its values from evaluations; None: they were not recorded
    :param log: whether it is logarithmic
    """

    name: str
    title: str
    label: str
    of: Callable[[Evaluations], np.ndarray | None] = field(repr=False)
    log: bool = False


def _simulated(evaluations: Evaluations) -> np.ndarray | None:
    return (
        None if evaluations.simulated_steps is None else evaluations.timesteps + evaluations.simulated_steps
    )


def _hours(evaluations: Evaluations) -> np.ndarray | None:
    return None if evaluations.seconds is None else evaluations.seconds / 3600


def _minutes(evaluations: Evaluations) -> np.ndarray | None:
    return None if evaluations.seconds is None else evaluations.seconds / 60


STEPS = Axis("steps", "environment steps", "environment steps", lambda each: each.timesteps)
SIMULATED = Axis(
    "simulated",
    "simulated steps",
    "steps of the environment and of the search (logarithmic)",
    _simulated,
    log=True,
)
HOURS = Axis("time", "wall-clock time", "hours of training, without evaluations", _hours)
MINUTES = Axis("time", "wall-clock time", "minutes of training, without evaluations", _minutes)


def curve_pictures(results: Results, task: str) -> list[Picture]:
    """
    :param results: of a folder
    :param task: environment
    :return: learning curves over each axis that was recorded, and beside published ones
    """
    curves: Curves = {}
    for competitor in results.competitors:
        runs = results.of(task, competitor)
        curve = learning_curve(runs, competitor.policy) if runs else None
        if curve is not None:
            curves[competitor] = curve, runs
    times = [
        hours[-1]
        for run in results.of(task)
        for each in run.policies.values()
        if (hours := _hours(each)) is not None
    ]
    pictures = []
    axes = [STEPS, HOURS if times and max(times) >= 2 else MINUTES]
    if simulates(results, task):
        axes.insert(1, SIMULATED)
    for axis in axes:
        picture = _curves(results, task, axis, curves)
        if picture is not None:
            pictures.append(picture)
    beside = _beside_published(results, task, curves)
    return [*pictures, *([beside] if beside else [])]


def simulates(results: Results, task: str) -> bool:
    """
    :param results: of a folder
    :param task: environment
    :return: whether some training simulated steps besides those of the environment
    """
    evaluations = [each for run in results.of(task) for each in run.policies.values()]
    return any(each.simulated_steps is not None and each.simulated_steps[-1] > 0 for each in evaluations)


def _curves(results: Results, task: str, axis: Axis, curves: Curves) -> Picture | None:
    look = looks(results)
    lines, shown = [], {}
    for competitor, (curve, runs) in curves.items():
        evaluations = [run.policies[competitor.policy] for run in runs]
        places = [axis.of(each) for each in evaluations]
        if any(place is None for place in places):
            continue
        xs = [place for place in places if place is not None]
        x = np.mean([place[index] for place, index in zip(xs, curve.evaluations, strict=True)], axis=0)
        each_run = [(place, each.means) for place, each in zip(xs, evaluations, strict=True)]
        lines.append(Line(look[competitor], x, curve.centre, curve.low, curve.high, each_run))
        shown[competitor] = x, curve
    if not lines:
        return None
    missing = [name_of(results, each) for each in curves if each not in shown]
    return Picture(
        name=f"curves-{slug(task)}-{axis.name}",
        title=f"{task}: returns over {axis.title}",
        drawing=draw_curves(lines, legend(list(shown), results), axis.label, axis.log),
        alt=_end_text(results, shown),
        table=_curve_table(results, task, axis, shown),
        note=f"Not recorded for {', '.join(missing)}." if missing else "",
    )


def _end_text(results: Results, shown: dict[Competitor, tuple[np.ndarray, Curve]]) -> str:
    ends = [
        f"{name_of(results, each)} ends at {number(curve.centre[-1])} after {number(curve.steps[-1])} steps"
        for each, (_, curve) in shown.items()
    ]
    return "; ".join(ends) + "."


def _curve_table(
    results: Results, task: str, axis: Axis, shown: dict[Competitor, tuple[np.ndarray, Curve]]
) -> Table:
    steps = sorted({int(step) for _, curve in shown.values() for step in curve.steps})
    rows = []
    for step in steps:
        row = [number(step)]
        for x, curve in shown.values():
            index = int(np.searchsorted(curve.steps, step))
            if index == len(curve.steps) or curve.steps[index] != step:
                row += ["–"] if axis is STEPS else ["–", "–"]
                continue
            low, high = (
                (None, None)
                if curve.low is None or curve.high is None
                else (curve.low[index], curve.high[index])
            )
            text = estimate_text(Estimate(float(curve.centre[index]), low, high, curve.n))
            row += [text] if axis is STEPS else [number(x[index]), text]
        rows.append(row)
    head = ["environment steps"]
    for each in shown:
        name = name_of(results, each)
        head += [name] if axis is STEPS else [f"{name}, {axis.label.split(',')[0].split(' (')[0]}", name]
    return Table(
        f"Interquartile mean of returns over seeds in {task}, 95 % interval where there are three", head, rows
    )


def _beside_published(results: Results, task: str, curves: Curves) -> Picture | None:
    environment = results.of(task)[0].environment
    end = max((int(curve.steps[-1]) for curve, _ in curves.values()), default=0)
    published = [
        (each.name, each.steps[each.steps <= end], each.returns[each.steps <= end])
        for each in published_curves(environment)
        if each.steps[0] <= end
    ]
    if not published:
        return None
    look = looks(results)
    lines = [
        Line(look[each], curve.steps, curve.centre, None, None, []) for each, (curve, _) in curves.items()
    ]
    steps = sorted({int(step) for _, steps, _ in published for step in steps})
    rows = [
        [name_of(results, each), *_at(curve.steps, curve.centre, steps)]
        for each, (curve, _) in curves.items()
    ]
    rows += [[name, *_at(x, y, steps)] for name, x, y in published]
    best = max(published, key=lambda each: each[2][-1])
    return Picture(
        name=f"published-{slug(task)}",
        title=f"{task}: beside published figures",
        drawing=draw_curves(lines, legend(list(curves), results), STEPS.label, published=published),
        alt=f"{_end_text(results, {each: (curve.steps, curve) for each, (curve, _) in curves.items()})} "
        f"The highest published figure then is {number(best[2][-1])}, of {best[0]}.",
        table=Table(
            f"Returns in {task}, published ones in other versions of it", ["", *map(number, steps)], rows
        ),
        note="Dotted lines: published by others, of bare policies, in older versions of the environment. "
        "Their evaluations and seeds are others' too; sources are at the end of the page.",
    )


def _at(x: np.ndarray, y: np.ndarray, steps: Sequence[int]) -> list[str]:
    known = dict(zip(x.tolist(), y.tolist(), strict=True))
    return [number(known.get(step)) for step in steps]
