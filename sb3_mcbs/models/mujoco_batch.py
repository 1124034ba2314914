"""The forward model for known MuJoCo environments: physics on threads, the rest as array code."""

import math
import os
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from sb3_mcbs.models.engines import INTEGRATION, STATE_FIELDS, Engine, make_engine
from sb3_mcbs.models.environments import Environments
from sb3_mcbs.models.families import Rows, family_of
from sb3_mcbs.models.recognition import (
    CHECK_ROLLOUTS,
    CHECK_STEPS,
    KnownEnvironment,
    NotRecognizedError,
    Sample,
    read_root,
    recognize,
    sample_transitions,
)
from sb3_mcbs.models.workers import WorkerError
from sb3_mcbs.types import ForwardModel, ForwardModelError, Transition

_FIRST_CAPACITY = 32

# Engines inherited from the parent of a forked process. Freeing one would wait for threads that do not exist.
_OF_THE_PARENT: list[Engine] = []


def usable_cores() -> int:
    """How many processor cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def available_cpus() -> int:
    """How many threads may simulate: one per core, and no more than ``OMP_NUM_THREADS`` says to everybody."""
    cores = usable_cores()
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    return min(cores, int(wanted)) if wanted.isdecimal() and int(wanted) else cores


class MujocoBatchModel(ForwardModel):
    """Simulates environments of one registered family, bit for bit.

    The main process simulates, even if the environments live in workers: a root is a small array. All
    environments must be of one class, with the same arguments and the same model. The model is copied; call
    :meth:`refresh` after editing it in the environments.

    :param environments: the real environments.
    :param n_threads: simulation threads; 0 uses one per processor that this process may use, and no more
        than ``OMP_NUM_THREADS``. The results do not depend on it.
    :raises ForwardModelError: if the environments are not of a known family, or if the model and a
        copy of an environment disagree on random transitions.
    """

    deterministic = True
    kind = "mujoco"

    def __init__(self, environments: Environments, n_threads: int = 0) -> None:
        if n_threads < 0:
            raise ValueError(f"n_threads must be 0 (all processors) or more, got {n_threads}")
        self._environments = environments
        self._n_threads = n_threads or available_cpus()
        self._engine: Engine | None = None
        self._rows = 0
        self.refresh()

    @property
    def n_rows(self) -> int:
        return self._rows

    def refresh(self) -> None:
        known = self._recognize_all()
        try:
            self._prepare(known)
            self._check()
        except (ForwardModelError, WorkerError):
            raise
        except Exception as error:
            # The family's code does not fit. With "auto" the pool takes over.
            name = known.env_class.__name__
            raise NotRecognizedError(
                f"the family of {name} failed with {type(error).__name__}: {error}"
            ) from error

    def _prepare(self, known: KnownEnvironment) -> None:
        """Take over the environments' present model and constants, without rows."""
        family = family_of(known.env_class)
        assert family is not None
        self._family = family
        self._constants = known.constants
        self._fields = family.fields(known.constants)
        self._lagging = tuple(name for name in self._fields.before if name not in STATE_FIELDS)
        self._state_size = mujoco.mj_stateSize(known.constants.model, INTEGRATION)
        self._build(_FIRST_CAPACITY)
        self._any_marked = False
        self._rows = 0
        n_threads = f"{self._n_threads} thread{'s' if self._n_threads > 1 else ''}"
        engine = type(self._engine).__name__
        self.description = f"MuJoCo batch of {known.env_class.__name__} ({engine}, {n_threads})"

    def _recognize_all(self) -> KnownEnvironment:
        found = self._environments.apply(range(len(self._environments)), recognize)
        for number, result in enumerate(found):
            if isinstance(result, NotRecognizedError):
                raise NotRecognizedError(f"environment {number}: {result}", result.notable)
        first: KnownEnvironment = found[0]
        for number, other in enumerate(found[1:], start=1):
            difference = first.difference(other)
            if difference:
                raise NotRecognizedError(f"environments 0 and {number} differ in their {difference}")
        return first

    def _build(self, capacity: int) -> None:
        """Make an engine with room for ``capacity`` rows, all empty."""
        names = tuple(dict.fromkeys(("ctrl", *self._fields.before, *self._fields.after)))
        self.close()
        try:
            self._engine = make_engine(self._constants.model, capacity, names, self._n_threads)
        except ValueError as error:
            raise ForwardModelError(f"the batch cannot simulate this model: {error}") from error
        self._constants.model = self._engine.model
        self._process = os.getpid()
        self._capacity = capacity
        self._arrays = {name: self._engine.field(name) for name in names}
        self._before = {
            name: np.zeros(self._arrays[name].shape, dtype=self._arrays[name].dtype)
            for name in self._fields.before
        }
        self._diverged = np.zeros(capacity, dtype=bool)
        self._ended = np.zeros(capacity, dtype=bool)
        self._views: dict[int, tuple[Rows, Rows, np.ndarray]] = {}

    def _memory(self) -> list[np.ndarray]:
        """The complete state of the rows as ``[capacity, ...]`` arrays, without their marks."""
        assert self._engine is not None
        return [self._engine.state, *(self._before[name] for name in self._lagging)]

    def _fill(self, values: Sequence[np.ndarray], rows: int) -> None:
        """Set the state of the first rows, in a larger engine if this one is too small."""
        if rows > self._capacity:
            self._build(max(rows, 2 * self._capacity))
        for memory, value in zip(self._memory(), values, strict=True):
            memory[:rows] = value
        self._rows = rows

    def read_roots(self, env_indices: Sequence[int]) -> list[Any]:
        return self._environments.apply(env_indices, read_root, self._state_size, self._lagging)

    def set_roots(self, roots: Sequence[Any], index: np.ndarray, rng: np.random.Generator) -> None:
        table = np.stack(roots)[index]
        if self._process != os.getpid():
            self._build(self._capacity)  # threads do not survive a fork
        if table.shape[1] != self._state_size + sum(self._before[name][0].size for name in self._lagging):
            raise ValueError("these roots were read by another model")
        rows = len(table)
        values, start = [table[:, : self._state_size]], self._state_size
        for name in self._lagging:
            shape = self._before[name].shape[1:]
            size = int(np.prod(shape))
            values.append(table[:, start : start + size].reshape(rows, *shape))
            start += size
        self._fill(values, rows)
        self._diverged[...] = self._ended[...] = self._any_marked = False

    def select(self, index: np.ndarray) -> None:
        values = [memory[: self._rows].take(index, axis=0) for memory in self._memory()]
        diverged, ended = self._diverged[: self._rows], self._ended[: self._rows]
        self._fill(values, len(index))
        if self._any_marked:
            self._diverged[: len(index)] = diverged[index]
            self._ended[: len(index)] = ended[index]

    def _view(self, rows: int) -> tuple[Rows, Rows, np.ndarray]:
        """The fields of the first rows, before and after a step, and their controls."""
        view = self._views.get(rows)
        if view is None:
            before = Rows(**{name: self._before[name][:rows] for name in self._fields.before})
            after = Rows(**{name: self._arrays[name][:rows] for name in self._fields.after})
            view = self._views[rows] = (before, after, self._arrays["ctrl"][:rows])
        return view

    def step(self, actions: np.ndarray) -> Transition:
        assert self._engine is not None
        rows = self._rows
        before, after, controls = self._view(rows)
        if actions.shape != controls.shape:
            raise ValueError(
                f"expected actions of shape {controls.shape} [rows, act_dim], got {actions.shape}"
            )
        actions = np.ascontiguousarray(actions)
        for name in self._fields.before:
            if name not in self._lagging:
                self._before[name][:rows] = self._arrays[name][:rows]
        controls[...] = actions
        diverged = self._engine.step(rows, self._constants.frame_skip)
        observations, rewards, terminated = self._family.transition(self._constants, before, after, actions)
        for name in self._lagging:
            self._before[name][:rows] = self._arrays[name][:rows]
        return Transition(
            observations, rewards, terminated, self._mark(diverged, observations, rewards, terminated)
        )

    def _mark(
        self,
        diverged: np.ndarray | None,
        observations: np.ndarray,
        rewards: np.ndarray,
        terminated: np.ndarray,
    ) -> np.ndarray:
        """Remember which rows are invalid and which have terminated.

        :return: ``[rows]`` bool, which rows are valid.
        """
        rows = len(rewards)
        # A sum is finite only if all its terms are; only otherwise is each of them checked.
        if not math.isfinite(observations.sum() + rewards.sum()):
            broken = ~(np.isfinite(observations).reshape(rows, -1).all(axis=1) & np.isfinite(rewards))
            diverged = broken if diverged is None else diverged | broken
        if diverged is None and not self._any_marked and not terminated.any():
            return np.ones(rows, dtype=bool)
        self._any_marked = True
        if diverged is not None:
            # A row cannot become invalid after it has terminated.
            self._diverged[:rows] |= diverged & ~self._ended[:rows]
        self._ended[:rows] |= terminated
        return ~self._diverged[:rows]

    def _check(self) -> None:
        """Compare with copies of the real environments on random transitions.

        :raises NotRecognizedError: at the first difference.
        """
        arguments = (self._state_size, self._lagging)
        sample: Sample = self._environments.apply([0], sample_transitions, *arguments)[0]
        rng = np.random.default_rng(0)
        # All transitions as one batch, then whole rollouts, which also check what a row carries from step
        # to step.
        flat = Sample(*(array.reshape(-1, 1, *array.shape[2:]) for array in sample))
        for part in (flat, sample):
            self.set_roots(list(part.roots[:, 0]), np.arange(len(part.roots)), rng)
            for step in range(part.roots.shape[1]):
                self._compare(self.step(part.actions[:, step]), part, step)
        self._rows = 0

    def _compare(self, simulated: Transition, real: Sample, step: int) -> None:
        expected = (real.observations[:, step], real.rewards[:, step], real.terminated[:, step])
        found: Sequence[Any] = simulated[:3]
        for name, ours, theirs in zip(("observation", "reward", "terminated"), found, expected, strict=True):
            if ours.dtype != theirs.dtype or ours.shape != theirs.shape:
                kinds = f"{theirs.dtype} {theirs.shape[1:]}, the model's {ours.dtype} {ours.shape[1:]}"
                raise NotRecognizedError(f"the check failed: the environment's {name} is {kinds}")
            if ours.tobytes() != theirs.tobytes():
                gap = np.abs(np.subtract(ours, theirs, dtype=np.float64)).max()
                raise NotRecognizedError(
                    f"the check failed: on {CHECK_ROLLOUTS * CHECK_STEPS} random transitions the {name} "
                    f"of the model and of the environment differ by up to {gap:.3g}"
                )

    def close(self) -> None:
        if self._engine is None:
            return
        if self._process == os.getpid():
            self._engine.close()
        else:
            _OF_THE_PARENT.append(self._engine)
