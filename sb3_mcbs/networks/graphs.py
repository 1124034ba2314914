"""Gradient steps that are captured once and replayed: CUDA graphs.

A step of small networks is some hundred kernels of a few microseconds, and starting each from Python takes
longer than running it. A graph starts all of them at once. It contains addresses and constants, not Python:
whatever a step reads must lie where it was when it was captured, and whatever Python decides is decided once.
"""

import logging
from collections import Counter
from collections.abc import Callable, Hashable
from typing import Any, Protocol

import torch as th

logger = logging.getLogger("sb3_mcbs")

#: Eager calls before a step is captured: libraries allocate and choose algorithms in the first ones.
WARM_UP = 3


class Backend(Protocol):
    """Runs and captures work on a device."""

    def warm_up(self, step: Callable[[], Any]) -> None:
        """Run a step, as a preparation for capturing it."""

    def capture(self, step: Callable[[], Any]) -> Callable[[], Any]:
        """Capture a step without running it.

        :return: replays it.
        """


class CudaBackend:
    """Captures work on the current GPU."""

    def warm_up(self, step: Callable[[], Any]) -> None:
        """Run a step on a side stream, as a capture does."""
        stream, current = th.cuda.Stream(), th.cuda.current_stream()
        stream.wait_stream(current)
        with th.cuda.stream(stream):
            step()
        current.wait_stream(stream)

    def capture(self, step: Callable[[], Any]) -> Callable[[], Any]:
        """Capture a step. Torch registers its default generator, so every replay draws new noise."""
        graph = th.cuda.CUDAGraph()
        with th.cuda.graph(graph):
            step()
        return graph.replay


#: By type of device. There are graphs where there is a backend.
BACKENDS: dict[str, Backend] = {"cuda": CudaBackend()}


class Graphs:
    """The captured steps of an agent, which are valid while all that they contain stays the same."""

    def __init__(self) -> None:
        self._key: Any = None
        self._kept: list[Any] = []
        self._warm: Counter[Hashable] = Counter()
        self._replays: dict[Hashable, Callable[[], Any]] = {}
        self._failed = False

    @property
    def n_captured(self) -> int:
        """Number of captured steps."""
        return len(self._replays)

    def follow(self, key: Any, kept: Any) -> None:
        """Drop the captured steps if they would no longer do what the present step does.

        :param key: compared with the one before: addresses and constants in the steps.
        :param kept: kept alive with the captured steps, since these use addresses in it.
        """
        if key == self._key:
            return
        if self._replays and th.cuda.is_initialized():
            th.cuda.synchronize()  # the last replay may still use what is freed now
        self._key, self._kept = key, [kept]
        self._warm.clear()
        self._replays.clear()

    def run(self, kind: Hashable, step: Callable[[], Any], device: th.device) -> None:
        """Run a step: as it is at first, then by a replay.

        :param kind: what Python decides in the step; every kind is captured by itself.
        :param step: the step. What it returns is kept with the captured step.
        :param device: where it runs.
        """
        backend = BACKENDS[device.type]
        replay = self._replays.get(kind)
        if replay is None and (self._failed or self._warm[kind] < WARM_UP):
            self._warm[kind] += 1
            backend.warm_up(step)
            return
        if replay is None:
            replay = self._capture(kind, step, backend)
        replay()

    def _capture(self, kind: Hashable, step: Callable[[], Any], backend: Backend) -> Callable[[], Any]:
        try:
            self._replays[kind] = backend.capture(lambda: self._kept.append(step()))
            return self._replays[kind]
        except RuntimeError as error:  # out of memory, or an operation that this torch cannot capture
            self._failed = True
            logger.warning("A CUDA graph could not be captured; gradient steps go on without: %s", error)
            return step
