"""Returns beside one another: of arms, of published figures, by beam width and depth."""

import json
from typing import Any

import numpy as np

from sb3_mcbs.experiments.report.content import (
    Picture,
    Table,
    estimate_text,
    looks,
    name_of,
    number,
    row_label,
    slug,
)
from sb3_mcbs.experiments.report.drawing import Look, Row, draw_dots, draw_heat, tick
from sb3_mcbs.experiments.report.references import paper_beam, paper_finals, published_curves
from sb3_mcbs.experiments.report.runs import Competitor, Results
from sb3_mcbs.experiments.report.statistics import (
    Estimate,
    common_step,
    final_estimate,
    finals,
    improvement,
    overall,
    rival,
)


def final_picture(results: Results, task: str) -> Picture:
    """
    :param results: of a folder
    :param task: environment or agent
    :return: final returns of every seed, and published ones
    """
    look = looks(results)
    rows, cells = [], []
    for competitor in results.competitors:
        values = finals(results, task, competitor)
        estimate = final_estimate(results, task, competitor)
        if estimate is not None:
            name = name_of(results, competitor)
            rows.append(Row(row_label(name), look[competitor], values, estimate))
            spread = number(float(np.std(values, ddof=1))) if len(values) > 1 else "–"
            cells.append(
                [name, estimate_text(estimate), number(float(np.mean(values))), spread, str(len(values))]
            )
    environment = results.of(task)[0].environment
    n_own = len(rows)
    step = common_step(results, task)
    for name, (mean, std) in paper_finals(environment).items():
        rows.append(Row(f"paper's {name}, 1M", None, [], Estimate(mean, mean - std, mean + std, 1)))
        cells.append([f"paper's {name}, 1M (Table I)", "–", number(mean), number(std), "–"])
    for each in published_curves(environment):
        if each.name.startswith("RL Zoo") and step:
            place = int(np.searchsorted(each.steps, step, side="right")) - 1
            for index in sorted({place, len(each.steps) - 1} - {-1}):
                label = f"{each.name}, {tick(each.steps[index])}"
                value = float(each.returns[index])
                if each.name in ("RL Zoo TD3", "RL Zoo SAC"):
                    rows.append(Row(label, None, [], Estimate(value, None, None, 1)))
                cells.append([label, "–", number(value), "–", "1"])
    when = f"after {number(step)} environment steps" if not results.frozen else "of trained agents"
    return Picture(
        name=f"final-{slug(task)}",
        title=f"{task}: returns {when}",
        drawing=draw_dots(rows, "return"),
        alt="; ".join(f"{cell[0]}: {cell[1]}" for cell in cells[:n_own]) + ".",
        table=Table(
            f"Returns in {task} {when}",
            ["", "interquartile mean (95 % interval)", "mean", "standard deviation", "runs"],
            cells,
        ),
        note="Grey: published, with the standard deviation where it is known." if len(rows) > n_own else "",
    )


def overall_pictures(results: Results, scales: dict[str, float], by_what: str) -> list[Picture]:
    """
    :param results: of a folder
    :param scales: what returns are divided by, for each task; empty: they cannot be averaged over tasks
    :param by_what: what that is
    :return: means over all tasks and probabilities of improvement, as far as they exist
    """
    look = looks(results)
    pictures = []
    if len(scales) > 1:
        found = [(each, overall(results, each, scales)) for each in results.competitors]
        rows = [(each, estimate) for each, estimate in found if estimate is not None]
        if rows:
            pictures.append(
                Picture(
                    name="overall",
                    title=f"Interquartile mean over all {results.unit}s",
                    drawing=draw_dots(
                        [
                            Row(row_label(name_of(results, each)), look[each], [], value)
                            for each, value in rows
                        ],
                        "return divided by the reference",
                    ),
                    alt="; ".join(f"{name_of(results, each)}: {estimate_text(value)}" for each, value in rows)
                    + ".",
                    table=Table(
                        "Interquartile mean of normalised returns",
                        ["", "interquartile mean (95 % interval)", f"runs per {results.unit}"],
                        [
                            [name_of(results, each), estimate_text(value), str(value.n)]
                            for each, value in rows
                        ],
                    ),
                    note=f"Returns are divided by {by_what}.",
                )
            )
    for tasks in [[task] for task in results.tasks] + ([results.tasks] if len(results.tasks) > 1 else []):
        pictures += _improvement(results, tasks, look)
    return pictures


