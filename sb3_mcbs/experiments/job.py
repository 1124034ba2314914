"""A run while it is looked after: its process, its attempts, how fast it is."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from sb3_mcbs.experiments.results import FINISHED, RunFolder

#: Libraries that would otherwise take a thread per core for every run.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
#: Of prctl: the signal that a process gets when its parent ends.
_PR_SET_PDEATHSIG = 1


def command(folder: RunFolder) -> list[str]:
    """
    :param folder: of a run
    :return: the command that trains it
    """
    return [sys.executable, "-m", "sb3_mcbs.experiments.train_run", str(folder.path)]


def _ending_with(parent: int) -> Callable[[], None] | None:
    """What a child process does first so that it ends with its parent, even if that is killed: on Linux."""
    if not sys.platform.startswith("linux"):
        return None
    prctl = ctypes.CDLL(None).prctl

    def end_with_parent() -> None:
        prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it has ended already
            os._exit(1)

    return end_with_parent


class Job:
    """
    A run that is to be finished.

    :param folder: of the run
    """

    def __init__(self, folder: RunFolder) -> None:
        self.folder = folder
        self.run = folder.run()
        #: waiting, running, finished, failed, interrupted, or taken by another runner.
        self.state: str = folder.status["state"] if folder.status["state"] == FINISHED else "waiting"
        self.crashes = 0
        self.exit_status: int | None = None
        self.progress: dict[str, Any] = folder.progress
        self._process: subprocess.Popen | None = None
        #: When it began and when it was last seen, and its steps then.
        self._times: list[tuple[float, int]] = []

    def start(self, argv: Sequence[str]) -> None:
        """
        Start its process, which holds the run's lock as this one does.

        :param argv: the command that trains it
        """
        self.state = "running"
        self._times.clear()
        self.folder.progress_file.unlink(missing_ok=True)
        self.folder.status = {"state": "running", "started": time.time(), "crashes": self.crashes}
        with self.folder.log.open("a") as log:
            log.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')}: {subprocess.list2cmdline(argv)}\n")
            log.flush()
            self._process = subprocess.Popen(
                argv,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **_ONE_THREAD, "PYTHONUNBUFFERED": "1"},
                pass_fds=[self.folder.lock.descriptor],
                # Ctrl-C in a terminal reaches the runner alone, which passes it on.
                start_new_session=True,
                preexec_fn=_ending_with(os.getpid()),
            )

    def ask_to_stop(self) -> None:
        """Let the run write a checkpoint and end."""
        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End the run and its worker processes at once."""
        if self._process is not None:
            os.killpg(self._process.pid, signal.SIGKILL)

    def has_ended(self) -> bool:
        """
        :return: whether its process has ended; ``exit_status`` is known then
        """
        assert self._process is not None
        self.exit_status = self._process.poll()
        if self.exit_status is None:
            return False
        self._process = None
        return True

    def end(self, state: str) -> None:
        """
        Note how it ended, and leave the run to whoever wants it.

        :param state: what it is now
        """
        self.state = state
        if state != FINISHED:  # the process itself has written that
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
