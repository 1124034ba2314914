"""``sb3-mcbs evaluate RUN|ZIP``: the returns of an agent's actor alone, and with search."""

import argparse
import importlib
import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_mcbs.agents import MCBS, SearchPolicy
from sb3_mcbs.agents.episodes import Episode, play
from sb3_mcbs.agents.registry import ALGORITHMS
from sb3_mcbs.loading import load_agent
from sb3_mcbs.models import ForwardModelError
from sb3_mcbs.search import PRESETS
from sb3_mcbs.snapshot import SnapshotError
from sb3_mcbs.zoo.environments import (
    ENV_HELP,
    find_environment,
    make_searchable,
    normalized,
    statistics_beside,
)
from sb3_mcbs.zoo.evaluations import ACTOR, SEARCH
from sb3_mcbs.zoo.paths import PathError
from sb3_mcbs.zoo.repeat import load_run

#: Vectorized wrappers of a run's configuration that a search cannot see through.
_NOT_SEEN_THROUGH = ("vec_env_wrapper", "frame_stack")


class Subject(NamedTuple):
    """
    An agent to evaluate, and the environment that it was trained for.

    :param file: of the agent
    :param environment: its name
    :param env_kwargs: arguments of the environment
    :param wrappers: names of its wrappers, innermost first
    :param statistics: of the observations; None: they are not normalised
    :param algo: on RL Zoo's command line; None: inferred from the file
    """

    file: Path
    environment: str
    env_kwargs: Mapping[str, Any] = MappingProxyType({})
    wrappers: Sequence[Any] = ()
    statistics: Path | None = None
    algo: str | None = None


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


def find_subject(path: Path, environment: str | None, wrappers: Sequence[str]) -> Subject:
    """
    Find an agent's file, environment and statistics.

    :param path: the folder of an RL Zoo run, or the file of an agent
    :param environment: its name; None: that of the run
    :param wrappers: of the environment, if it is named
    :return: the agent and its environment
    :raises PathError: if there is no such agent, or it is not known which environment it is for
    """
    if not path.exists():
        raise PathError(f"There is no {path}. Name the folder of an RL Zoo run, or the file of an agent.")
    if path.is_dir():
        subject = _of_run(path)
        return subject if environment is None else subject._replace(environment=environment)
    if environment is not None:
        return Subject(path, environment, wrappers=wrappers, statistics=statistics_beside(path))
    try:
        return _of_run(path.parent)._replace(file=path)
    except PathError:
        raise PathError(
            f"{path} does not say which environment it is for, and is not in the folder of an RL Zoo run: "
            "name the environment with --env."
        ) from None


def _of_run(folder: Path) -> Subject:
    config, args = load_run(folder)
    name = str(args["env"]).replace("/", "-")
    files = [folder / f"{name}.zip", folder / "best_model.zip"]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        raise PathError(f"{folder} contains neither {files[0].name} nor {files[1].name}: was it trained?")
    for setting in _NOT_SEEN_THROUGH:
        if config.get(setting):
            raise PathError(
                f"{folder} was trained with {setting}, and a search cannot simulate through it. Look at the "
                "actor alone with rl_zoo3.enjoy."
            )
    statistics = statistics_beside(file)
    if config.get("normalize") and statistics is None:
        raise PathError(
            f"{folder} was trained with normalized observations, and its statistics are not there: name "
            "them with --vecnormalize."
        )
    for package in args.get("gym_packages") or []:
        importlib.import_module(package)
    wrappers = config.get("env_wrapper") or []
    return Subject(
        file,
        args["env"],
        args.get("env_kwargs") or {},
        wrappers if isinstance(wrappers, list) else [wrappers],
        statistics if config.get("normalize") else None,
        args["algo"] if args.get("algo") in ALGORITHMS else None,
    )


def searching_policies(
    agent: OffPolicyAlgorithm, env: VecEnv, presets: Sequence[str], seed: int
) -> dict[str, SearchPolicy]:
    """
    :param agent: the agent
    :param env: the environment
    :param presets: of the search; none: the agent's own settings if it searched in training, or "efficient"
    :param seed: of the search
    :return: policies by their names in words
    """
    if not presets and isinstance(agent, MCBS):
        return {SEARCH: SearchPolicy(agent, env, seed=seed)}
    return {
        f"{SEARCH}, {preset}": SearchPolicy(agent, env, seed=seed, preset=preset)
        for preset in presets or ["efficient"]
    }


def evaluate(
    agent: OffPolicyAlgorithm, env: VecEnv, presets: Sequence[str], seeds: Sequence[int]
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
    parser.add_argument("path", type=Path, help="the folder of an RL Zoo run, or an agent's zip")
    parser.add_argument("--env", help=f"the environment of a zip: {ENV_HELP}")
    parser.add_argument(
        "--wrapper", nargs="+", metavar="W", default=[], help="its wrappers (module.Class), innermost first"
    )
    parser.add_argument(
        "--algo", choices=ALGORITHMS, metavar="ALGO", help="td3, mcbs_sac, ...: if it cannot be inferred"
    )
    parser.add_argument(
        "--vecnormalize",
        type=Path,
        metavar="FILE",
        help="statistics of the observations (npz or pkl); by default those beside the agent",
    )
    parser.add_argument("--trusted", action="store_true", help="open statistics that are a pickle")
    parser.add_argument(
        "--preset",
        nargs="+",
        choices=PRESETS,
        metavar="PRESET",
        default=[],
        help=f"how to search ({', '.join(PRESETS)}); by default as in training, or efficient",
    )
    parser.add_argument("--episodes", type=int, metavar="N", default=10, help="how many, by default 10")
    parser.add_argument(
        "--seed", type=int, metavar="N", default=0, help="reset seed of the first, by default 0"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def main() -> None:
    """Read the command line, evaluate and print."""
    parser = _parser()
    args = parser.parse_args()
    if args.episodes < 1:
        parser.error(f"--episodes must be 1 or more, got {args.episodes}")
    if args.seed < 0:
        parser.error(f"--seed must be 0 or more, got {args.seed}")
    seeds = list(range(args.seed, args.seed + args.episodes))
    try:
        subject = find_subject(args.path, args.env, args.wrapper)
        statistics = args.vecnormalize or subject.statistics
        make = find_environment(subject.environment, subject.wrappers)
        env = normalized(make_searchable(make, **subject.env_kwargs), statistics, args.trusted)
        agent = load_agent(subject.file, env, args.algo or subject.algo)
        _show(subject, statistics, agent, evaluate(agent, env, args.preset, seeds), seeds, args.json)
    except (OSError, ValueError, TypeError, SnapshotError, ForwardModelError) as error:
        sys.exit(f"{parser.prog}: {error}")


def _show(
    subject: Subject,
    statistics: Path | None,
    agent: OffPolicyAlgorithm,
    results: Iterator[Result],
    seeds: Sequence[int],
    as_json: bool,
) -> None:
    algorithm = type(agent).__name__
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
    print(f"{subject.environment}, {len(seeds)} episodes with reset seeds {seeds[0]} to {seeds[-1]}\n")
    for line in as_table(results):
        print(line, flush=True)


if __name__ == "__main__":
    main()
