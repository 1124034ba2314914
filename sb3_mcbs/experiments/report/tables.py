"""Tables that stand alone: how soon, episodes, every run, machines."""

from sb3_mcbs.experiments.report.content import Table, number
from sb3_mcbs.experiments.report.runs import Result, Results, at, short
from sb3_mcbs.experiments.report.statistics import (
    common_step,
    falls,
    finals,
    first_at,
    first_near_best,
    rival,
)
from sb3_mcbs.zoo.evaluations import ACTOR, SEARCH, Evaluations


def _cost(evaluations: Evaluations, index: int | None) -> list[str]:
    """Environment steps, steps of the search and hours until an evaluation."""
    if index is None:
        return ["–"] * 3
    timesteps, simulated, seconds = evaluations.costs(index).values()
    return [number(timesteps), number(simulated), number(None if seconds is None else seconds / 3600)]


def speed_table(results: Results) -> Table:
    """
    :param results: of a folder
    :return: what it cost until a run was good
    """
    rows = []
    for run in results.evaluated:
        for policy, evaluations in run.policies.items():
            first = first_near_best(evaluations)
            target = _baseline_return(results, run, policy)
            reached = None if target is None else first_at(evaluations, target)
            rows.append(
                [
                    short(run.name),
                    policy,
                    *_cost(evaluations, first),
                    number(target),
                    *_cost(evaluations, reached),
                ]
            )
    cost = ("steps", "steps of the search", "hours")
    head = [
        "run",
        "policy",
        *(f"90 %: {each}" for each in cost),
        "baseline's return",
        *(f"baseline: {each}" for each in cost),
    ]
    return Table("Cost until 90 % of the own best, and until the baseline's return", head, rows)


def _baseline_return(results: Results, run: Result, policy: str) -> float | None:
    competitor = next(each for each in results.competitors if (each.arm, each.policy) == (run.arm, policy))
    values = finals(results, run.task, rival(results, competitor) or competitor)
    return sum(values) / len(values) if values else None


def episode_table(results: Results) -> Table:
    """
    :param results: of a folder
    :return: how long the evaluated episodes were
    """
    rows = []
    for task in results.tasks:
        step = common_step(results, task)
        for run in results.of(task):
            for policy, evaluations in run.policies.items():
                index = at(evaluations, step)
                if index is None:
                    continue
                lengths = evaluations.lengths
                share = falls(run, evaluations, index)
                rows.append(
                    [
                        short(run.name),
                        policy,
                        number(float(evaluations.timesteps[index])),
                        str(evaluations.returns.shape[1]),
                        "–" if lengths is None else number(float(lengths[index].mean())),
                        "–" if lengths is None else number(float(lengths[index].min())),
                        "–" if run.time_limit is None else number(run.time_limit),
                        "–" if share is None else f"{100 * share:.0f} %",
                    ]
                )
    head = [
        "run",
        "policy",
        "environment steps",
        "episodes",
        "mean length",
        "shortest",
        "time limit",
        "ended early",
    ]
    return Table("Lengths of evaluation episodes", head, rows)


def run_table(results: Results) -> Table:
    """
    :param results: of a folder
    :return: every run as it was evaluated last
    """
    head = ["run", "arm", results.unit, "seed", "state", "environment steps"]
    head += [ACTOR, SEARCH, "steps of the search", "hours"]
    rows = []
    for run in results.runs:
        start = [
            short(run.name),
            short(run.arm),
            run.task,
            "–" if run.seed is None else str(run.seed),
            run.state,
        ]
        if not run.policies:
            rows.append([*start, *["–"] * 5])
            continue
        last = next(iter(run.policies.values()))
        returns = [
            number(float(run.policies[each].means[-1])) if each in run.policies else "–"
            for each in (ACTOR, SEARCH)
        ]
        steps, simulated, hours = _cost(last, -1)
        rows.append([*start, steps, *returns, simulated, hours])
    return Table("Every run, at its own last evaluation", head, rows)


def machine_table(results: Results) -> Table | None:
    """
    :param results: of a folder
    :return: versions and machine, and how many runs have them; None: nobody recorded them
    """
    found: dict[tuple[tuple[str, str], ...], int] = {}
    for run in results.runs:
        for machine in run.machines:
            key = tuple((name, str(value or "–")) for name, value in machine.items())
            found[key] = found.get(key, 0) + 1
    if not found:
        return None
    names = list(dict.fromkeys(name for key in found for name, _ in key))
    rows = [[name, *(dict(key).get(name, "–") for key in found)] for name in names]
    return Table(
        "Machine and versions",
        ["", *(f"of {count} run{'s' * (count > 1)}" for count in found.values())],
        rows,
    )
