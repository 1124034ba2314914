"""Temporary changes of torch settings that hold for the whole process."""

import ctypes
import functools
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch as th

logger = logging.getLogger("sb3_mcbs")

#: omp_pause_soft of the OpenMP 5.0 standard: free the threads, keep the settings.
_OMP_PAUSE_SOFT = 1
_PROCESS = os.getpid()


def go_on_in_process(process: int) -> int:
    """Have torch compute on one thread in a process that was forked after torch had started threads.

    The threads do not survive the fork, and waiting for them would never end.

    :param process: the id of the process in which the caller was made.
    :return: the id of this process.
    """
    here = os.getpid()
    if process != here and th.get_num_threads() > 1:
        th.set_num_threads(1)
        logger.warning(
            "this agent was made before the process was forked, and torch's threads do not survive a fork: "
            "torch computes on one thread here. Processes that are spawned have threads of their own "
            "(multiprocessing's start method 'spawn' or 'forkserver')."
        )
    return here


@contextmanager
def one_thread() -> Iterator[None]:
    """Have torch compute on one thread, and leave the processor's cores to the simulation.

    After work on several threads, torch's idle OpenMP threads spin for milliseconds on the cores that the
    simulation needs, so they are released; torch starts them again when it needs them.
    """
    n_threads = th.get_num_threads()
    if n_threads == 1:
        yield
        return
    if os.getpid() == _PROCESS:  # after a fork there are no such threads, and waiting for them never ends
        _openmp_pause()(_OMP_PAUSE_SOFT)
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(n_threads)


@functools.cache
def _openmp_pause() -> Callable[[int], int]:
    """``omp_pause_resource_all`` of the OpenMP library that torch uses; does nothing if there is none."""
    try:
        return ctypes.CDLL(th._C.__file__).omp_pause_resource_all
    except (AttributeError, OSError):  # built without OpenMP, or with one older than 5.0
        return lambda kind: 0


@contextmanager
def matmul_precision(precision: str | None) -> Iterator[None]:
    """Compute float32 matrix products with another internal precision.

    :param precision: as for ``torch.set_float32_matmul_precision``; ``None`` changes nothing.
    """
    if precision is None:
        yield
        return
    before = th.get_float32_matmul_precision()
    th.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        th.set_float32_matmul_precision(before)
