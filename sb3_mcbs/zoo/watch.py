"""``sb3-mcbs watch AGENT --env ENV -o FILE``: a video of an agent and of what its search looks at."""

import argparse
from pathlib import Path
from typing import Any

from sb3_mcbs.agents import SearchPolicy
from sb3_mcbs.search import PRESETS
from sb3_mcbs.types import Preset
from sb3_mcbs.video import Outcome, Performer, record_episodes
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
    add("-o", "--output", required=True, metavar="FILE", help="ends with .mp4, .gif, or .png (four moments)")
    add("--compare", action="store_true", help="show the actor alone beside it, from the same seed")
    add("--seed", type=whole_number(0), default=0, metavar="N", help="of reset and search, by default 0")
    add("--steps", type=whole_number(1), default=200, metavar="N", help="to record at most, by default 200")
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
    Record a video, and print what it shows.

    :param args: see :func:`parser`
    """
    outcomes = record(
        args.output,
        find_subject(args),
        args.seed,
        args.preset,
        args.compare,
        steps=args.steps,
        start=args.start,
        bodies=args.body,
        magnify=args.magnify,
    )
    for outcome in outcomes:
        ended = f", {outcome.ended}" if outcome.ended else ""
        print(f"{outcome.label}: return {outcome.total:.1f} in {outcome.steps} steps{ended}")
    print(f"wrote {args.output}")


def main() -> None:
    """Read the command line and record."""
    own = parser()
    args = own.parse_args()
    with errors_in_words(own.prog):
        watch(args)


if __name__ == "__main__":
    main()
