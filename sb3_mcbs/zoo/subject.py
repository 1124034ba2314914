"""An agent as commands name it: the folder of a run or a file, and the environment that it acts in."""

import argparse
import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_mcbs.agents import MCBS
from sb3_mcbs.agents.registry import ALGORITHMS
from sb3_mcbs.loading import load_agent
from sb3_mcbs.types import Preset
from sb3_mcbs.zoo.environments import (
    drawn,
    find_environment,
    make_searchable,
    normalized,
    statistics_beside,
)
from sb3_mcbs.zoo.paths import PathError
from sb3_mcbs.zoo.repeat import load_run

#: How an agent searches that was not trained with search.
DEFAULT_PRESET: Preset = "efficient"
#: Vectorized wrappers of a run's configuration that a search cannot see through.
_NOT_SEEN_THROUGH = ("vec_env_wrapper", "frame_stack")
#: Where ``sb3-mcbs experiment`` has the folder of RL Zoo's run, below its own.
_OF_EXPERIMENT = "logs/*/*/*/args.yml"


class Subject(NamedTuple):
    """
    An agent, and the environment that it was trained for.

    :param file: of the agent
    :param environment: its name
    :param env_kwargs: arguments of the environment
    :param wrappers: names of its wrappers, innermost first
    :param statistics: of the observations; None: they are not normalized
    :param trusted: whether statistics that are a pickle may be opened
    :param algo: on RL Zoo's command line; None: inferred from the file
    """

    file: Path
    environment: str
    env_kwargs: Mapping[str, Any] = MappingProxyType({})
    wrappers: Sequence[Any] = ()
    statistics: Path | None = None
    trusted: bool = False
    algo: str | None = None

    def make_env(self, draws: bool = False) -> VecEnv:
        """
        :param draws: whether pictures of it are needed
        :return: a single environment to search in
        """
        make = find_environment(self.environment, self.wrappers)
        env = make_searchable(drawn(make) if draws else make, **self.env_kwargs)
        return normalized(env, self.statistics, self.trusted)

    def load(self, env: VecEnv) -> OffPolicyAlgorithm:
        """
        :param env: from :meth:`make_env`
        :return: the agent
        """
        return load_agent(self.file, env, self.algo, device="cpu")


def find_subject(args: argparse.Namespace) -> Subject:
    """
    Find an agent's file, environment and statistics. What the command line names comes before the run's.

    :param args: from a parser with :func:`sb3_mcbs.zoo.arguments.add_agent`
    :return: the agent and its environment
    :raises PathError: if there is no such agent, or it is not known which environment it is for
    """
    path: Path = args.agent
    if not path.exists():
        raise PathError(f"There is no {path}. Name the folder of an RL Zoo run, or the zip of an agent.")
    if path.is_dir():
        subject = _of_run(path, args.vecnormalize)
    elif args.env is not None:
        subject = Subject(path, args.env, statistics=args.vecnormalize or statistics_beside(path))
    else:
        subject = _beside_its_run(path, args.vecnormalize)
    if args.env not in (None, subject.environment):
        subject = subject._replace(environment=args.env, env_kwargs={})
    return subject._replace(
        wrappers=args.wrapper or subject.wrappers, trusted=args.trusted, algo=args.algo or subject.algo
    )


def _beside_its_run(file: Path, statistics: Path | None) -> Subject:
    try:
        load_run(file.parent)
    except PathError as error:
        raise PathError(
            f"{file} does not say which environment it is for, and is not in the folder of an RL Zoo run: "
            "name the environment with --env."
        ) from error
    return _of_run(file.parent, statistics, file)


def _of_run(folder: Path, statistics: Path | None, file: Path | None = None) -> Subject:
    """
    :param folder: of the run.
    :param statistics: to use instead of the run's.
    :param file: of the agent; None: the last one of the run, or its best.
    """
    within = sorted(folder.glob(_OF_EXPERIMENT))
    if len(within) == 1:
        folder = within[0].parents[1]
    config, args = load_run(folder)
    file = file or _agent_of_run(folder, args["env"])
    for setting in _NOT_SEEN_THROUGH:
        if config.get(setting):
            raise PathError(
                f"{folder} was trained with {setting}, and a search cannot simulate through it. Look at the "
                "actor alone with rl_zoo3.enjoy."
            )
    statistics = statistics or (statistics_beside(file) if config.get("normalize") else None)
    if config.get("normalize") and statistics is None:
        raise PathError(
            f"{folder} was trained with normalized observations, and its statistics are not there: name "
            "them with --vecnormalize."
        )
    for package in args.get("gym_packages") or []:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise PathError(
                f"{folder} was trained with --gym-packages {package}, which cannot be imported: {error}. "
                "Install it, or start from its folder."
            ) from error
    wrappers = config.get("env_wrapper") or []
    return Subject(
        file,
        args["env"],
        args.get("env_kwargs") or {},
        wrappers if isinstance(wrappers, list) else [wrappers],
        statistics,
        algo=args["algo"] if args.get("algo") in ALGORITHMS else None,
    )


def _agent_of_run(folder: Path, env_id: str) -> Path:
    files = [folder / f"{env_id.replace('/', '-')}.zip", folder / "best_model.zip"]
    found = [file for file in files if file.is_file()]
    if not found:
        raise PathError(f"{folder} contains neither {files[0].name} nor {files[1].name}: was it trained?")
    return found[0]


def default_preset(agent: OffPolicyAlgorithm) -> Preset | None:
    """
    :param agent: the agent
    :return: how it searches where the command line does not say; None: with its own settings
    """
    return None if isinstance(agent, MCBS) else DEFAULT_PRESET
