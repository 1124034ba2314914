"""What trains a run: a process of its own, here or on another node."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

from sb3_mcbs.experiments.results import RunFolder

#: Libraries that would otherwise take a thread per core for every run.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
#: Of prctl: the signal that a process gets when its parent ends.
_PR_SET_PDEATHSIG = 1


class Lost(NamedTuple):
    """
    A run's process is gone, through no fault of the run: its node has ended, for example.

    :param reason: what is known about it
    """

    reason: str


class Trainer(Protocol):
    """What an engine knows about that which trains a run."""

    #: Where it trains, to be printed after "started"; None as long as it waits for a place.
    where: str | None

    def poll(self) -> int | Lost | None:
        """
        :return: the exit status, once it has ended; the run's lock is held here then, unless it was lost
        """

    def ask_to_stop(self) -> None:
        """Let the run write a checkpoint and end."""

    def kill(self) -> None:
        """End the run and its worker processes at once."""


def command(folder: RunFolder) -> list[str]:
    """
    :param folder: of a run
    :return: the command that trains it
    """
    return [sys.executable, "-m", "sb3_mcbs.experiments.train_run", str(folder.path)]


def start_process(folder: RunFolder) -> "Process":
    """
    Train a run on this machine.

    :param folder: of the run, whose lock is held here
    :return: its process
    """
    return Process(folder, command(folder))


class Process:
    """
    A process of this machine that trains a run, and holds its lock as this one does.

    :param folder: of the run
    :param argv: the command that trains it
    :param environment: variables for it
    """

    where: str | None = ""

    def __init__(
        self, folder: RunFolder, argv: Sequence[str], environment: Mapping[str, str] | None = None
    ) -> None:
        with folder.log.open("a") as log:
            log.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')}: {subprocess.list2cmdline(argv)}\n")
            log.flush()
            self._process = subprocess.Popen(
                argv,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **_ONE_THREAD, "PYTHONUNBUFFERED": "1", **(environment or {})},
                pass_fds=[folder.lock.descriptor],
                # Ctrl-C in a terminal reaches the runner alone, which passes it on.
                start_new_session=True,
                preexec_fn=_ending_with(os.getpid()),
            )

    def poll(self) -> int | None:
        """
        :return: the exit status, once it has ended
        """
        return self._process.poll()

    def ask_to_stop(self) -> None:
        """Let the run write a checkpoint and end."""
        self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End the run and its worker processes at once."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)


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
