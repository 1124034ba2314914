"""The files beside a page: ``runs.csv``, and ``evaluations.csv``, which can be reported on in its turn."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_mcbs.experiments.report.runs import Result, Results
from sb3_mcbs.experiments.report.statistics import falls, first_near_best
from sb3_mcbs.zoo.evaluations import ACTOR, SEARCH, Evaluations, checked_evaluations
from sb3_mcbs.zoo.paths import PathError

#: What ``evaluations.csv`` says of a run, and of an evaluation; ``return_0``, ``length_0``, ... follow.
_OF_RUN = ("run", "arm", "task", "environment", "seed", "state", "settings")
_COSTS = ("timesteps", "simulated_steps", "seconds")


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
        for policy, each in run.policies.items():
            for index in range(len(each.timesteps)):
                record: dict[str, object] = {"run": run.name}
                record |= {name: getattr(run, name) for name in _OF_RUN[1:]}
                record["settings"] = json.dumps(run.settings, default=str)
                record |= {"policy": policy, **each.costs(index)}
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
    :raises PathError: if it is no such file, or of an older version
    """
    try:
        rows = pd.read_csv(
            path, dtype={"run": str, "arm": str, "task": str, "environment": str, "state": str}
        )
    except (OSError, ValueError) as error:  # pandas' own errors are ValueErrors
        raise PathError(f"{path} cannot be read: {error}") from error
    missing = [name for name in (*_OF_RUN, "policy", *_COSTS, "return_0") if name not in rows]
    if missing:
        raise PathError(
            f"{path} lacks the columns {', '.join(missing)}. Name the evaluations.csv of a report; an older "
            "one is written again by sb3-mcbs report FOLDER."
        )
    if not rows["policy"].isin([ACTOR, SEARCH]).all():
        raise PathError(f"{path} has a policy that is neither {ACTOR!r} nor {SEARCH!r}.")
    if rows.empty:
        raise PathError(f"{path} has no rows.")
    keys = list(_OF_RUN)
    runs = [_result(path, key, part) for key, part in rows.groupby(keys, sort=False, dropna=False)]
    frozen = any(run.task != run.environment for run in runs)
    return Results(path.stem, runs, [], frozen)


def _result(path: Path, key: Any, rows: pd.DataFrame) -> Result:
    run = dict(zip(_OF_RUN, key, strict=True))
    run["seed"] = None if pd.isna(run["seed"]) else int(run["seed"])
    where = f"{path}, {run['run']}"
    try:
        run["settings"] = dict(json.loads(run["settings"]))
    except (ValueError, TypeError) as error:
        raise PathError(f"{where}: the settings {run['settings']!r} are no JSON object.") from error
    policies = {policy: _evaluations(where, part) for policy, part in rows.groupby("policy")}
    return Result(name=run.pop("run"), folder=path, policies=policies, **run)


def _evaluations(where: str, rows: pd.DataFrame) -> Evaluations:
    arrays: dict[str, np.ndarray] = {"timesteps": rows["timesteps"].to_numpy()}
    for name, prefix in (("returns", "return"), ("lengths", "length")):
        # Other runs may have more episodes.
        values = rows.filter(regex=rf"^{prefix}_\d+$").dropna(axis="columns", how="all")
        if len(values.columns):
            arrays[name] = values.to_numpy()
    for name in _COSTS[1:]:
        if rows[name].notna().all():
            arrays[name] = rows[name].to_numpy()
    return checked_evaluations(arrays, where)
