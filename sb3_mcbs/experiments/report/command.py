"""``sb3-mcbs report PATH ...``: a page about all runs of folders, or of other reports."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from sb3_mcbs.experiments.report.csv_files import write_csv_files
from sb3_mcbs.experiments.report.page import render, sections, summary
from sb3_mcbs.experiments.report.runs import Results
from sb3_mcbs.experiments.report.sources import load_results
from sb3_mcbs.experiments.report.statistics import MissingPackageError, import_rliable
from sb3_mcbs.zoo.evaluations import newest_run
from sb3_mcbs.zoo.paths import PathError


def main() -> None:
    """Read the command line, write the page and say where it is."""
    parser = argparse.ArgumentParser(
        prog="sb3-mcbs report",
        description="A page with pictures and tables of an experiment, of RL Zoo's log folder, or of a run.",
    )
    parser.add_argument(
        "paths",
        nargs="*",
        metavar="PATH",
        type=Path,
        help="folders, or evaluations.csv of other reports (the folder of the newest run)",
    )
    parser.add_argument("--algo", default="mcbs_td3", help="algorithm of the newest run (%(default)s)")
    parser.add_argument("--env", default="HalfCheetah-v5", help="environment of the newest run (%(default)s)")
    parser.add_argument("-f", "--log-folder", default="logs", help="where RL Zoo logs (%(default)s)")
    parser.add_argument(
        "-o", "--output", type=Path, help="where to write (PATH/report); needed with several PATHs or --arms"
    )
    parser.add_argument("--baseline", metavar="ARM", help="what others are compared with (the first arm)")
    parser.add_argument("--arms", metavar="ARM", nargs="+", help="those to show, in this order (all)")
    args = parser.parse_intermixed_args()
    mistaken = [] if args.paths else [arm for arm in args.arms or [] if Path(arm).exists()]
    if mistaken:
        parser.error(f"{mistaken[0]} was read as an arm: name paths before --arms.")
    if args.output is None and (len(args.paths) > 1 or args.arms):
        parser.error("With several paths, or with --arms, name the folder to write to: -o FOLDER.")
    try:
        paths = args.paths or [newest_run(args.log_folder, args.algo, args.env)]
        output = args.output or (paths[0].parent if paths[0].is_file() else paths[0]) / "report"
        print("\n".join(report(*paths, output=output, baseline=args.baseline, arms=args.arms)))
    except (OSError, MissingPackageError) as error:
        sys.exit(f"{parser.prog}: {error}")


def report(
    *paths: Path, output: Path, baseline: str | None = None, arms: Sequence[str] | None = None
) -> list[str]:
    """
    Write the page, its pictures and its tables.

    :param paths: folders of experiments, of runs or of RL Zoo's logs, or the ``evaluations.csv`` of reports
    :param output: the folder to write to
    :param baseline: the arm that others are compared with; None: the first
    :param arms: those that are shown; None: all
    :return: the lines to print
    :raises PathError: if a path has nothing to report, or would be replaced
    """
    if any(path.is_file() and path.resolve().parent == output.resolve() for path in paths):
        raise PathError(f"A report in {output} could replace a file that is read: name another -o.")
    results = load_results(*paths, baseline=baseline, arms=arms)
    if len(results.evaluated) > 1:
        import_rliable()
    parts = sections(results)
    output.mkdir(parents=True, exist_ok=True)
    for part in parts:
        for picture in part.pictures:
            (output / f"{picture.name}.png").write_bytes(picture.drawing.png)
            (output / f"{picture.name}.svg").write_text(picture.drawing.svg, encoding="utf-8")
    write_csv_files(results, output)
    page = output / "report.html"
    page.write_text(render(results, parts, _commands(results, paths, baseline, arms)), encoding="utf-8")
    if len(results.runs) == 1 and results.runs[0].folder.is_dir() and not results.frozen:
        return [*_single(results, output), *results.problems, f"Report:         {page}"]
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


def _commands(
    results: Results, paths: Sequence[Path], baseline: str | None, arms: Sequence[str] | None
) -> list[str]:
    # Not whole paths, which would say more than others need to know.
    names = [str(Path(*path.absolute().parts[-2 if path.is_file() else -1 :])) for path in paths]
    options = [*names, *(["--baseline", baseline] if baseline else []), *(["--arms", *arms] if arms else [])]
    command = shlex.join(["sb3-mcbs", "report", *options])
    if results.spec:
        return [shlex.join(["sb3-mcbs", "experiment", f"{names[0]}/spec.yml", "-o", names[0]]), command]
    if len(paths) > 1 or paths[0].is_file():
        return [command]
    return ["# each run by its folder", "sb3-mcbs repeat RUN_FOLDER", command]


if __name__ == "__main__":
    main()
