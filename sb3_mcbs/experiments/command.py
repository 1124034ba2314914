"""``sb3-mcbs experiment SPEC``: train all runs of a spec, or go on with them."""

import argparse
import fnmatch
import sys
from pathlib import Path

import yaml

from sb3_mcbs.experiments.display import Display
from sb3_mcbs.experiments.local import LocalEngine
from sb3_mcbs.experiments.plan import Run, expand
from sb3_mcbs.experiments.results import ResultsError, prepare
from sb3_mcbs.experiments.spec import SPECS, SpecError, read_spec
from sb3_mcbs.models.mujoco_batch import usable_cores


def main() -> None:
    """Read the command line, check the spec and work through its runs."""
    parser = _parser()
    args = parser.parse_args()
    if args.jobs < 1:
        parser.error("--jobs must be 1 or more")
    try:
        spec = read_spec(args.spec)
        runs = expand(spec)
        chosen = _matching(runs, args.only)
        if args.check:
            print("\n".join(_describe(run) for run in chosen))
            return
        folder = args.output or Path("logs") / "experiments" / spec.name
        folders = prepare(folder, spec, runs)
    except (SpecError, ResultsError) as error:
        sys.exit(f"{parser.prog}: {error}")
    names = {run.name for run in chosen}
    engine = LocalEngine([each for each in folders if each.name in names], args.jobs, Display())
    status = engine.finish()
    print(f"Results: {folder}")
    sys.exit(status)


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
        "-j", "--jobs", type=int, default=usable_cores(), help="runs at a time (%(default)s here)"
    )
    parser.add_argument(
        "--only", metavar="PATTERN", help="runs whose name has this in it, or matches it with *"
    )
    parser.add_argument("--check", "--dry-run", action="store_true", help="check the spec and list its runs")
    return parser


def _matching(runs: list[Run], pattern: str | None) -> list[Run]:
    if pattern is None:
        return runs
    whole = pattern if any(sign in pattern for sign in "*?[") else f"*{pattern}*"
    chosen = [run for run in runs if fnmatch.fnmatchcase(run.name, whole)]
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
