"""``resume``: continue a run from its checkpoints."""

import os
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

from sb3_mcbs.agents.mcbs import MCBS
from sb3_mcbs.checkpoints.errors import CheckpointError
from sb3_mcbs.checkpoints.files import check_below
from sb3_mcbs.checkpoints.names import known_names
from sb3_mcbs.checkpoints.resumption import Resumption
from sb3_mcbs.checkpoints.settings import log_files, make_agent, make_vec_env
from sb3_mcbs.checkpoints.state import set_networks
from sb3_mcbs.checkpoints.store import STEP, Store

_Agent = TypeVar("_Agent", bound=OffPolicyAlgorithm)


def resume(
    path: str | os.PathLike[str],
    env: GymEnv | None = None,
    classes: Iterable[Any] = (),
    log_folder: str | os.PathLike[str] | None = None,
) -> OffPolicyAlgorithm:
    """
    Continue a run that :class:`ExactCheckpointCallback` saved.

    The original call of ``learn`` has to be repeated, with the same callbacks; it finishes the run, and all
    of it, log files included, is as if the run had never stopped::

        agent = resume("run/checkpoints")
        agent.learn(100_000, callback=[ExactCheckpointCallback(10_000, "run/checkpoints"), ...])

    Nothing in a checkpoint is executed. The environment is made from its id and its plain arguments if that
    is all that it takes.

    :param path: the folder of checkpoints, of which the newest that is whole is used, or one checkpoint in it
    :param env: the environment, made as the original one was
    :param classes: classes and functions of your own that the run uses in its settings, such as a features
        extractor. A checkpoint only names them
    :param log_folder: a folder above the run's log files, if they are neither below the present folder nor
        beside the checkpoints
    :return: an agent of the saved class, with its networks; all else is put back when ``learn`` begins
    :raises CheckpointError: if there is no whole checkpoint, or it needs ``env`` or ``classes``
    """
    resumption = read_resumption(path, classes)
    manifest = resumption.checkpoint.manifest
    roots = _roots(resumption.store, log_folder)
    names = known_names(resumption.classes)
    if env is None:
        if manifest["environment"] is None:
            raise CheckpointError(
                "The run's environment takes more than its id and plain arguments (a wrapper, or an "
                "object). Make it as you did and pass it: resume(path, env=...)."
            )
        for file in log_files(manifest["environment"]):
            check_below(file, roots)
        env = make_vec_env(manifest["environment"])
    agent = make_agent(resumption.settings, names, env)
    if agent.tensorboard_log is not None:
        check_below(agent.tensorboard_log, roots)
    set_networks(agent, resumption.checkpoint.arrays)
    resumption.attach(agent, roots)
    return agent


def resume_as(cls: type[_Agent], path: str | os.PathLike[str], env: GymEnv | None, **kwargs: Any) -> _Agent:
    """Continue a run of a known class.

    :param cls: the class that the agent must have.
    :param path: as in :func:`resume`.
    :param env: as in :func:`resume`.
    :param kwargs: the other arguments of :func:`resume`.
    :raises CheckpointError: if the run's agent is of another class.
    """
    agent = resume(path, env, **kwargs)
    if not isinstance(agent, cls):
        raise CheckpointError(
            f"The run in {path} is of a {type(agent).__name__}, not of a {cls.__name__}. Use sb3_mcbs.resume."
        )
    return agent


MCBS._resume_as = resume_as


def read_resumption(path: str | os.PathLike[str], classes: Iterable[Any] = ()) -> Resumption:
    """Read what is to be continued.

    :param path: as in :func:`resume`.
    :param classes: as in :func:`resume`.
    """
    path = Path(path)
    if path.name.startswith(STEP):
        store = Store(path.parent)
        checkpoint = store.read(int(path.name.removeprefix(STEP)))
    else:
        store = Store(path)
        checkpoint = store.read_newest(lambda message: warnings.warn(message, stacklevel=4))
    return Resumption(store, checkpoint, tuple(classes))


def continue_with(
    agent: OffPolicyAlgorithm, resumption: Resumption, log_folder: str | os.PathLike[str] | None = None
) -> None:
    """Have an agent that is there already continue a run.

    :param agent: made as the saved one.
    :param resumption: from :func:`read_resumption`.
    :param log_folder: as in :func:`resume`.
    """
    resumption.attach(agent, _roots(resumption.store, log_folder))


def _roots(store: Store, log_folder: str | os.PathLike[str] | None) -> list[Path]:
    roots = [Path.cwd(), store.folder.resolve().parent]
    return roots if log_folder is None else [*roots, Path(log_folder)]
