"""The files beside a page: ``runs.csv``, and ``evaluations.csv``, which can be reported on in its turn."""

import csv
import json
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_mcbs.experiments.report.runs import Result, Results
from sb3_mcbs.experiments.report.statistics import falls, first_near_best
from sb3_mcbs.zoo.evaluations import ACTOR, SEARCH, Evaluations, checked_evaluations
from sb3_mcbs.zoo.paths import PathError

#: What ``evaluations.csv`` says of a run: which one it is, and how it is now.
_IDENTITY = ("run", "arm", "task", "environment", "seed")
_LAST = ("state", "settings")
#: And of an evaluation; ``return_0``, ``length_0``, ... follow.
_COSTS = ("timesteps", "simulated_steps", "seconds")
_TEXT = ("run", "arm", "task", "environment", *_LAST, "policy")


def write_csv_files(results: Results, folder: Path) -> None:
    """
    :param results: of a folder
    :param folder: to write to
    """
    _write(folder / "runs.csv", _run_records(results))
    _write(folder / "evaluations.csv", _evaluation_records(results))


def _write(path: Path, records: list[dict[str, object]]) -> None:
    # What a row lacks stays empty.
    names = list(dict.fromkeys(name for record in records for name in record))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(records)


def _run_records(results: Results) -> list[dict[str, object]]:
    records: list[dict[str, object]] = []
    for run in results.runs:
        record: dict[str, object] = {"run": run.name, "arm": run.arm, results.unit: run.task}
        record |= {"environment": run.environment, "seed": run.seed, "state": run.state}
        for policy, each in run.policies.items():
            label = policy.replace(" ", "_")
            near = first_near_best(each)
            record |= each.costs(-1)
            record[f"{label}_return"] = float(each.means[-1])
            record[f"{label}_90_percent_timesteps"] = None if near is None else int(each.timesteps[near])
            record[f"{label}_mean_length"] = None if each.lengths is None else float(each.lengths[-1].mean())
            record[f"{label}_ended_early"] = falls(run, each, -1)
        records.append(record)
    return records


def _evaluation_records(results: Results) -> list[dict[str, object]]:
    records: list[dict[str, object]] = []
    for run in results.evaluated:
        of_run: dict[str, object] = {name: getattr(run, name) for name in (*_IDENTITY[1:], *_LAST)}
        of_run = {"run": run.name, **of_run, "settings": json.dumps(run.settings, default=str)}
        for policy, each in run.policies.items():
            for index in range(len(each.timesteps)):
                record = {**of_run, "policy": policy, **each.costs(index)}
                record["mean_return"] = float(each.means[index])
                for episode, value in enumerate(each.returns[index]):
                    record[f"return_{episode}"] = float(value)
                    if each.lengths is not None:
                        record[f"length_{episode}"] = int(each.lengths[index, episode])
                records.append(record)
    return records


def read_evaluations(path: Path) -> Results:
    """
    Read the runs of a report again, without the folders that it was written from.

    :param path: an ``evaluations.csv``
    :return: its runs, without their machines, which the file does not have
    :raises PathError: if it is no such file, or of an older version, or has values that cannot be
    """
    if path.suffix == ".npz":
        raise PathError(f"{path} is a part of a run: name its folder, {path.parent}.")
    try:
        # Only an empty cell is none: an arm may be called "null".
        rows = pd.read_csv(path, keep_default_na=False, na_values=[""], float_precision="round_trip")
    except (OSError, ValueError) as error:  # pandas' own errors are ValueErrors
        raise PathError(f"{path} cannot be read: {error}") from error
    _check_rows(path, rows)
    rows = rows.astype(dict.fromkeys(_TEXT, str))
    # Its state and settings are those of the last row.
    runs = [_result(path, part) for _, part in rows.groupby(list(_IDENTITY), sort=False, dropna=False)]
    frozen = any(run.settings.get("algorithm") in ("actor", "search") for run in runs)
    return Results(_name(path), runs, [], frozen)


def _name(path: Path) -> str:
    """What the source is called: for ``FOLDER/report/evaluations.csv`` the folder."""
    names = [path.stem, *(parent.name for parent in path.absolute().parents)]
    return next(name for name in names if name not in ("evaluations", "report"))


def _check_rows(path: Path, rows: pd.DataFrame) -> None:
    if len(rows.columns) == 1:
        raise PathError(f"{path} has one column: its values must be separated by commas.")
    missing = [name for name in (*_IDENTITY, *_LAST, "policy", *_COSTS, "return_0") if name not in rows]
    if missing:
        raise PathError(
            f"{path} lacks the columns {', '.join(missing)}. Name the evaluations.csv of a report; an older "
            "one is written again by sb3-mcbs report FOLDER."
        )
    if rows.empty:
        raise PathError(f"{path} has no rows.")
    for name in (*_TEXT, "timesteps"):
        if rows[name].isna().any():
            raise PathError(f"{path} has no {name} in row {int(rows[name].isna().argmax()) + 2}.")
    if not rows["policy"].isin([ACTOR, SEARCH]).all():
        raise PathError(f"{path} has a policy that is neither {ACTOR!r} nor {SEARCH!r}.")
    seeds = pd.to_numeric(rows["seed"].dropna(), errors="coerce")
    if not np.all(np.isfinite(seeds) & (seeds % 1 == 0)):
        raise PathError(f"{path} has a seed that is no integer.")


def _result(path: Path, rows: pd.DataFrame) -> Result:
    last = rows.iloc[-1]
    where = f"{path}, {last['run']}"
    try:
        settings = dict(json.loads(last["settings"]))
    except (ValueError, TypeError) as error:
        raise PathError(f"{where}: the settings {last['settings']} are no JSON object.") from error
    return Result(
        name=last["run"],
        arm=last["arm"],
        task=last["task"],
        environment=last["environment"],
        seed=None if pd.isna(last["seed"]) else int(last["seed"]),
        state=last["state"],
        folder=path,
        policies={policy: _evaluations(where, part) for policy, part in rows.groupby("policy")},
        settings=settings,
    )


def _evaluations(where: str, rows: pd.DataFrame) -> Evaluations:
    arrays: dict[str, np.ndarray] = {"timesteps": rows["timesteps"].to_numpy()}
    for name, prefix in (("returns", "return"), ("lengths", "length")):
        # Other runs may have more episodes.
        values = rows.filter(regex=rf"^{prefix}_\d+$").dropna(axis="columns", how="all")
        if values.isna().any(axis=None):
            raise PathError(f"{where} has evaluations with fewer episodes than others, by {prefix}s.")
        if len(values.columns):
            arrays[name] = np.ascontiguousarray(values.to_numpy())
    for name in _COSTS[1:]:
        if rows[name].notna().any():
            arrays[name] = rows[name].to_numpy()
    return checked_evaluations(arrays, where)
