"""Environments as commands name them: an id, ``module:Id``, or a function in a Python file."""

import importlib.util
import os
import pickle
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_mcbs.loading import load_statistics
from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.zoo import import_with_zoo

#: What :func:`find_environment` reads, for the help of commands.
ENV_HELP = "an id (HalfCheetah-v5), module:Id, or a function in a Python file (my_env.py:make)"
#: Names of files with the statistics of a ``VecNormalize``, as RL Zoo and this package's documentation use.
STATISTICS = ("statistics.npz", "vecnormalize.npz", "vecnormalize.pkl", "vec_normalize.pkl")


class NoEnvironmentError(ValueError):
    """There is no such environment, or it cannot be made; the message says why."""


def find_environment(name: str, wrappers: Sequence[Any] = ()) -> Callable[..., gym.Env]:
    """
    Find what makes an environment. An id is looked up when it is called.

    :param name: an id, ``module:Id``, or ``path.py:function``
    :param wrappers: names of wrappers, innermost first, as RL Zoo's ``env_wrapper`` has them
    :return: makes the environment with its wrappers, from keyword arguments
    :raises NoEnvironmentError: if the file cannot be read, or there is no such function or wrapper
    """
    if os.getcwd() not in sys.path and "" not in sys.path:  # as with python -m
        sys.path.insert(0, os.getcwd())
    make = _function_in_file(name) if is_file(name) else _registered(name)
    utils: Any = import_with_zoo("rl_zoo3.utils") if wrappers else None
    try:
        wrap = utils.get_wrapper_class({"env_wrapper": list(wrappers)}) if wrappers else None
    except (ImportError, AttributeError, ValueError) as error:
        raise NoEnvironmentError(
            f"The wrappers {', '.join(map(str, wrappers))} cannot be imported: {error}. Write each as "
            "module.Class; the module must be importable from here."
        ) from error

    def make_wrapped(**kwargs: Any) -> gym.Env:
        try:
            env = make(**kwargs)
            return env if wrap is None else wrap(env)
        except NoEnvironmentError:
            raise
        except Exception as error:  # the environment's code may raise anything
            raise NoEnvironmentError(f"{name} cannot be made: {in_words(error)}.") from error

    return make_wrapped


def is_file(name: str) -> bool:
    """
    :param name: of an environment
    :return: whether it names a Python file
    """
    return name.partition(":")[0].endswith(".py")


def _registered(name: str) -> Callable[..., gym.Env]:
    def make(**kwargs: Any) -> gym.Env:
        try:
            return gym.make(name, **kwargs)
        except (gym.error.UnregisteredEnv, ModuleNotFoundError) as error:
            hint = "" if ":" in name else f" Those of another package are found as module:{name}."
            raise NoEnvironmentError(f"{error}{hint}") from error

    return make


def _function_in_file(name: str) -> Callable[..., gym.Env]:
    file, _, function = name.partition(":")
    path = Path(file).absolute()
    if not path.is_file():
        raise NoEnvironmentError(f"There is no file {file}.")
    # Its own imports find their neighbours, as when the file is run.
    sys.path.insert(0, str(path.parent))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise NoEnvironmentError(f"{error.filename}, line {error.lineno}: {error.msg}.") from error
    except Exception as error:
        raise NoEnvironmentError(f"{file} cannot be imported: {in_words(error)}.") from error
    make = getattr(module, function, None)
    if not callable(make):
        own = [
            each
            for each, value in vars(module).items()
            if callable(value) and getattr(value, "__module__", None) == path.stem
        ]
        raise NoEnvironmentError(
            f"{f'{file} has no function {function!r}' if function else 'The function is missing'}: write "
            f"{file}:FUNCTION with one that returns the environment. There is {', '.join(own) or 'none'}."
        )

    def checked(**kwargs: Any) -> gym.Env:
        env = make(**kwargs)
        if not isinstance(env, gym.Env):
            raise NoEnvironmentError(f"{name} returned {env!r} instead of a gymnasium.Env.")
        return env

    return checked


