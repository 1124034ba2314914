"""Where the runs of a report come from: folders and files, one or several."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sb3_mcbs.experiments.report.csv_files import read_evaluations
from sb3_mcbs.experiments.report.runs import Result, Results, load_folder
from sb3_mcbs.zoo.paths import PathError


def load_results(*paths: Path, baseline: str | None = None, arms: Sequence[str] | None = None) -> Results:
    """
    Read runs, and choose what is reported.

    :param paths: folders (of an experiment or of one of its runs, RL Zoo's log folder or one of its runs), or
        the ``evaluations.csv`` of reports
    :param baseline: the arm that the others are compared with; None: the first
    :param arms: those that are shown, in this order; None: all
    :return: their runs; those that cannot be read are named among the problems
    :raises PathError: if nothing in a path has been evaluated, or there is no such arm
    """
    results = _join([read_evaluations(path) if path.is_file() else load_folder(path) for path in paths])
    found = list(dict.fromkeys(run.arm for run in results.evaluated))
    chosen = list(arms or found)
    _check(chosen, found, paths)
    _check([] if baseline is None else [baseline], chosen, paths)
    runs = [run for run in results.runs if arms is None or run.arm in chosen]
    if arms is not None:
        runs.sort(key=lambda run: chosen.index(run.arm))
    runs.sort(key=lambda run: baseline is not None and run.arm != baseline)
    return replace(results, runs=runs)


def _check(arms: list[str], known: list[str], paths: Sequence[Path]) -> None:
    for arm in arms:
        if arm not in known:
            raise PathError(
                f"There is no arm {arm!r} with evaluations in {' and '.join(map(str, paths))}, only "
                f"{', '.join(known)}."
            )


def _join(parts: list[Results]) -> Results:
    """Several sources as one, every run once."""
    if len(parts) == 1:
        return parts[0]
    if len({part.frozen for part in parts}) > 1:
        raise PathError("Runs that trained and agents that were trained before cannot be reported together.")
    runs: list[Result] = []
    problems = [problem for part in parts for problem in part.problems]
    known: dict[tuple[str, int], int] = {}
    for run in [run for part in parts for run in part.runs]:
        # Without a seed nobody can tell whether two runs of one name are the same.
        place = None if run.seed is None else known.setdefault((run.name, run.seed), len(runs))
        if place is None or place == len(runs):
            runs.append(run)
        elif run.policies:
            kept, left = runs[place], run
            if not kept.policies or run.last_step > kept.last_step:
                kept, left = run, kept
                runs[place] = run
            if left.policies and not _agree(kept, left):
                problems.append(
                    f"{run.name} is in {left.folder} and, with other returns, in {kept.folder}. The latter "
                    "is shown: it has more steps, or comes first."
                )
    arms = list(dict.fromkeys(run.arm for run in runs))
    runs.sort(key=lambda run: arms.index(run.arm))
    return Results(" and ".join(part.name for part in parts), runs, problems, parts[0].frozen)


def _agree(longer: Result, shorter: Result) -> bool:
    """Whether a run is the beginning of another."""
    return all(
        policy in longer.policies
        and longer.policies[policy].returns[: len(each.returns)].tolist() == each.returns.tolist()
        for policy, each in shorter.policies.items()
    )
