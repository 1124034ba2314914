"""A run that waits to be continued: attached to an agent, carried out when its ``learn`` has set up."""

import logging
import warnings
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_mcbs.checkpoints.buffers import write_rows
from sb3_mcbs.checkpoints.components import callbacks
from sb3_mcbs.checkpoints.encoding import Encoded, of_section
from sb3_mcbs.checkpoints.errors import CheckpointError
from sb3_mcbs.checkpoints.files import make_logger
from sb3_mcbs.checkpoints.settings import check_settings, circumstances
from sb3_mcbs.checkpoints.state import Captured, RunState
from sb3_mcbs.checkpoints.store import Checkpoint, Store

logger = logging.getLogger("sb3_mcbs")

#: Section of a checkpoint's arrays.
SETTINGS = "settings"
_PENDING = "_resumption"
#: Attributes that an agent has of its own until its run was resumed.
_UNTIL_RESUMED = (_PENDING, "_setup_learn", "_excluded_save_params")


class Resumption:
    """What an agent is to continue.

    :param store: the folder of checkpoints.
    :param checkpoint: the one to continue from.
    :param classes: classes and functions that the caller trusts.
    :ivar is_carried_out: whether the run goes on; until then its files are as they were.
    """

    def __init__(self, store: Store, checkpoint: Checkpoint, classes: tuple[Any, ...]) -> None:
        self.store = store
        self.checkpoint = checkpoint
        self.classes = classes
        self.is_carried_out = False

    @property
    def settings(self) -> Encoded:
        """The settings of the saved agent."""
        return Encoded(self.checkpoint.manifest["settings"], of_section(SETTINGS, self.checkpoint.arrays))

    def attach(self, agent: OffPolicyAlgorithm, roots: list[Path]) -> None:
        """Have an agent continue the run in its next ``learn``.

        :param agent: an agent that was made as the saved one.
        :param roots: folders that log files may be in.
        """
        manifest = self.checkpoint.manifest
        folder, formats = manifest["logger"]
        agent.set_logger(make_logger(folder, formats, manifest["num_timesteps"] + 1, roots))
        # learn() adds this to the steps that it is asked for if it is not to count from 0.
        agent.num_timesteps = manifest["num_timesteps_at_start"]
        setup_learn, excluded_save_params = agent._setup_learn, agent._excluded_save_params

        def checked_setup_learn(*args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
            total, callback = setup_learn(*args, **kwargs)
            self.check_call(agent, callback)
            if manifest["num_timesteps"] >= total:
                # Stopped at its end: learn() collects nothing, and all is put back when training ends.
                agent.num_timesteps = manifest["num_timesteps"]
            return total, callback

        # Without the callback nobody would notice that the run starts from the beginning.
        vars(agent).update(
            {
                _PENDING: self,
                "_setup_learn": checked_setup_learn,
                "_excluded_save_params": lambda: [*excluded_save_params(), *_UNTIL_RESUMED],
            }
        )

    def check_call(self, agent: OffPolicyAlgorithm, callback: BaseCallback) -> None:
        """Refuse a call of ``learn`` that would not finish the run.

        :param agent: the agent, set up to learn.
        :param callback: its callback.
        :raises CheckpointError: names the difference.
        """
        saved, now = self.checkpoint.manifest["total_timesteps"], agent._total_timesteps
        if saved != now:
            raise CheckpointError(
                f"The run was started for {saved} steps, learn() was called for {now}. Repeat the "
                "original call."
            )
        parts = self.checkpoint.manifest["parts"]
        theirs = {name: cls for name, cls in parts.items() if _is_callback(name)}
        ours = {
            name: f"{type(cb).__module__}.{type(cb).__qualname__}"
            for name, cb in callbacks("callback", callback)
        }
        if theirs != ours:
            raise CheckpointError(
                f"The run had the callbacks {_short(theirs)}; learn() was called with {_short(ours)}. Pass "
                "the same ones in the same order."
            )

    def carry_out(self, agent: OffPolicyAlgorithm, run: RunState, settings: Encoded) -> None:
        """Put the run into the saved state.

        :param agent: the agent, about to collect its first rollout, or at its end if none is left.
        :param run: all of the run.
        :param settings: of the agent.
        """
        check_settings(self.settings, settings)
        assert agent.replay_buffer is not None
        checkpoint = self.checkpoint
        write_rows(agent.replay_buffer, self.store.read_rows(checkpoint.manifest["rows"]))
        run.restore(Captured(checkpoint.state, checkpoint.arrays), self.classes)
        self.is_carried_out = True
        for name in _UNTIL_RESUMED:
            del vars(agent)[name]
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
        if agent.verbose >= 1 and not differences:
            print(f"Resumed at {step} steps.")


def pending(agent: Any) -> Resumption | None:
    """Return the run that an agent is to continue, if there is one.

    :param agent: the agent.
    """
    return getattr(agent, _PENDING, None)


def _is_callback(name: str) -> bool:
    return name.startswith("callback") and ".layers[" not in name and not name.endswith(".model")


def _short(names: dict[str, str]) -> str:
    return ", ".join(name.rpartition(".")[2] for name in names.values()) or "none"
