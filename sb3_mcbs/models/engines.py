"""Physics for many rows of one MuJoCo model.

Both engines hold one integration state per row, in the layout of ``mjSTATE_INTEGRATION``, and give the same
numbers as stepping a separate ``MjData``.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from sb3_mcbs.snapshot.mujoco import DIVERGENCE_WARNINGS

INTEGRATION = int(mujoco.mjtState.mjSTATE_INTEGRATION)

#: ``MjData`` fields that are part of a state row. All others are computed by a step.
STATE_FIELDS = {
    "time": mujoco.mjtState.mjSTATE_TIME,
    "qpos": mujoco.mjtState.mjSTATE_QPOS,
    "qvel": mujoco.mjtState.mjSTATE_QVEL,
    "act": mujoco.mjtState.mjSTATE_ACT,
    "ctrl": mujoco.mjtState.mjSTATE_CTRL,
    "mocap_pos": mujoco.mjtState.mjSTATE_MOCAP_POS,
    "mocap_quat": mujoco.mjtState.mjSTATE_MOCAP_QUAT,
}


class Engine(ABC):
    """Rows of one model.

    :param model: copied; later edits of it are not seen.
    :param capacity: most rows that can be stepped at once.
    :param fields: the ``MjData`` fields that will be read.
    :param n_threads: simulation threads, including the caller's.

    :ivar state: ``[capacity, nstate]``, writable.
    """

    state: np.ndarray

    def __init__(self, model: mujoco.MjModel, capacity: int, fields: Sequence[str], n_threads: int) -> None:
        self.model = copy.copy(model)
        self.capacity = capacity
        template = mujoco.MjData(self.model)
        for name in fields:
            if not isinstance(getattr(template, name, None), np.ndarray):
                raise ValueError(f"{name!r} is not an array of MjData; a family's fields must be")
        self._shapes = {name: getattr(template, name).shape for name in fields}
        self._derived: dict[str, np.ndarray] = {}
        self._set_up([name for name in fields if name not in STATE_FIELDS], n_threads)

    @abstractmethod
    def _set_up(self, derived: list[str], n_threads: int) -> None:
        """Make ``state``, and ``[capacity, ...]`` arrays for the fields that a step computes."""

    def field(self, name: str) -> np.ndarray:
        """``[capacity, ...]`` view: a state field to read and write, or a field of the last step."""
        if name not in STATE_FIELDS:
            return self._derived[name]
        component = int(STATE_FIELDS[name])
        # Components lie in the order of their bits, so that all lower bits come before this one.
        below = INTEGRATION & (component - 1)
        offset = mujoco.mj_stateSize(self.model, below) if below else 0
        size = mujoco.mj_stateSize(self.model, component)
        view = self.state[:, offset : offset + size]
        return view[:, 0] if name == "time" else view.reshape(self.capacity, *self._shapes[name])

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
    """MuJoCo's own batch: all in C++, but no contact forces (``cfrc_ext``)."""

    def _set_up(self, derived: list[str], n_threads: int) -> None:
        self._batch = Batch(self.model, self.capacity, n_threads)
        self.state = self._batch.state
        self._derived = {name: self._batch.bind(name) for name in derived}
        self._ids = np.arange(self.capacity, dtype=np.int32)
        self._warning = self._batch.warning[:, DIVERGENCE_WARNINGS, 1]

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
    """Real ``MjData`` on Python threads, for fields that ``mj_step`` alone does not compute.

    After its substeps each row runs ``mj_rnePostConstraint``, as Gymnasium does. A step depends on nothing
    but the state row, so one ``MjData`` per thread serves all rows.
    """

    def _set_up(self, derived: list[str], n_threads: int) -> None:
        # It refuses models whose rows cannot share an MjData, which holds here as well.
        Batch(self.model, 1, 1)
        self.state = np.zeros((self.capacity, mujoco.mj_stateSize(self.model, INTEGRATION)))
        self._derived = {name: np.zeros((self.capacity, *self._shapes[name])) for name in derived}
        self._datas = [mujoco.MjData(self.model) for _ in range(n_threads)]
        self._sources = [[(getattr(d, name), self._derived[name]) for name in derived] for d in self._datas]
        self._diverged = np.zeros(self.capacity, dtype=bool)
        self._threads = ThreadPoolExecutor(n_threads - 1) if n_threads > 1 else None

    def step(self, rows: int, n_substeps: int) -> np.ndarray | None:
        # The threads share the iterator: each takes the next row.
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
                # The row keeps the state it had, and the data are reset for the next row.
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
