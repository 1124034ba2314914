"""``resume``: continue a run from its checkpoints."""

import functools
import logging
import os
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

from sb3_mcbs.agents.resumable import Resumable
from sb3_mcbs.checkpoints.buffers import write_rows
from sb3_mcbs.checkpoints.components import callbacks
from sb3_mcbs.checkpoints.encoding import Encoded, of_section
from sb3_mcbs.checkpoints.errors import CheckpointError
from sb3_mcbs.checkpoints.files import check_below, make_logger
from sb3_mcbs.checkpoints.names import known_names
from sb3_mcbs.checkpoints.settings import check_settings, circumstances, log_files, make_agent, make_vec_env
from sb3_mcbs.checkpoints.state import RunState, set_networks
from sb3_mcbs.checkpoints.store import STEP, Checkpoint, Store

logger = logging.getLogger("sb3_mcbs")

#: Section of a checkpoint's arrays.
SETTINGS = "settings"
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
    run = read_run(path, classes)
    description, roots = run.checkpoint.manifest["environment"], run.roots(log_folder)
    if env is None:
        if description is None:
            raise CheckpointError(
                "The run's environment takes more than its id and plain arguments (a wrapper, or an "
                "object). Make it as you did and pass it: resume(path, env=...)."
            )
        for file in log_files(description):
            check_below(file, roots)
        env = make_vec_env(description)
    agent = make_agent(run.settings, known_names(run.classes), env)
    if agent.tensorboard_log is not None:
        check_below(agent.tensorboard_log, roots)
    set_networks(agent, run.checkpoint.state.arrays)
    run.continue_with(agent, log_folder)
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


Resumable._resume_as = resume_as


def read_run(path: str | os.PathLike[str], classes: Iterable[Any] = ()) -> "CheckpointedRun":
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
        checkpoint = store.read_newest()
    return CheckpointedRun(store, checkpoint, tuple(classes))


class CheckpointedRun:
    """A run that an agent's next ``learn`` is to finish.

    :param store: the folder of checkpoints.
    :param checkpoint: the one to continue from.
    :param classes: classes and functions that the caller trusts.
    :ivar goes_on: whether the run's state was put back; until then its files are as they were.
    """

    def __init__(self, store: Store, checkpoint: Checkpoint, classes: tuple[Any, ...]) -> None:
        self.store = store
        self.checkpoint = checkpoint
        self.classes = classes
        self.goes_on = False
        self._class_of_agent: Any = None

    @property
    def settings(self) -> Encoded:
        """The settings of the saved agent."""
        return Encoded(
            self.checkpoint.manifest["settings"], of_section(SETTINGS, self.checkpoint.state.arrays)
        )

    def roots(self, log_folder: str | os.PathLike[str] | None) -> list[Path]:
        """Return the folders that log files may be in.

        :param log_folder: as in :func:`resume`.
        """
        roots = [Path.cwd(), self.store.folder.resolve().parent]
        return roots if log_folder is None else [*roots, Path(log_folder)]

    def continue_with(
        self, agent: OffPolicyAlgorithm, log_folder: str | os.PathLike[str] | None = None
    ) -> None:
        """Have an agent finish the run in its next ``learn``.

        :param agent: made as the saved one.
        :param log_folder: as in :func:`resume`.
        """
        manifest = self.checkpoint.manifest
        folder, formats = manifest["logger"]
        agent.set_logger(make_logger(folder, formats, manifest["num_timesteps"] + 1, self.roots(log_folder)))
        # learn() adds this to the steps that it is asked for if it is not to count from 0.
        agent.num_timesteps = manifest["num_timesteps_at_start"]
        self._class_of_agent = type(agent)
        if not isinstance(agent, Resumable):
            agent.__class__ = _resumable(type(agent))
        assert isinstance(agent, Resumable)
        agent._stopped_run = self

    def check_call(self, agent: OffPolicyAlgorithm, callback: BaseCallback) -> None:
        """Refuse a call of ``learn`` that would not finish the run.

        :param agent: the agent, set up to learn.
        :param callback: its callback.
        :raises CheckpointError: names the difference.
        """
        manifest = self.checkpoint.manifest
        saved, now = manifest["total_timesteps"], agent._total_timesteps
        if saved != now:
            raise CheckpointError(
                f"The run was started for {saved} steps, learn() was called for {now}. Repeat the "
                "original call."
            )
        theirs = {name: cls for name, cls in manifest["parts"].items() if _is_callback(name)}
        ours = {
            name: f"{type(cb).__module__}.{type(cb).__qualname__}"
            for name, cb in callbacks("callback", callback)
        }
        if theirs != ours:
            raise CheckpointError(
                f"The run had the callbacks {_short(theirs)}; learn() was called with {_short(ours)}. Pass "
                "the same ones in the same order."
            )
        if manifest["num_timesteps"] >= now:
            # Stopped at its end: learn() collects nothing, and all is put back when training ends.
            agent.num_timesteps = manifest["num_timesteps"]

    def put_back(self, agent: OffPolicyAlgorithm, run: RunState, settings: Encoded) -> None:
        """Put the run into the saved state.

        :param agent: the agent, about to collect its first rollout, or at its end if none is left.
        :param run: all of the run.
        :param settings: of the agent.
        """
        check_settings(self.settings, settings)
        assert isinstance(agent, Resumable) and agent.replay_buffer is not None
        write_rows(agent.replay_buffer, self.store.read_rows(self.checkpoint.manifest["rows"]))
        run.restore(self.checkpoint.state, self.classes)
        self.goes_on = True
        del agent._stopped_run
        agent.__class__ = self._class_of_agent
        self._say(agent)

    def _say(self, agent: OffPolicyAlgorithm) -> None:
        manifest = self.checkpoint.manifest
        now = circumstances(agent)
        differences = list(manifest["inexact"])
        for name, value in manifest["circumstances"].items():
            if now.get(name) != value:
                differences.append(f"{name}: {value} then, {now.get(name)} now")
        step = manifest["num_timesteps"]
        if differences:
            message = f"Resumed at {step} steps, not exact: {'; '.join(differences)}."
            logger.warning(message)
            warnings.warn(message, stacklevel=2)
        else:
            logger.info("Resumed at %d steps.", step)
            if agent.verbose >= 1:
                print(f"Resumed at {step} steps.")


def run_of(agent: Any) -> CheckpointedRun | None:
    """Return the run that an agent is to finish, if there is one.

    :param agent: the agent.
    """
    return getattr(agent, "_stopped_run", None)


@functools.cache
def _resumable(cls: type[OffPolicyAlgorithm]) -> type[OffPolicyAlgorithm]:
    """The class that an agent of SB3's is of until its run goes on: its own, and :class:`Resumable`."""
    named_alike = {name: getattr(cls, name) for name in ("__module__", "__qualname__", "__doc__")}
    return type(cls.__name__, (Resumable, cls), named_alike)


def _is_callback(name: str) -> bool:
    return name.startswith("callback") and ".layers[" not in name and not name.endswith(".model")


def _short(names: dict[str, str]) -> str:
    return ", ".join(name.rpartition(".")[2] for name in names.values()) or "none"