def in_words(error: BaseException) -> str:
    """
    :param error: what was raised
    :return: its class, its message, and where it came from
    """
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {error}{where}"


def drawn(make: Callable[..., gym.Env]) -> Callable[..., gym.Env]:
    """
    :param make: from :func:`find_environment`
    :return: makes the environment with the render mode ``rgb_array``, if it has render modes
    """

    def make_drawn(**kwargs: Any) -> gym.Env:
        try:
            return make(**{**kwargs, "render_mode": "rgb_array"})
        except NoEnvironmentError as error:
            if not isinstance(error.__cause__, TypeError):
                raise
            return make(
                **kwargs
            )  # MuJoCo's scene needs no render mode; where one is needed, the video says so

    return make_drawn


def make_searchable(make: Callable[..., gym.Env], **kwargs: Any) -> VecEnv:
    """
    Make a single vectorized environment to search in.

    :param make: from :func:`find_environment`
    :param kwargs: of the environment
    """
    return make_vec_env(make, env_kwargs=kwargs, wrapper_class=SnapshotEnvWrapper)


def check_trust(statistics: Path | None, trusted: bool) -> None:
    """
    :param statistics: the file with statistics of a ``VecNormalize``; None: none
    :param trusted: whether the author of a pickle is trusted with this machine
    :raises PermissionError: if it is a pickle, and its author is not trusted
    :raises FileNotFoundError: if it is not there
    """
    if statistics is not None and not statistics.is_file():
        raise FileNotFoundError(f"There is no file {statistics}.")
    if statistics is not None and statistics.suffix != ".npz" and not trusted:
        raise PermissionError(
            f"{statistics} is a pickle: reading it runs whatever code its author put in. If it is yours, or "
            "you trust its author, say so with --trusted; or see sb3-mcbs convert-statistics."
        )


def normalized(env: VecEnv, statistics: Path | None, trusted: bool) -> VecEnv:
    """
    Normalize observations as in training.

    :param env: the environment
    :param statistics: of a ``VecNormalize``, as npz, or as a pickle of a trusted author; None: none
    :param trusted: whether the pickle's author is trusted with this machine
    :return: the environment itself if there are no statistics
    """
    check_trust(statistics, trusted)
    if statistics is None:
        return env
    if statistics.suffix == ".npz":
        return load_statistics(statistics, env)
    normalizer = unpickle_statistics(statistics)
    shape = normalizer.observation_space.shape
    if shape != env.observation_space.shape:
        raise ValueError(
            f"{statistics} has statistics of observations of shape {shape}, and the environment's have "
            f"{env.observation_space.shape}: is it the one that the agent was trained in?"
        )
    normalizer.set_venv(env)
    normalizer.training = False
    return normalizer


def unpickle_statistics(path: Path) -> VecNormalize:
    """
    Read a pickle, which runs its code.

    :param path: a file from ``VecNormalize.save`` or RL Zoo
    :return: the statistics
    :raises ValueError: if the file is not a pickle, its code fails, or it contains something else
    """
    with path.open("rb") as stream:
        try:
            normalizer = pickle.load(stream)
        except Exception as error:  # the pickle's code may raise anything
            raise ValueError(
                f"{path} cannot be unpickled ({type(error).__name__}: {error}). Name a file that "
                "VecNormalize.save or RL Zoo wrote, usually vecnormalize.pkl."
            ) from error
    if not isinstance(normalizer, VecNormalize):
        raise ValueError(f"{path} has no VecNormalize in it, but a {type(normalizer).__name__}.")
    return normalizer


def statistics_beside(file: Path) -> Path | None:
    """
    :param file: of an agent
    :return: the file with statistics of its observations, in the same folder or in RL Zoo's below it
    """
    folders = [file.parent, *(path.parent for path in sorted(file.parent.glob("*/args.yml")))]
    return next(
        (folder / name for folder in folders for name in STATISTICS if (folder / name).is_file()), None
    )