def _improvement(results: Results, tasks: list[str], look: dict[Competitor, Look]) -> list[Picture]:
    rows = []
    for each in results.competitors:
        other = rival(results, each)
        value = improvement(results, each, other, tasks) if other else None
        if other is not None and value is not None and value.n > 1:
            rows.append((each, other, value))
    if not rows:
        return []
    where = tasks[0] if len(tasks) == 1 else f"All {results.unit}s"
    return [
        Picture(
            name=f"improvement-{slug(where)}",
            title=f"{where}: probability of improvement",
            drawing=draw_dots(
                [Row(row_label(name_of(results, each)), look[each], [], value) for each, _, value in rows],
                "probability of a higher return than the baseline's",
                at=0.5,
                unit=True,
            ),
            alt="; ".join(
                f"{name_of(results, each)} over {name_of(results, other)}: {estimate_text(value)}"
                for each, other, value in rows
            )
            + ".",
            table=Table(
                f"Probability that a run returns more than one of the baseline, {where}",
                ["", "baseline", "probability (95 % interval)", "fewest runs"],
                [
                    [name_of(results, each), name_of(results, other), estimate_text(value), str(value.n)]
                    for each, other, value in rows
                ],
            ),
        )
    ]


def heat_pictures(results: Results) -> list[Picture]:
    """
    :param results: of a folder
    :return: returns by beam width and rollout depth, where arms differ in both, and the paper's
    """
    groups: dict[tuple[str, str, Competitor], dict[tuple[int, int], Estimate]] = {}
    for task in results.tasks:
        for competitor in results.competitors:
            for run in results.of(task, competitor)[:1]:
                settings = dict(run.settings)
                cell = settings.pop("beam_width", None), settings.pop("rollout_depth", None)
                estimate = final_estimate(results, task, competitor)
                if None not in cell and estimate is not None:
                    arm = competitor.arm.split("-beam_width=")[0].split("-rollout_depth=")[0]
                    rest = json.dumps(settings, sort_keys=True, default=str)
                    groups.setdefault((task, rest, Competitor(arm, competitor.policy)), {})[cell] = estimate
    pictures = []
    names: dict[str, Any] = {}
    for (task, _, competitor), cells in groups.items():
        if len({width for width, _ in cells}) > 1 or len({depth for _, depth in cells}) > 1:
            title = f"{task}: {name_of(results, competitor)}"
            name = f"beam-{slug(title)}"
            names[name] = names.get(name, 0) + 1
            suffix = f"-{names[name]}" if names[name] > 1 else ""
            pictures.append(
                _heat(name + suffix, title, {cell: (each.value, each.n) for cell, each in cells.items()})
            )
    shown = {run.environment for task in results.tasks for run in results.of(task)}
    if pictures and any(environment.startswith("HalfCheetah") for environment in shown):
        paper = paper_beam()
        pictures.append(
            _heat("beam-paper", "The paper's Table II: HalfCheetah-v4, MCBS-TD3, 1M steps", paper)
        )
    return pictures


def _heat(name: str, title: str, cells: dict[tuple[int, int], tuple[float, float]]) -> Picture:
    widths, depths = sorted({width for width, _ in cells}), sorted({depth for _, depth in cells})
    values = np.array([[cells.get((width, depth), (np.nan, 0))[0] for depth in depths] for width in widths])
    second = (
        (lambda each: f"± {number(each)}")
        if name == "beam-paper"
        else (lambda each: f"{each} run{'s' * (each > 1)}")
    )
    text = [
        [
            f"{number(cells[width, depth][0])}\n{second(cells[width, depth][1])}"
            if (width, depth) in cells
            else "–"
            for depth in depths
        ]
        for width in widths
    ]
    best = max(cells, key=lambda cell: cells[cell][0])
    return Picture(
        name=name,
        title=title,
        drawing=draw_heat(values, widths, depths, text),
        alt=f"The highest return, {number(cells[best][0])}, is that of width {best[0]} and depth {best[1]}.",
        table=Table(
            "Return by beam width (rows) and rollout depth (columns)",
            ["B", *(f"D = {depth}" for depth in depths)],
            [
                [str(width), *(cell.replace("\n", ", ") for cell in row)]
                for width, row in zip(widths, text, strict=True)
            ],
        ),
    )
