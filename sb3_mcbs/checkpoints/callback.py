"""``ExactCheckpointCallback``: checkpoints from which a run goes on as if it had never stopped."""

import json
import logging
import os
import signal
import sys
import warnings
from collections.abc import Collection
from typing import Any, ClassVar

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_mcbs.checkpoints.buffers import added_rows, check_buffer, read_rows, rows_held
from sb3_mcbs.checkpoints.encoding import in_section
from sb3_mcbs.checkpoints.errors import CheckpointError
from sb3_mcbs.checkpoints.files import describe_format
from sb3_mcbs.checkpoints.interrupts import Interrupts, TrainingInterrupted
from sb3_mcbs.checkpoints.resume import SETTINGS, run_of
from sb3_mcbs.checkpoints.settings import circumstances, describe_agent, describe_vec_env, inexact
from sb3_mcbs.checkpoints.state import RunState
from sb3_mcbs.checkpoints.store import Store
from sb3_mcbs.snapshot import SnapshotUnsupportedError

logger = logging.getLogger("sb3_mcbs")

#: Says in the folder of checkpoints that a signal stopped the run.
MARK = "interrupted.json"


class ExactCheckpointCallback(BaseCallback):
    """
    Writes checkpoints from which :func:`sb3_mcbs.resume` goes on bit for bit as if nothing had happened.

    A checkpoint is everything that decides the future: networks, optimizers, replay buffer, environments,
    random generators, statistics, callbacks and log files. It is written between two rollouts, before the
    first step and then every ``save_freq`` steps. Ctrl-C and SIGTERM stop training after a checkpoint; a
    second signal stops at once.

    Use it in the list of callbacks, not inside another callback::

        agent.learn(100_000, callback=[ExactCheckpointCallback(10_000, "run/checkpoints"), EvalCallback(env)])

    :param save_freq: environment steps between two checkpoints, of all environments together; rounded up to
        the end of a rollout
    :param path: a folder for this run's checkpoints alone; None: RL Zoo's run folder, in runs of RL Zoo
    :param keep_last: how many checkpoints to keep. Two, so that there is a good one if the last is damaged
    :param verbose: Verbosity level: 0 for no output, 1 for a line per checkpoint
    """

    not_checkpointed: ClassVar[Collection[str]] = {
        "path": "where to write is not for a checkpoint to decide",
        **dict.fromkeys(
            ("store", "_run", "_interrupts", "_settings", "_vec_env", "_parts", "_begun"),
            "made anew when training begins",
        ),
    }

    def __init__(
        self, save_freq: int, path: str | os.PathLike[str] | None = None, keep_last: int = 2, verbose: int = 0
    ) -> None:
        super().__init__(verbose)
        for name, value in (("save_freq", save_freq), ("keep_last", keep_last)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} must be an integer of 1 or more, got {value!r}.")
        self.save_freq = save_freq
        self.path = path
        self.keep_last = keep_last
        self._next_save = 0
        self._rows_added = 0
        self._position = 0
        self._n_calls_then = 0
        self._parts: list[dict[str, Any]] = []
        self._begun = False
        self._run: RunState | None = None
        self._interrupts = Interrupts()

    def _init_callback(self) -> None:
        self._check_place()
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise CheckpointError(
                f"{type(self.model).__name__} is not an off-policy algorithm; exact checkpoints are for "
                "those."
            )
        if self.path is None:
            raise CheckpointError(
                "ExactCheckpointCallback needs a path: a folder for this run's checkpoints."
            )
        check_buffer(self.model.replay_buffer)
        self.store = Store(self.path)
        newest = max(self.store.steps(), default=None)
        goes_on = self._begun and newest is not None and newest <= self.model.num_timesteps
        if newest is not None and not self._is_resumed_here() and not goes_on:
            raise CheckpointError(
                f"{self.path} holds the checkpoints of a run. Continue it with sb3_mcbs.resume, or choose "
                "another folder."
            )

    def _check_place(self) -> None:
        if self.parent is not None:
            raise CheckpointError(
                f"ExactCheckpointCallback is inside a {type(self.parent).__name__}, which does not say when "
                "a rollout starts. Pass it to learn() itself, in a list with the others."
            )

    def _is_resumed_here(self) -> bool:
        stopped = run_of(self.model)
        return stopped is not None and stopped.store.folder.resolve() == self.store.folder.resolve()

    def _on_training_start(self) -> None:
        self._check_place()
        self._run = None  # there still if the last call of learn() was stopped

    def _on_rollout_start(self) -> None:
        if self._run is None:
            self._begin()
        self._count_rows()
        stopped_by = self._interrupts.received
        if self.num_timesteps >= self._next_save or stopped_by is not None:
            self._next_save = (self.num_timesteps // self.save_freq + 1) * self.save_freq
            self._save_or_warn()
        if stopped_by is not None:
            self._stop(stopped_by)

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        if run_of(self.model) is not None:
            self._begin()
        stopped_by = self._interrupts.received
        if self._run is not None and stopped_by is not None:
            # A run that a callback ended stops there again from the checkpoint before.
            if self.num_timesteps >= self._agent._total_timesteps:
                self._count_rows()
                self._save_or_warn()
            self._stop(stopped_by)
        self._interrupts.end()
        self._run = None

    @property
    def _agent(self) -> OffPolicyAlgorithm:
        assert isinstance(self.model, OffPolicyAlgorithm)
        return self.model

    def _begin(self) -> None:
        """Take stock of the run, once all of it is there, and continue a saved one if that is wanted."""
        agent = self._agent
        assert agent.env is not None and agent.replay_buffer is not None
        run = RunState(agent, self.locals["callback"])
        run.verify()  # the first checkpoint of this call may be one whose failure is only a warning
        self._run, self._begun = run, True
        self._settings = describe_agent(agent)
        self._vec_env = describe_vec_env(agent.env)
        self._position, self._rows_added = agent.replay_buffer.pos, rows_held(agent.replay_buffer)
        self._n_calls_then, self._next_save, self._parts = self.n_calls, self.num_timesteps, []
        stopped = run_of(agent)
        if stopped is not None:
            resumed_here = self._is_resumed_here()
            stopped.put_back(agent, run, self._settings)
            if resumed_here:
                self._parts = stopped.checkpoint.manifest["rows"]
            (self.store.folder / MARK).unlink(missing_ok=True)
        self._interrupts.begin(agent, run.in_workers)

    def _count_rows(self) -> None:
        buffer, steps = self._agent.replay_buffer, self.n_calls - self._n_calls_then
        assert buffer is not None
        self._rows_added += added_rows(buffer, self._position, steps)
        self._position, self._n_calls_then = buffer.pos, self.n_calls

    def _save_or_warn(self) -> None:
        first = not self.store.steps()
        try:
            self._save()
        except (OSError, CheckpointError, SnapshotUnsupportedError) as error:
            if first and not isinstance(error, OSError):
                raise  # better known before training than in the middle of it
            outlook = f"Training goes on; the next one is due at {self._next_save} steps."
            if isinstance(error, OSError):
                outlook += " Make room on the disk, or make the folder writable, before that."
            message = (
                f"No checkpoint could be written at {self.num_timesteps} steps: {str(error).rstrip('.')}. "
                f"{outlook if self._interrupts.received is None else 'Training stops.'} "
                f"What {self.path} holds is kept."
            )
            logger.warning(message)
            warnings.warn(message, stacklevel=2)

    def _save(self) -> None:
        agent, buffer = self._agent, self._agent.replay_buffer
        assert self._run is not None and buffer is not None
        state = self._run.capture()
        oldest = self._rows_added - rows_held(buffer)
        parts = [part for part in self._parts if part["end"] >= oldest and part["end"] <= self._rows_added]
        if not all(self.store.has_rows(part) for part in parts):
            parts = []  # somebody has removed them
        first = max([oldest, *(part["end"] for part in parts)])
        if first < self._rows_added:
            rows = read_rows(buffer, first, self._rows_added)
            parts.append(self.store.write_rows(first, self._rows_added, rows))
        manifest = {**self._describe(agent), "rows": parts}
        state.arrays.update(in_section(SETTINGS, self._settings.arrays))
        self.store.write(self.num_timesteps, manifest, state)
        self._parts = parts
        self.store.clean(self.keep_last, self.num_timesteps)
        if self.verbose >= 1:
            print(f"Exact checkpoint at {self.num_timesteps} steps in {self.path}")

    def _describe(self, agent: OffPolicyAlgorithm) -> dict[str, Any]:
        assert self._run is not None
        return {
            "num_timesteps": agent.num_timesteps,
            "num_timesteps_at_start": agent._num_timesteps_at_start,
            "total_timesteps": agent._total_timesteps,
            "settings": self._settings.json,
            "environment": self._vec_env,
            "parts": self._run.class_names,
            "logger": [agent.logger.dir, [describe_format(each) for each in agent.logger.output_formats]],
            "circumstances": circumstances(agent),
            "inexact": inexact(agent),
        }

    def _stop(self, signum: int) -> None:
        mark = {"signal": signal.Signals(signum).name, "num_timesteps": self.num_timesteps}
        try:
            (self.store.folder / MARK).write_text(json.dumps(mark) + "\n")
        except OSError as error:
            logger.warning("The folder could not be marked as interrupted: %s", error)
        self._interrupts.end()
        print(f"Stopped by {mark['signal']} at {self.num_timesteps} steps.", file=sys.stderr)
        raise TrainingInterrupted(signum)
