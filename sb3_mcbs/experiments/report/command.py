"""``sb3-mcbs report FOLDER``: a page about all runs of a folder."""

import argparse
import csv
import shlex
import sys
from pathlib import Path

from sb3_mcbs.experiments.report.page import render, sections, summary
from sb3_mcbs.experiments.report.runs import Results, load_results
from sb3_mcbs.experiments.report.statistics import MissingPackageError, falls, first_near_best, import_rliable
from sb3_mcbs.zoo.evaluations import newest_run


def main() -> None:
    """Read the command line, write the page and say where it is."""
    parser = argparse.ArgumentParser(
        prog="sb3-mcbs report",
        description="A page with pictures and tables of an experiment, of RL Zoo's log folder, or of a run.",
    )
    parser.add_argument("folder", nargs="?", type=Path, help="without it, that of the newest run")
    parser.add_argument("--algo", default="mcbs_td3", help="algorithm of the newest run (%(default)s)")
    parser.add_argument("--env", default="HalfCheetah-v5", help="environment of the newest run (%(default)s)")
    parser.add_argument("-f", "--log-folder", default="logs", help="where RL Zoo logs (%(default)s)")
    parser.add_argument("-o", "--output", type=Path, help="where to write (FOLDER/report)")
    parser.add_argument("--baseline", metavar="ARM", help="what others are compared with (the first arm)")
    args = parser.parse_args()
    try:
        folder = args.folder or newest_run(args.log_folder, args.algo, args.env)
        print("\n".join(report(folder, args.output or folder / "report", args.baseline)))
    except (OSError, MissingPackageError) as error:
        sys.exit(f"{parser.prog}: {error}")


def report(folder: Path, output: Path, baseline: str | None = None) -> list[str]:
    """
    Write the page, its pictures and its tables.

    :param folder: of an experiment, RL Zoo's log folder, or that of a run
    :param output: the folder to write to
    :param baseline: the arm that others are compared with; None: the first
    :return: the lines to print
    """
    results = load_results(folder, baseline)
    if len(results.evaluated) > 1:
        import_rliable()
    parts = sections(results)
    output.mkdir(parents=True, exist_ok=True)
    for part in parts:
        for picture in part.pictures:
            (output / f"{picture.name}.png").write_bytes(picture.drawing.png)
            (output / f"{picture.name}.svg").write_text(picture.drawing.svg, encoding="utf-8")
    write_csv(output / "runs.csv", _run_records(results))
    write_csv(output / "evaluations.csv", _evaluation_records(results))
    page = output / "report.html"
    page.write_text(render(results, parts, _commands(results, baseline)), encoding="utf-8")
    if len(results.runs) == 1 and not results.frozen:
        return [*_single(results, output), f"Report:         {page}"]
    return [*summary(results), *results.problems, f"Report: {page}"]


def _single(results: Results, output: Path) -> list[str]:
    """What there is to say about one run."""
    run = results.runs[0]
    lines = [
        f"Mean return of the {name}: {each.means[-1]:.1f} "
        f"({each.returns.shape[1]} episodes after {each.timesteps[-1]} steps)"
        for name, each in run.policies.items()
    ]
    models = sorted(
        run.folder.glob("*.zip"), key=lambda path: path.name.startswith(("best_model", "rl_model"))
    )
    lines.append(f"Model:          {models[0] if models else 'none, training did not end'}")
    lines.append(f"Logs:           {run.folder}")
    lines += [f"Learning curve: {path}" for path in sorted(output.glob("curves-*-steps.png"))]
    return lines


def _commands(results: Results, baseline: str | None) -> list[str]:
    chosen = f" --baseline {shlex.quote(baseline)}" if baseline else ""
    folder = shlex.quote(results.name)
    spec = shlex.quote(f"{results.name}/spec.yml")
    first = [f"sb3-mcbs experiment {spec} -o {folder}"] if results.spec else []
    if not first:
        first = ["# each run by its folder", "sb3-mcbs repeat RUN_FOLDER"]
    return [*first, f"sb3-mcbs report {folder}{chosen}"]


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
                record: dict[str, object] = {"run": run.name, "policy": policy, **each.costs(index)}
                record["mean_return"] = float(each.means[index])
                for episode, value in enumerate(each.returns[index]):
                    record[f"return_{episode}"] = float(value)
                    if each.lengths is not None:
                        record[f"length_{episode}"] = int(each.lengths[index, episode])
                records.append(record)
    return records


def write_csv(path: Path, records: list[dict[str, object]]) -> None:
    """
    :param path: the file
    :param records: rows by name of column; what a row lacks stays empty
    """
    names = list(dict.fromkeys(name for record in records for name in record))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(records)


if __name__ == "__main__":
    main()
