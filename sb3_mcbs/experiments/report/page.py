"""The page: what stands on it, and in which order."""

import time
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import jinja2
from markupsafe import Markup

from sb3_mcbs.experiments.report.comparisons import final_picture, heat_pictures, overall_pictures
from sb3_mcbs.experiments.report.content import Picture, Table, estimate_text, name_of, number
from sb3_mcbs.experiments.report.curves import curve_pictures, simulates
from sb3_mcbs.experiments.report.drawing import COLOURS
from sb3_mcbs.experiments.report.references import published_curves, sources
from sb3_mcbs.experiments.report.runs import Results, at, short
from sb3_mcbs.experiments.report.statistics import MIN_SEEDS, common_step, common_steps, final_estimate
from sb3_mcbs.experiments.report.tables import episode_table, machine_table, run_table, speed_table
from sb3_mcbs.experiments.results import FINISHED
from sb3_mcbs.zoo.evaluations import SEARCH

#: The colours of pictures on a dark background, in the order of ``COLOURS``.
_DARK = ("#4ba3e3", "#f58a3c", "#2cc295", "#e3a3c6", "#f0b93a", "#a5d8f7")
_REFERENCE = "RL Zoo TD3"


@dataclass(frozen=True)
class Section:
    """
    A part of the page.

    :param name: of its anchor
    :param title: its heading
    :param text: what one reads first
    :param pictures: with their tables
    :param tables: those that stand alone
    """

    name: str
    title: str
    text: list[str]
    pictures: list[Picture] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)


def sections(results: Results) -> list[Section]:
    """
    :param results: of a folder
    :return: the parts of the page
    """
    found = [
        Section(
            "returns", "Returns", _about_returns(results), [final_picture(results, t) for t in results.tasks]
        )
    ]
    if len(results.evaluated) > 1:
        scales, by_what = _scales(results)
        pictures = overall_pictures(results, scales, by_what)
        if pictures:
            found.append(
                Section("comparison", "Comparison", _about_comparison(results, by_what, pictures), pictures)
            )
    if not results.frozen:
        curves = [picture for task in results.tasks for picture in curve_pictures(results, task)]
        found.append(Section("curves", "Learning curves", _about_curves(results), curves))
    heat = heat_pictures(results)
    if heat:
        found.append(
            Section(
                "beam",
                "Beam width and rollout depth",
                ["Returns as in the first section. Lighter is higher."],
                heat,
            )
        )
    if not results.frozen:
        found.append(Section("speed", "How soon", _about_speed(), tables=[speed_table(results)]))
    found.append(Section("episodes", "Episodes", _about_episodes(), tables=[episode_table(results)]))
    found.append(Section("runs", "Every run", [], tables=[run_table(results)]))
    return found


def render(results: Results, parts: list[Section], commands: list[str]) -> str:
    """
    :param results: of a folder
    :param parts: of the page
    :param commands: that make it again
    :return: the page
    """
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    template = environment.from_string((Path(__file__).parent / "page.html").read_text(encoding="utf-8"))
    used = {run.environment for run in results.evaluated}
    return template.render(
        results=results,
        date=time.strftime("%Y-%m-%d"),
        kind=_kind(results),
        facts=_facts(results),
        parts=parts,
        commands=commands,
        machines=machine_table(results),
        sources=sources() if any(published_curves(each) for each in used) else {},
        light=COLOURS,
        dark=_DARK,
        version=version("sb3-mcbs"),
        svg=lambda picture: Markup(picture.inline),
        of_number=lambda cell: Markup(' class="number"') if cell[:1] in "0123456789−–" else "",
    )


def _kind(results: Results) -> str:
    if results.frozen:
        return "An experiment with trained agents: nothing was trained."
    if results.spec is not None:
        return "An experiment: arms, environments and seeds of one spec."
    return "Several runs." if len(results.runs) > 1 else "One run."


def _facts(results: Results) -> list[tuple[str, str]]:
    """Name and value of what the page says first."""
    finished = sum(run.state == FINISHED for run in results.runs)
    longest = [max(run.policies.values(), key=lambda each: each.timesteps[-1]) for run in results.evaluated]
    simulated = [each.simulated_steps[-1] for each in longest if each.simulated_steps is not None]
    seconds = [each.seconds[-1] for each in longest if each.seconds is not None]
    facts = [("Runs", f"{finished} of {len(results.runs)} finished")]
    if not results.frozen:
        facts.append(("Environment steps", number(float(sum(each.timesteps[-1] for each in longest)))))
    if simulated:
        facts.append(("Steps of the search", number(float(sum(simulated)))))
    if seconds:
        what = "Hours of acting" if results.frozen else "Hours of training"
        facts.append((what, number(float(sum(seconds)) / 3600)))
    unknown = len(longest) - min(len(simulated), len(seconds))
    if unknown:
        facts.append(
            (
                "Cost not recorded",
                f"for {unknown} of {len(longest)} runs, which are drawn over environment steps only",
            )
        )
    return facts


