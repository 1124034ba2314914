"""``sb3-mcbs evaluate RUN|ZIP``: the returns of an agent's actor alone, and with search."""

import argparse
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_mcbs.agents import SearchPolicy
from sb3_mcbs.agents.episodes import Episode, play
from sb3_mcbs.search import PRESETS
from sb3_mcbs.types import Preset
from sb3_mcbs.zoo.arguments import add_agent, add_episodes, errors_in_words
from sb3_mcbs.zoo.evaluations import ACTOR, SEARCH
from sb3_mcbs.zoo.subject import DEFAULT_PRESET, Subject, default_preset, find_subject
from sb3_mcbs.zoo.watch import record


class Result(NamedTuple):
    """
    The episodes of one policy.

    :param policy: in words
    :param episodes: one for each reset seed
    """

    policy: str
    episodes: list[Episode]

    def as_dict(self) -> dict[str, Any]:
        """
        :return: what ``--json`` prints
        """
        returns = [episode.total for episode in self.episodes]
        return {
            "policy": self.policy,
            "mean_return": float(np.mean(returns)),
            "std_return": float(np.std(returns)),
            "simulated_steps": sum(episode.simulated_steps for episode in self.episodes),
            "seconds": sum(episode.seconds for episode in self.episodes),
            "episodes": [
                {"seed": episode.seed, "return": episode.total, "length": episode.length}
                for episode in self.episodes
            ],
        }


def searching_policies(
    agent: OffPolicyAlgorithm, env: VecEnv, presets: Sequence[Preset], seed: int
) -> dict[str, SearchPolicy]:
    """
    :param agent: the agent
    :param env: the environment
    :param presets: of the search; none: see :func:`sb3_mcbs.zoo.subject.default_preset`
    :param seed: of the search
    :return: policies by their names in words
    """
    wanted: Sequence[Preset | None] = presets or [default_preset(agent)]
    return {
        f"{SEARCH}, {preset}" if preset else SEARCH: SearchPolicy(agent, env, seed=seed, preset=preset)
        for preset in wanted
    }


def evaluate(
    agent: OffPolicyAlgorithm, env: VecEnv, presets: Sequence[Preset], seeds: Sequence[int]
) -> Iterator[Result]:
    """
    Play the same episodes with the actor alone and with search.

    :param agent: the agent
    :param env: a single environment
    :param presets: see :func:`searching_policies`
    :param seeds: of the episodes' resets
    :return: one for each policy, when it has played; the actor's first
    """
    policies = {ACTOR: agent, **searching_policies(agent, env, presets, seeds[0])}
    for name, policy in policies.items():
        yield Result(name, [play(policy, env, seed) for seed in seeds])


def as_table(results: Iterable[Result]) -> Iterator[str]:
    """
    :param results: the actor's first
    :return: lines of at most 80 characters, each as soon as it is known
    """
    head = f"{'':28} {'return':>9} {'std':>8} {'better in':>10} {'sim. steps':>11} {'seconds':>8}"
    yield head
    alone: list[Episode] = []
    for policy, episodes in results:
        alone = alone or episodes
        better = sum(one.total > other.total for one, other in zip(episodes, alone, strict=True))
        returns = [episode.total for episode in episodes]
        yield (
            f"{policy:28} {np.mean(returns):9.1f} {np.std(returns):8.1f} "
            f"{'' if episodes is alone else f'{better} of {len(alone)}':>10} "
            f"{sum(episode.simulated_steps for episode in episodes):11,} "
            f"{sum(episode.seconds for episode in episodes):8.1f}"
        )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-mcbs evaluate",
        description="Play episodes with an agent's actor alone and with search, from the same reset seeds, "
        "and print both returns. RL Zoo's enjoy and record_video show the actor alone.",
    )
    add_agent(parser)
    parser.add_argument(
        "--preset",
        nargs="+",
        action="extend",
        choices=PRESETS,
        metavar="PRESET",
        default=[],
        help=f"how to search ({', '.join(PRESETS)}); by default as in training, or {DEFAULT_PRESET}",
    )
    add_episodes(parser)
    parser.add_argument(
        "--video",
        type=Path,
        metavar="FILE",
        help="record the first episode again, with the first preset beside the actor alone: .mp4, .gif or "
        ".png, as sb3-mcbs watch --compare does",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def main() -> None:
    """Read the command line, evaluate and print."""
    parser = _parser()
    args = parser.parse_args()
    seeds = list(range(args.seed, args.seed + args.episodes))
    with errors_in_words(parser.prog):
        subject = find_subject(args)
        env = subject.make_env()
        agent = subject.load(env)
        if args.video is not None:  # first, since it needs what may be missing
            preset = args.preset[0] if args.preset else None
            record(args.video, subject, args.seed, preset, compare=True)
            print(f"wrote {args.video}", file=sys.stderr)
        _show(subject, agent, evaluate(agent, env, args.preset, seeds), seeds, args.json)


def _show(
    subject: Subject,
    agent: OffPolicyAlgorithm,
    results: Iterator[Result],
    seeds: Sequence[int],
    as_json: bool,
) -> None:
    algorithm, statistics = type(agent).__name__, subject.statistics
    if as_json:
        about = {
            "algorithm": algorithm,
            "file": str(subject.file),
            "environment": subject.environment,
            "statistics": None if statistics is None else str(statistics),
        }
        print(json.dumps({**about, "policies": [result.as_dict() for result in results]}, indent=1))
        return
    print(f"{algorithm} from {subject.file}")
    if statistics is not None:
        print(f"observations normalized with {statistics}")
    many = f"{len(seeds)} episodes with reset seeds {seeds[0]} to {seeds[-1]}"
    print(f"{subject.environment}, {many if len(seeds) > 1 else f'one episode with reset seed {seeds[0]}'}\n")
    for line in as_table(results):
        print(line, flush=True)


if __name__ == "__main__":
    main()
