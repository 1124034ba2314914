"""``sb3-mcbs watch AGENT --env ENV -o FILE``: a video of an agent and of what its search looks at."""

import argparse
import itertools
from pathlib import Path
from typing import Any

from sb3_mcbs.agents import SearchPolicy
from sb3_mcbs.search import PRESETS
from sb3_mcbs.types import Preset
from sb3_mcbs.video import Outcome, Performer, record_episodes, show_live
from sb3_mcbs.zoo.arguments import add_agent, errors_in_words, positive, whole_number
from sb3_mcbs.zoo.subject import DEFAULT_PRESET, Subject, default_preset, find_subject


def record(
    path: str | Path, subject: Subject, seed: int, preset: Preset | None, compare: bool, **how: Any
) -> list[Outcome]:
    """
    Record an episode of an agent that searches.

    :param path: the file
    :param subject: the agent and its environment
    :param seed: of the reset and of the search
    :param preset: of the search; None: see :func:`sb3_mcbs.zoo.subject.default_preset`
    :param compare: whether the actor alone is shown beside it
    :param how: further arguments of :func:`sb3_mcbs.video.record_episodes`
    :return: the episodes of both, or of the one with search
    """
    env = subject.make_env(draws=True)
    agent = subject.load(env)
    preset = preset or default_preset(agent)
    policy = SearchPolicy(agent, env, seed=seed, preset=preset)
    name = type(agent).__name__
    performers = [Performer(f"{name} with search", policy, env)]
    if compare:
        performers.insert(0, Performer(f"{name} alone", agent, subject.make_env(draws=True)))
    try:
        return record_episodes(
            path,
            performers,
            [seed],
            title=performers[-1].label,
            subtitle=f"{subject.environment}, {preset or 'settings of its training'}",
            progress=True,
            **how,
        )
    finally:
        policy.close()
        for performer in performers:
            performer.vec_env.close()


def show(subject: Subject, seed: int, preset: Preset | None, **how: Any) -> list[Outcome]:
    """
    Show episodes of an agent that searches in the browser, one after another.

    :param subject: the agent and its environment
    :param seed: of the first reset and of the search; later resets have the next ones
    :param preset: see :func:`record`
    :param how: further arguments of :func:`sb3_mcbs.video.show_live`
    :return: the episodes, until Ctrl-C
    """
    env = subject.make_env()
    agent = subject.load(env)
    policy = SearchPolicy(agent, env, seed=seed, preset=preset or default_preset(agent))
    performer = Performer(f"{type(agent).__name__} with search", policy, env)
    seeds = itertools.count(seed) if how.get("steps") is None else [seed]
    try:
        return show_live(performer, seeds, **how)
    finally:
        policy.close()
        env.close()


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        prog="sb3-mcbs watch",
        description="Record a trained TD3, DDPG, SAC, TQC or CrossQ agent that looks ahead. In MuJoCo's "
        "scene are the candidates' rollouts, coloured by value, the chosen one thick; beside it their "
        "values, the gain over the policy's own action, and the return. No code from AGENT is run.",
    )
    add_agent(result)
    add: Any = result.add_argument
    where: Any = result.add_mutually_exclusive_group(required=True)
    where.add_argument("-o", "--output", metavar="FILE", help="ends with .mp4, .gif, or .png (four moments)")
    where.add_argument(
        "--live",
        nargs="?",
        type=whole_number(0),
        const=0,
        metavar="PORT",
        help="show it in a browser of this machine instead, by default at the first free port from 8080 on",
    )
    add("--compare", action="store_true", help="show the actor alone beside it, from the same seed")
    add("--seed", type=whole_number(0), default=0, metavar="N", help="of reset and search, by default 0")
    add(
        "--steps",
        type=whole_number(1),
        metavar="N",
        help="at most, by default 200; live: all",
    )
    add("--start", type=whole_number(0), default=0, metavar="N", help="steps before those, not recorded")
    add(
        "--preset",
        choices=PRESETS,
        metavar="PRESET",
        help=f"how to search ({', '.join(PRESETS)}); by default as in training, or {DEFAULT_PRESET}",
    )
    add(
        "--body",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="bodies to follow, by default the torso, or the end of a fixed robot",
    )
    add(
        "--magnify",
        type=positive,
        metavar="X",
        help="draw differences between rollouts X times as large, by default so that they are seen; 1: as is",
    )
    return result


def watch(args: argparse.Namespace) -> None:
    """
    Record a video or show it live, and print what it shows.

    :param args: see :func:`parser`
    :raises ValueError: if an option does not go with a live view
    """
    if args.live is not None:
        _watch_live(args)
        return
    outcomes = record(
        args.output,
        find_subject(args),
        args.seed,
        args.preset,
        args.compare,
        steps=args.steps or 200,
        start=args.start,
        bodies=args.body,
        magnify=args.magnify,
    )
    _print(outcomes)
    print(f"wrote {args.output}")


def _watch_live(args: argparse.Namespace) -> None:
    if args.compare or args.start:
        raise ValueError("--live shows one agent from its first step: leave out --compare and --start.")
    outcomes = show(
        find_subject(args),
        args.seed,
        args.preset,
        steps=args.steps,
        bodies=args.body,
        magnify=args.magnify,
        port=args.live,
        begun=lambda url: print(f"Open {url} in a browser of this machine. Ctrl-C ends it.", flush=True),
    )
    _print(outcomes)


def _print(outcomes: list[Outcome]) -> None:
    for outcome in outcomes:
        ended = f", {outcome.ended}" if outcome.ended else ""
        print(f"{outcome.label}: return {outcome.total:.1f} in {outcome.steps} steps{ended}")


def main() -> None:
    """Read the command line and record."""
    own = parser()
    args = own.parse_args()
    with errors_in_words(own.prog):
        watch(args)


if __name__ == "__main__":
    main()
