"""Physics for many rows of one MuJoCo model.

Both engines hold one integration state per row, in the layout of ``mjSTATE_INTEGRATION``, and give
the same numbers as stepping an ``MjData`` of one's own.
"""

import copy
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from sb3_mcbs.snapshot.mujoco import DIVERGENCE_WARNINGS

INTEGRATION = int(mujoco.mjtState.mjSTATE_INTEGRATION)

#: State components that a transition can read, and where they lie in a state row.
_STATE_FIELDS = {
    "time": mujoco.mjtState.mjSTATE_TIME,
    "qpos": mujoco.mjtState.mjSTATE_QPOS,
    "qvel": mujoco.mjtState.mjSTATE_QVEL,
    "act": mujoco.mjtState.mjSTATE_ACT,
    "ctrl": mujoco.mjtState.mjSTATE_CTRL,
    "mocap_pos": mujoco.mjtState.mjSTATE_MOCAP_POS,
    "mocap_quat": mujoco.mjtState.mjSTATE_MOCAP_QUAT,
}


def available_cpus() -> int:
    """How many processors this process may use: no more than ``OMP_NUM_THREADS`` says to everybody else."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    return min(cores, int(wanted)) if wanted.isdecimal() and int(wanted) else cores


def is_state_field(name: str) -> bool:
    """Whether an ``MjData`` field is part of the state rows."""
    return name in _STATE_FIELDS


class Engine(ABC):
    """Rows of one model.

    :param model: copied; later edits of it are not seen.
    :param capacity: most rows that can be stepped at once.
    :param fields: the ``MjData`` fields that will be read.

    :ivar state: ``[capacity, nstate]``, writable.
    """

    state: np.ndarray

    def __init__(self, model: mujoco.MjModel, capacity: int, fields: Sequence[str]) -> None:
        self.model = copy.copy(model)
        self.capacity = capacity
        template = mujoco.MjData(self.model)
        for name in fields:
            if not isinstance(getattr(template, name, None), np.ndarray):
                raise ValueError(f"{name!r} is not an array of MjData; a family's fields must be")
        self._shapes = {name: getattr(template, name).shape for name in fields}

    def field(self, name: str) -> np.ndarray:
        """``[capacity, ...]``, live: a state field to read and write, or the outcome of the last step."""
        if not is_state_field(name):
            return self._derived_field(name)
        component = _STATE_FIELDS[name]
        # Components lie in the order of their bits, so that all lower bits come before this one.
        below = INTEGRATION & (int(component) - 1)
        offset = mujoco.mj_stateSize(self.model, below) if below else 0
        size = mujoco.mj_stateSize(self.model, int(component))
        view = self.state[:, offset : offset + size]
        return view[:, 0] if name == "time" else view.reshape(self.capacity, *self._shapes[name])

    @abstractmethod
    def _derived_field(self, name: str) -> np.ndarray:
        """``[capacity, ...]`` of a field that a step computes."""

    @abstractmethod
    def step(self, rows: int, n_substeps: int) -> np.ndarray | None:
        """Step the first rows.

        :param rows: how many.
        :param n_substeps: MuJoCo steps.
        :return: ``[rows]`` bool, True where the simulation diverged; ``None`` if none did.
        """

    def close(self) -> None:  # noqa: B027
        """Release the threads."""


class BatchEngine(Engine):
    """MuJoCo's own batch: all in C++, but no contact forces (``cfrc_ext``).

    :param model: copied; later edits of it are not seen.
    :param capacity: most rows that can be stepped at once.
    :param fields: the ``MjData`` fields that will be read.
    :param n_threads: simulation threads, the caller's included.
    """

    def __init__(self, model: mujoco.MjModel, capacity: int, fields: Sequence[str], n_threads: int) -> None:
        super().__init__(model, capacity, fields)
        self._batch = Batch(self.model, capacity, n_threads)
        self.state = self._batch.state
        self._derived = {name: self._batch.bind(name) for name in fields if not is_state_field(name)}
        self._ids = np.arange(capacity, dtype=np.int32)
        self._warning = self._batch.warning[:, DIVERGENCE_WARNINGS, 1]

    def _derived_field(self, name: str) -> np.ndarray:
        return self._derived[name]

    def step(self, rows: int, n_substeps: int) -> np.ndarray | None:
        warning = self._warning[:rows]
        failed = None
        try:
            self._batch.step(self._ids[:rows], n_substeps)
        except SimulationError as error:
            failed = error.ids
        if failed is None and not warning.any():
            return None
        diverged: np.ndarray = warning.any(axis=1)
        if failed is not None:
            diverged[failed] = True
        warning[...] = 0
        return diverged


class ThreadEngine(Engine):
    """Real ``MjData`` on Python threads, for what ``mj_step`` alone does not compute.

    After its substeps each row runs ``mj_rnePostConstraint``, as Gymnasium does. One ``MjData`` per
    thread serves all rows: the state row is all that a step depends on.

    :param model: copied; later edits of it are not seen.
    :param capacity: most rows that can be stepped at once.
    :param fields: the ``MjData`` fields that will be read.
    :param n_threads: simulation threads, the caller's included.
    """

    def __init__(self, model: mujoco.MjModel, capacity: int, fields: Sequence[str], n_threads: int) -> None:
        super().__init__(model, capacity, fields)
        # It refuses models whose rows cannot share an MjData, which holds here as well.
        Batch(self.model, 1, 1)
        self.state = np.zeros((capacity, mujoco.mj_stateSize(self.model, INTEGRATION)))
        derived = [name for name in fields if not is_state_field(name)]
        self._derived = {name: np.zeros((capacity, *self._shapes[name])) for name in derived}
        self._datas = [mujoco.MjData(self.model) for _ in range(n_threads)]
        self._sources = [[(getattr(d, name), self._derived[name]) for name in derived] for d in self._datas]
        self._diverged = np.zeros(capacity, dtype=bool)
        self._threads = ThreadPoolExecutor(n_threads - 1) if n_threads > 1 else None

    def _derived_field(self, name: str) -> np.ndarray:
        return self._derived[name]

    def step(self, rows: int, n_substeps: int) -> np.ndarray | None:
        # The iterator is what the threads share: each takes the next row that nobody has.
        todo = iter(range(rows))
        helpers = []
        if self._threads is not None:
            for thread in range(1, min(len(self._datas), rows)):
                helpers.append(self._threads.submit(self._work, thread, todo, n_substeps))
        self._work(0, todo, n_substeps)
        for helper in helpers:
            helper.result()
        diverged = self._diverged[:rows]
        return diverged.copy() if diverged.any() else None

    def _work(self, thread: int, todo: Iterator[int], n_substeps: int) -> None:
        model, data, sources = self.model, self._datas[thread], self._sources[thread]
        number = data.warning.number
        for row in todo:
            state = self.state[row]
            mujoco.mj_setState(model, data, state, INTEGRATION)
            number[:] = 0
            try:
                mujoco.mj_step(model, data, n_substeps)
                mujoco.mj_rnePostConstraint(model, data)
            except mujoco.FatalError:
                # The row keeps the state it had; what the data hold now is of no use to the next row.
                mujoco.mj_resetData(model, data)
                self._diverged[row] = True
                continue
            mujoco.mj_getState(model, data, state, INTEGRATION)
            for source, target in sources:
                target[row] = source
            self._diverged[row] = number[DIVERGENCE_WARNINGS].any()

    def close(self) -> None:
        if self._threads is not None:
            self._threads.shutdown()


def make_engine(model: mujoco.MjModel, capacity: int, fields: Sequence[str], n_threads: int) -> Engine:
    """The fastest engine that gives these fields exactly."""
    post_constraint = {"cacc", "cfrc_int", "cfrc_ext"}
    engine = ThreadEngine if post_constraint.intersection(fields) else BatchEngine
    return engine(model, capacity, fields, n_threads)