def _about_returns(results: Results) -> list[str]:
    if len(results.evaluated) == 1:
        return ["The mean return over the episodes of the last evaluation."]
    text = [
        "The return of a run is the mean over the episodes of one evaluation. Each stroke is a run, the "
        "marker their interquartile mean (of three or fewer, their mean), the bar its 95 % interval by "
        f"stratified bootstrap over seeds. With fewer than {MIN_SEEDS} runs there is no interval; with "
        "three to five it is a rough one: a bootstrap knows nothing beyond the runs that it has."
    ]
    for task in [] if results.frozen else results.tasks:
        runs, step = results.of(task), common_step(results, task)
        ahead = max(run.last_step for run in runs)
        behind = [run.name for run in runs if run.last_step == step]
        if ahead > step:
            others = f" and {len(behind) - 1} more" if len(behind) > 1 else ""
            text.append(
                f"In {task} runs are compared after {number(step)} environment steps, the most that all of "
                f"them have reached. {behind[0]}{others} came no further; others have {number(ahead)}."
            )
        indices = [(run, each, at(each, step)) for run in runs for each in run.policies.values()]
        if any(index is not None and each.timesteps[index] != step for _, each, index in indices):
            text.append(
                f"Some runs in {task} were not evaluated at that step, but before: the table of episodes "
                "says when."
            )
        late = list(dict.fromkeys(run.name for run, _, index in indices if index is None))
        if late:
            text.append(f"Not compared in {task}, since first evaluated later: {', '.join(late)}.")
    return text


def _about_comparison(results: Results, by_what: str, pictures: list[Picture]) -> list[str]:
    unit = results.unit
    text = [f"The baseline is {short(results.competitors[0].arm)}."]
    if any(picture.name.startswith("improvement") for picture in pictures):
        text[0] += (
            " Probability of improvement: how often a run of the arm returns more than a run of the baseline "
            "with the same policy, or with its only one. Above 0.5 the arm is better; where the interval "
            "contains 0.5, chance may explain it. Where all resamples agree there is no interval: so few "
            "runs cannot say how sure that is."
        )
    if len(results.tasks) > 1:
        text.append(
            f"For means over {unit}s returns are divided by {by_what}. They take as many runs of each "
            f"{unit} as the one with the fewest has, in the order of their seeds; arms that lack one "
            "are left out."
            if by_what
            else f"There is no mean over {unit}s: in some the baseline has no return above zero to divide by."
        )
    return text


def _about_curves(results: Results) -> list[str]:
    if len(results.evaluated) == 1:
        return []
    text = [
        "Thick: the interquartile mean over seeds, at steps at which all runs of an arm were evaluated. "
        f"The band is its 95 % interval, from {MIN_SEEDS} seeds on. Thin: every seed. Over simulated steps "
        "and time, the thick line stands at the mean cost of its runs."
    ]
    nowhere = [task for task in results.tasks if not simulates(results, task)]
    if nowhere:
        text.append(
            f"In {', '.join(nowhere)} no training simulated steps besides those of the environment, or "
            "nobody recorded them: there are no curves over simulated steps."
        )
    text += [
        f"No curve of {each.label} in {task}: its runs were never evaluated at the same step."
        for task in results.tasks
        for each in results.competitors
        if results.of(task, each) and not common_steps(results.of(task, each), each.policy)
    ]
    if not any(each.policy == SEARCH for each in results.competitors):
        text.append("No run was evaluated with search.")
    return text


def _about_speed() -> list[str]:
    return [
        "90 %: the first evaluation that reaches 90 % of the run's own best mean return, where that is "
        "above zero. Baseline: the first that reaches the mean return of the baseline in the first "
        "section, with the same policy if it has it. A dash: it never did, or nobody recorded it. Steps of "
        "the search and hours are those of training: evaluations do not count."
    ]


def _about_episodes() -> list[str]:
    return [
        "Of the evaluation in the first section. Ended early: the share of episodes that were over before "
        "the time limit of the environment; of walkers and hoppers these are falls."
    ]


def _scales(results: Results) -> tuple[dict[str, float], str]:
    """What returns are divided by so that tasks can be averaged, and what that is."""
    zoo = {}
    for task in results.tasks:
        for curve in published_curves(results.of(task)[0].environment):
            if curve.name == _REFERENCE:
                zoo[task] = float(curve.returns[-1])
    if zoo.keys() == set(results.tasks):
        return zoo, "the return of RL Zoo's published TD3 agent after 1,000,000 steps"
    baseline = results.competitors[0]
    found = {task: final_estimate(results, task, baseline) for task in results.tasks}
    own = {task: each.value for task, each in found.items() if each is not None and each.value > 0}
    if own.keys() == set(results.tasks):
        return own, f"the interquartile mean of {name_of(results, baseline)}"
    return {}, ""


def summary(results: Results) -> list[str]:
    """
    :param results: of a folder
    :return: what the command prints: returns of all arms
    """
    finished = sum(run.state == FINISHED for run in results.runs)
    lines = [f"{len(results.runs)} run{'s' * (len(results.runs) > 1)}, {finished} finished"]
    for task in results.tasks:
        when = "" if results.frozen else f", interquartile mean after {common_step(results, task)} steps"
        lines.append(f"{task}{when}:")
        for competitor in results.competitors:
            estimate = final_estimate(results, task, competitor)
            if estimate is not None:
                runs = f"{estimate.n} run{'s' * (estimate.n > 1)}"
                lines.append(f"  {name_of(results, competitor):32} {estimate_text(estimate)}, {runs}")
    return lines
