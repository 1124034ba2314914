"""A run while it is looked after: what trains it, its attempts, how fast it is."""

import time
from collections.abc import Callable
from typing import Any

from sb3_mcbs.experiments.process import Lost, Trainer
from sb3_mcbs.experiments.results import FINISHED, RunFolder


class Job:
    """
    A run that is to be finished.

    :param folder: of the run
    """

    def __init__(self, folder: RunFolder) -> None:
        self.folder = folder
        self.run = folder.run()
        #: waiting, queued, running, finished, failed, interrupted, or taken by another runner.
        self.state: str = folder.status["state"] if folder.status["state"] == FINISHED else "waiting"
        self.crashes = 0
        #: Whether it was started from a checkpoint.
        self.goes_on = False
        #: How often in a row it was lost without a new checkpoint.
        self.losses = 0
        self.exit_status: int | None = None
        #: Why it has no exit status, if it was lost.
        self.lost: Lost | None = None
        self.progress: dict[str, Any] = folder.progress
        self._trainer: Trainer | None = None
        self._checkpoint_at_loss: int | None = None
        #: When it began and when it was last seen, and its steps then.
        self._times: list[tuple[float, int]] = []

    def start(self, launch: Callable[[RunFolder], Trainer]) -> None:
        """
        Have it trained. It is queued until its trainer has a place.

        :param launch: from the run's folder, what trains it
        """
        self.state = "queued"
        self.goes_on = self.folder.newest_checkpoint(self.run) is not None
        self._times.clear()
        self.folder.progress_file.unlink(missing_ok=True)
        self.folder.status = {"state": "running", "started": time.time(), "crashes": self.crashes}
        self._trainer = launch(self.folder)

    def ask_to_stop(self) -> None:
        """Let the run write a checkpoint and end."""
        if self._trainer is not None:
            self._trainer.ask_to_stop()

    def kill(self) -> None:
        """End the run and its worker processes at once."""
        if self._trainer is not None:
            self._trainer.kill()

    @property
    def where(self) -> str | None:
        """Where it is trained; None if it is not, or waits for a place."""
        return None if self._trainer is None else self._trainer.where

    def has_ended(self) -> bool:
        """
        :return: whether its process has ended; ``exit_status`` is known then, or that it was ``lost``
        """
        assert self._trainer is not None
        outcome = self._trainer.poll()
        if outcome is None:
            return False
        self._trainer = None
        self.lost = outcome if isinstance(outcome, Lost) else None
        self.exit_status = None if isinstance(outcome, Lost) else outcome
        return True

    def note_loss(self) -> None:
        """Count a loss; from the first one again if there has been a new checkpoint since the last."""
        newest = self.folder.newest_checkpoint(self.run)
        self.losses = self.losses + 1 if newest == self._checkpoint_at_loss else 1
        self._checkpoint_at_loss = newest

    def end(self, state: str) -> None:
        """
        Note how it ended, and leave the run to whoever wants it.

        :param state: what it is now
        """
        self.state = state
        # The process itself has written that it is finished. What was lost may be another runner's by now.
        if state != FINISHED and self.folder.lock.is_held:
            self.folder.status = {
                **self.folder.status, "state": state, "ended": time.time(), "crashes": self.crashes,
                "exit_status": self.exit_status,
            }  # fmt: skip
        self.progress = self.folder.progress
        self.folder.lock.give_back()

    def look(self) -> bool:
        """
        See how far it is.

        :return: whether it was evaluated since the last look
        """
        before, reported = self.progress, self.folder.progress
        if not reported:  # it does not train yet
            return False
        self.progress = reported
        if self._times and self.step < self._times[-1][1]:  # a checkpoint lies before what was done
            self._times.clear()
        self._times.append((time.monotonic(), self.step))
        del self._times[1:-1]
        return self.progress.get("evaluations", 0) > before.get("evaluations", 0)

    @property
    def step(self) -> int:
        """Environment steps that it has done."""
        return int(self.progress.get("step", 0))

    @property
    def returns(self) -> dict[str, float]:
        """Mean return of each policy in the last evaluation."""
        return dict(self.progress.get("returns", {}))

    @property
    def steps_per_second(self) -> float | None:
        """On average since it was started, evaluations included; None as long as nobody knows."""
        if self.state != "running" or len(self._times) < 2:
            return None
        (then, before), (now, step) = self._times[0], self._times[-1]
        return (step - before) / (now - then) if step > before else None

    @property
    def seconds_left(self) -> float | None:
        """Until it is finished; None as long as nobody knows."""
        speed = self.steps_per_second
        return None if speed is None else max(0, self.run.steps - self.step) / speed
