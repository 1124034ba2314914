"""Where the runs of a report come from: folders and files, one or several."""

import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_mcbs.experiments.report.csv_files import read_evaluations
from sb3_mcbs.experiments.report.runs import Result, Results, load_folder
from sb3_mcbs.experiments.results import FINISHED
from sb3_mcbs.zoo.paths import PathError

#: What the same run has in every source.
_identity = attrgetter("name", "arm", "task", "seed")


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
    results = _join(
        paths, [read_evaluations(path) if path.is_file() else load_folder(path) for path in paths]
    )
    known = list(dict.fromkeys(run.arm for run in results.evaluated))
    for arm in [*(arms or []), *([] if baseline is None else [baseline])]:
        if arm not in known:
            where = " and ".join(map(str, paths))
            raise PathError(f"There is no arm {arm!r} with evaluations in {where}, only {', '.join(known)}.")
    if arms is None:
        runs = list(results.runs)
    elif baseline is None or baseline in arms:
        runs = sorted((run for run in results.runs if run.arm in arms), key=lambda run: arms.index(run.arm))
    else:
        raise PathError(f"The baseline {baseline} is none of the arms to show: {', '.join(arms)}.")
    runs.sort(key=lambda run: baseline is not None and run.arm != baseline)
    return replace(results, runs=runs)


def _join(paths: Sequence[Path], parts: list[Results]) -> Results:
    """Several sources as one, every run once."""
    if len(parts) == 1:
        return parts[0]
    _check(paths, parts)
    problems = [problem for part in parts for problem in part.problems]
    kept: list[Result] = []
    for run in _name_by_source(parts):
        place = next((place for place, other in enumerate(kept) if _are_one(other, run)), None)
        if place is None:
            kept.append(run)
            continue
        more, less = sorted((kept[place], run), key=_progress, reverse=True)
        if _compare(more, less).equal:
            more = replace(more, policies={**less.policies, **more.policies})
        else:
            problems.append(
                f"{run.name} is in {less.folder} and, with other returns, in {more.folder}. The latter is "
                "shown: it has more evaluations, or comes first."
            )
        kept[place] = more
    arms, tasks = ([getattr(run, name) for run in kept] for name in ("arm", "task"))
    kept.sort(key=lambda run: (arms.index(run.arm), tasks.index(run.task), run.seed is None, run.seed or 0))
    runs = [replace(run, name=name) for run, name in zip(kept, _unique([r.name for r in kept]), strict=True)]
    return Results(" and ".join(part.name for part in parts), runs, problems, parts[0].frozen)


def _check(paths: Sequence[Path], parts: list[Results]) -> None:
    """Refuse what cannot be compared."""
    if len({part.frozen for part in parts}) > 1:
        frozen = " and ".join(str(path) for path, part in zip(paths, parts, strict=True) if part.frozen)
        raise PathError(
            f"{frozen}: nothing was trained there, so that it cannot be reported together with training."
        )
    environments: dict[str, tuple[str, Path]] = {}
    for path, part in zip(paths, parts, strict=True):
        for run in part.runs:
            known, where = environments.setdefault(run.task, (run.environment, path))
            if known != run.environment:
                raise PathError(
                    f"{run.task!r} acts in {known} in {where}, and in {run.environment} in {path}: report "
                    "them apart, or give one of them another name."
                )


def _name_by_source(parts: list[Results]) -> list[Result]:
    """All runs. Arms of one name whose settings differ are different arms, and get their source's name."""
    settings = defaultdict(set)
    for run in [run for part in parts for run in part.runs if run.settings]:
        settings[run.arm].add(json.dumps(run.settings, sort_keys=True, default=str))
    return [
        replace(run, arm=f"{run.arm} ({name})") if len(settings[run.arm]) > 1 else run
        for part, name in zip(parts, _unique([part.name for part in parts]), strict=True)
        for run in part.runs
    ]


def _unique(names: list[str]) -> list[str]:
    """Names, numbered from the second of the same on."""
    so_far: Counter[str] = Counter()
    found = []
    for name in names:
        so_far[name] += 1
        found.append(name if so_far[name] == 1 else f"{name} ({so_far[name]})")
    return found


def _are_one(first: Result, second: Result) -> bool:
    """Whether two sources have the same run."""
    if first.folder.is_dir() and first.folder.resolve() == second.folder.resolve():
        return True
    if _identity(first) != _identity(second):
        return False
    # Without seeds only their returns can tell.
    common = _compare(first, second)
    return first.seed is not None or (common.n > 0 and common.equal)


class _Common(NamedTuple):
    """What two runs have in common.

    :param n: evaluations at the same steps
    :param equal: whether all of them have the same returns
    """

    n: int
    equal: bool


def _compare(first: Result, second: Result) -> _Common:
    n, equal = 0, True
    for policy in first.policies.keys() & second.policies.keys():
        one, other = first.policies[policy], second.policies[policy]
        _, of_one, of_other = np.intersect1d(one.timesteps, other.timesteps, return_indices=True)
        n += len(of_one)
        equal &= one.returns[of_one].tolist() == other.returns[of_other].tolist()
    return _Common(n, equal)


def _progress(run: Result) -> tuple[int, bool, bool]:
    """What is preferred of two that are the same run: of equal ones the first."""
    n_evaluations = sum(len(each.timesteps) for each in run.policies.values())
    return n_evaluations, run.state == FINISHED, run.folder.is_dir()
