"""``sb3-mcbs experiment SPEC``: train all runs of a spec, or go on with them."""

import argparse
import fnmatch
import math
import sys
from pathlib import Path

import yaml

from sb3_mcbs.experiments.cluster import GRACE, connected
from sb3_mcbs.experiments.display import Display
from sb3_mcbs.experiments.engine import Engine
from sb3_mcbs.experiments.plan import Run, expand
from sb3_mcbs.experiments.results import ResultsError, RunFolder, prepare
from sb3_mcbs.experiments.spec import SPECS, SpecError, read_spec
from sb3_mcbs.models.mujoco_batch import usable_cores


def main() -> None:
    """Read the command line, check the spec and work through its runs."""
    parser = _parser()
    args = parser.parse_args()
    _check(parser, args)
    try:
        spec = read_spec(args.spec)
        runs = expand(spec)
        chosen = _matching(runs, args.only)
        if args.check:
            print("\n".join(_describe(run) for run in chosen))
            return
        folder = args.output or Path("logs") / "experiments" / spec.name
        names = {run.name for run in chosen}
        folders = [each for each in prepare(folder, spec, runs) if each.name in names]
        status = _finish(folders, folder, args)
    except (SpecError, ResultsError) as error:
        sys.exit(f"{parser.prog}: {error}")
    print(f"Results: {folder}")
    sys.exit(status)


def _finish(folders: list[RunFolder], folder: Path, args: argparse.Namespace) -> int:
    display = Display()
    if args.engine == "local":
        return Engine(folders, args.jobs or usable_cores(), display).finish()
    with connected(
        args.address or "auto", folder, args.scratch, args.gpus_per_run or 0, display.say
    ) as cluster:
        return Engine(folders, args.jobs, display, cluster.start, GRACE).finish()


def _check(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    if args.jobs is not None and args.jobs < 1:
        parser.error("--jobs must be 1 or more")
    for_ray = {"--address": args.address, "--scratch": args.scratch, "--gpus-per-run": args.gpus_per_run}
    given = [name for name, value in for_ray.items() if value is not None]
    if given and args.engine != "ray":
        parser.error(f"{', '.join(given)}: only with --engine ray")
    if args.scratch is not None and not args.scratch.is_absolute():
        parser.error("--scratch must be an absolute path, the same on all nodes")
    if args.gpus_per_run is not None and not 0 <= args.gpus_per_run < math.inf:
        parser.error("--gpus-per-run must be 0 or more")


def _parser() -> argparse.ArgumentParser:
    shipped = ", ".join(sorted(path.stem for path in SPECS.glob("*.yml")))
    parser = argparse.ArgumentParser(
        prog="sb3-mcbs experiment",
        description="Train all runs of a spec, several at a time. The same command goes on with what was "
        "stopped or killed, and leaves alone what is finished. Ctrl-C stops all runs after a checkpoint.",
    )
    parser.add_argument("spec", help=f"a YAML file, or a shipped spec: {shipped}")
    parser.add_argument("-o", "--output", type=Path, help="folder of the results (logs/experiments/SPEC)")
    parser.add_argument(
        "-j",
        "--jobs",
        type=int,
        help=f"runs at a time (here {usable_cores()}; with Ray as many as the cluster takes)",
    )
    parser.add_argument(
        "--only",
        metavar="PATTERN",
        help="the run of this name, or those whose name has this in it, or matches it with *",
    )
    parser.add_argument("--check", "--dry-run", action="store_true", help="check the spec and list its runs")
    parser.add_argument(
        "--engine", choices=["local", "ray"], default="local", help="where runs are trained (%(default)s)"
    )
    ray = parser.add_argument_group("with --engine ray")
    ray.add_argument("--address", help="of the cluster (auto: that of this machine)")
    ray.add_argument(
        "--scratch",
        metavar="FOLDER",
        type=Path,
        help="train in this folder of each node, and bring results here (without: in the folder of the "
        "results, which all nodes see)",
    )
    ray.add_argument("--gpus-per-run", metavar="N", type=float, help="GPUs, or the share of one, per run (0)")
    return parser


def _matching(runs: list[Run], pattern: str | None) -> list[Run]:
    if pattern is None:
        return runs
    is_name = any(run.name == pattern for run in runs)  # which may be a part of another's
    whole = pattern if is_name or any(sign in pattern for sign in "*?[") else f"*{pattern}*"
    chosen = [run for run in runs if run.name == whole or fnmatch.fnmatchcase(run.name, whole)]
    if not chosen:
        names = ", ".join(run.name for run in runs[:10]) + (", ..." if len(runs) > 10 else "")
        raise SpecError(f"--only {pattern}: no run has such a name; the runs are {names}.")
    return chosen


def _describe(run: Run) -> str:
    params = yaml.safe_dump(run.params, default_flow_style=True, width=1000, sort_keys=False).strip()
    changed = f" with {params}" if run.params else ""
    of_what = f"hyperparameters of {run.source}" if run.agent is None else f"around {run.agent.file}"
    return f"{run.name}: {run.algorithm}, {run.steps} {run.unit}, {of_what}{changed}"


if __name__ == "__main__":
    main()
