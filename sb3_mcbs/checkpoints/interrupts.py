"""Ctrl-C and SIGTERM while training: finish the step, save, then stop."""

import os
import signal
import threading
import weakref
from types import FrameType
from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_mcbs.snapshot import SnapshotEnvWrapper

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class TrainingInterrupted(SystemExit):
    """Training was stopped by a signal, after a checkpoint was written.

    Not caught, it ends the process with the exit status that shells give for the signal: 130 after Ctrl-C,
    143 after SIGTERM.

    :param signum: the signal.
    """

    def __init__(self, signum: int) -> None:
        super().__init__(128 + signum)
        self.signum = signum


class Interrupts:
    """Notes a signal instead of ending at once. A second one ends at once.

    Worker processes ignore both signals meanwhile: Ctrl-C reaches the whole process group, and a checkpoint
    needs them. They end when this process does.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._agent: OffPolicyAlgorithm | None = None
        self._previous: dict[int, Any] = {}
        self._workers: list[SubprocVecEnv] = []

    def begin(self, agent: OffPolicyAlgorithm, workers: list[SubprocVecEnv]) -> None:
        """Take over the signals, in the main thread; elsewhere Python allows no handlers.

        :param agent: that learns.
        :param workers: environments in worker processes.
        """
        self.received, self._agent = None, agent
        self._give_back()  # not done yet if the last training ended in an error
        if threading.current_thread() is not threading.main_thread():
            return
        for signum in _SIGNALS:
            self._previous[signum] = signal.signal(signum, self._note)
        self._workers = workers
        for vec_env in workers:
            vec_env.env_method("apply", _ignore_signals)
            # Python ends daemonic processes by SIGTERM when it exits, and would wait for these forever.
            weakref.finalize(vec_env, _kill, list(vec_env.processes))

    def end(self) -> None:
        """Give the signals back."""
        self._give_back()
        for vec_env in self._workers:
            if not vec_env.closed:
                vec_env.env_method("apply", _heed_signals)
        self._workers = []

    def _give_back(self) -> None:
        for signum, handler in self._previous.items():
            signal.signal(signum, handler)
        self._previous = {}

    def _note(self, signum: int, frame: FrameType | None) -> None:
        self._give_back()
        if not _is_learning(self._agent, frame):
            os.kill(os.getpid(), signum)
            return
        self.received = signum
        print(
            f"{signal.Signals(signum).name}: a checkpoint is written after the present step, then training "
            "stops. Once more to stop at once.",
            flush=True,
        )


def _is_learning(agent: OffPolicyAlgorithm | None, frame: FrameType | None) -> bool:
    """Whether somebody will look at the note: no callback is told of a ``learn`` that an error has ended."""
    while frame is not None:
        if frame.f_code.co_name == "learn" and frame.f_locals.get("self") is agent:
            return True
        frame = frame.f_back
    return False


def _ignore_signals(wrapper: SnapshotEnvWrapper) -> None:
    for signum in _SIGNALS:
        signal.signal(signum, signal.SIG_IGN)


def _heed_signals(wrapper: SnapshotEnvWrapper) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _kill(processes: list[Any]) -> None:
    for process in processes:
        if process.is_alive():
            process.kill()
