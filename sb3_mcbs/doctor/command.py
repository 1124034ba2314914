"""``sb3-mcbs doctor ENV``: whether look-ahead works for an environment, and what it costs."""

import argparse
import json
import sys
from pathlib import Path

from sb3_mcbs.doctor.child import Request
from sb3_mcbs.doctor.isolation import examine
from sb3_mcbs.doctor.report import block, lines, verdict
from sb3_mcbs.zoo.environments import ENV_HELP, check_trust, statistics_beside


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-mcbs doctor",
        description="Examine an environment in a process of its own: whether its snapshots are exact, what "
        "simulates it, what a decision costs, and with an agent what search adds to the return. Exit status "
        "0: look-ahead is exact and fast, 1: it is slow, 2: it does not work.",
    )
    parser.add_argument("environment", metavar="ENV", help=ENV_HELP)
    parser.add_argument(
        "--wrapper", nargs="+", metavar="W", default=[], help="its wrappers (module.Class), innermost first"
    )
    parser.add_argument("--agent", type=Path, metavar="ZIP", help="a trained agent, loaded without its code")
    parser.add_argument(
        "--vecnormalize",
        type=Path,
        metavar="FILE",
        help="statistics of its observations (npz or pkl); by default those beside the agent",
    )
    parser.add_argument("--trusted", action="store_true", help="open statistics that are a pickle")
    parser.add_argument(
        "--episodes", type=int, metavar="N", default=2, help="episodes of the agent, by default 2"
    )
    parser.add_argument(
        "--time-limit",
        type=float,
        metavar="S",
        default=60.0,
        help="seconds until a stage of the examination counts as hanging, by default 60",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def main() -> None:
    """Read the command line, examine the environment and print what was found."""
    parser = _parser()
    args = parser.parse_args()
    if args.episodes < 1:
        parser.error(f"--episodes must be 1 or more, got {args.episodes}")
    if args.time_limit <= 0:
        parser.error(f"--time-limit must be above 0, got {args.time_limit:g}")
    if args.agent is not None and not args.agent.is_file():
        parser.error(f"--agent: there is no file {args.agent}")
    statistics = args.vecnormalize
    if statistics is None and args.agent is not None:
        statistics = statistics_beside(args.agent)
    try:
        check_trust(statistics, args.trusted)
    except OSError as error:
        parser.error(str(error))
    request = Request(
        args.environment,
        args.wrapper,
        None if args.agent is None else str(args.agent),
        None if statistics is None else str(statistics),
        args.trusted,
        args.episodes,
        args.time_limit / 2,
    )
    try:
        findings = examine(request, args.time_limit, _show_progress)
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        _show_progress("")
    status = verdict(findings)
    text = block(findings, args.environment, args.wrapper)
    if args.json:
        print(json.dumps({**findings, "status": status, "hyperparameters": text}, indent=1))
    else:
        print("\n".join(lines(findings, args.environment, text)))
    sys.exit(status)


def _show_progress(stage: str) -> None:
    """Show what is done at present, where a person is watching."""
    if sys.stderr.isatty():
        print(f"\r\033[K{stage} ..." if stage else "\r\033[K", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
