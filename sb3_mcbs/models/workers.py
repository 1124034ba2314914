"""Detects and reports worker processes of a ``SubprocVecEnv`` that ended unexpectedly."""

import contextlib
import faulthandler
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from multiprocessing import connection, util
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

from stable_baselines3.common.vec_env import SubprocVecEnv

#: Seconds to wait for a worker whose pipe broke to end, and for the others to close.
_PATIENCE = 2.0

# Folders in which the workers of a vectorized environment write their tracebacks, one file each.
_REPORTS: WeakKeyDictionary[SubprocVecEnv, tempfile.TemporaryDirectory] = WeakKeyDictionary()


class WorkerError(RuntimeError):
    """A worker process has ended. The others were stopped and the vectorized environment is closed.

    :param message: the error message.
    :param env_index: the environment whose worker ended first, as far as that is known.
    :param exit_code: of that worker; ``-n`` if signal ``n`` killed it.
    :param worker_traceback: the worker's traceback, may be empty.
    """

    def __init__(self, message: str, env_index: int, exit_code: int, worker_traceback: str) -> None:
        super().__init__(message)
        self.env_index = env_index
        self.exit_code = exit_code
        self.worker_traceback = worker_traceback

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (str(self), self.env_index, self.exit_code, self.worker_traceback)


def collect_tracebacks(vec_env: SubprocVecEnv) -> None:
    """Have workers that end write their traceback to a file that :func:`worker_error` reads.

    :param vec_env: environments that are wrapped in ``SnapshotEnvWrapper``.
    """
    if vec_env in _REPORTS:
        return
    folder = _REPORTS[vec_env] = tempfile.TemporaryDirectory(prefix="sb3_mcbs-workers-")
    for index in range(vec_env.num_envs):
        vec_env.env_method("apply", _leave_traceback, str(_report(folder, index)), indices=[index])


def await_answers(vec_env: SubprocVecEnv, env_indices: Sequence[int]) -> None:
    """Wait until forked workers have answered or one has ended.

    Forked workers hold each other's pipes open, so reading the pipe of one that has ended would block for
    ever. Other workers need no waiting.

    :param vec_env: environments whose workers were sent a command.
    :param env_indices: the indices of these environments.
    :raises EOFError: if a worker has ended.
    """
    if type(vec_env.processes[0]).__name__ != "ForkProcess":
        return
    waiting = {vec_env.remotes[i]: vec_env.processes[i].sentinel for i in env_indices}
    while waiting:
        ready = connection.wait([*waiting, *waiting.values()])
        answered = [remote for remote in waiting if remote in ready]
        if not answered:
            raise EOFError("a worker process has ended")
        for remote in answered:
            del waiting[remote]


def worker_error(vec_env: SubprocVecEnv, cause: Exception) -> WorkerError | None:
    """Find out which worker ended, stop the others and close the vectorized environment.

    :param vec_env: environments of which one did not answer.
    :param cause: what talking to the workers raised; its traceback keeps no variables of calls that ended.
    :return: the error to raise; None if all workers are alive, or were closed on purpose.
    """
    if vec_env.closed:
        return None
    processes = vec_env.processes
    ending = connection.wait([process.sentinel for process in processes], timeout=_PATIENCE)
    for process in processes:
        if process.sentinel in ending:
            process.join(_PATIENCE)
    ended = [index for index, process in enumerate(processes) if not process.is_alive()]
    if not ended:
        return None
    left = {index: _read_traceback(vec_env, index) for index in ended}
    # A worker that failed or was killed is the cause; others may have ended because their pipe was closed.
    first = max(ended, key=lambda index: (bool(left[index]), processes[index].exitcode != 0))
    exit_code, text = processes[first].exitcode, left[first]
    _shut_down(vec_env)
    # A command that could not be sent is a buffer in these frames. The garbage collector of some Pythons
    # (3.12.1 is one) crashes on a buffer in the reference cycle of an error and its traceback.
    traceback.clear_frames(cause.__traceback__)
    trace = f"Its traceback:\n{text}" if text else "It left no traceback" + _hint(exit_code)
    message = (
        f"The worker process of environment {first} {_ending(exit_code)}. The other workers were stopped and "
        f"the vectorized environment is closed: make a new one to go on. {trace}"
    )
    return WorkerError(message, first, exit_code, text)


def _report(folder: tempfile.TemporaryDirectory, index: int) -> Path:
    return Path(folder.name) / f"{index}.txt"


def _leave_traceback(wrapper: Any, path: str) -> None:
    """Prepare this worker process to write the traceback of what ends it."""
    report = open(path, "w", encoding="utf-8")  # noqa: SIM115 - stays open for as long as the worker lives
    if not faulthandler.is_enabled():
        faulthandler.enable(report)
    # Finalizers run while the exception that ends the worker is on its way out.
    util.Finalize(None, _write_traceback, args=(report,), exitpriority=0)


def _write_traceback(report: Any) -> None:
    if sys.exception() is not None:
        report.write(traceback.format_exc())
        report.flush()


def _read_traceback(vec_env: SubprocVecEnv, index: int) -> str:
    folder = _REPORTS.get(vec_env)
    if folder is None:
        return ""
    path = _report(folder, index)
    return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""


def _ending(exit_code: int) -> str:
    if exit_code >= 0:
        return f"ended with exit code {exit_code}"
    try:
        name = signal.Signals(-exit_code).name
    except ValueError:
        name = f"signal {-exit_code}"
    return f"was killed by {name} (exit code {exit_code})"


def _hint(exit_code: int) -> str:
    if exit_code == -signal.SIGKILL:
        return "; the system kills processes like this when memory runs out."
    if exit_code == 0:
        return "; workers end like this when they are interrupted (Ctrl-C)."
    return " here; what it printed may say more."


def _shut_down(vec_env: SubprocVecEnv) -> None:
    """Close the vectorized environment; its own ``close`` would wait for ever for the ended worker."""
    for remote in vec_env.remotes:
        with contextlib.suppress(OSError):
            remote.send(("close", None))
    deadline = time.monotonic() + _PATIENCE
    for process in vec_env.processes:
        process.join(max(0.0, deadline - time.monotonic()))
        if process.is_alive():
            process.terminate()
            process.join(_PATIENCE)
        if process.is_alive():
            process.kill()
            process.join()
    for remote in vec_env.remotes:
        remote.close()
    vec_env.waiting = False
    vec_env.closed = True
