"""The forward model for any environment: real copies, restored from snapshots and stepped."""

import contextlib
import logging
import uuid
from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any
from weakref import finalize

import numpy as np

from sb3_mcbs.models.copies import Copies, call_copies, drop_copies
from sb3_mcbs.models.environments import Environments
from sb3_mcbs.models.workers import WorkerError
from sb3_mcbs.types import ForwardModel, ForwardModelError, Transition, stack

logger = logging.getLogger("sb3_mcbs")


class _Root:
    """A state in the process of its environment, kept there as long as this object lives."""

    def __init__(self, env_index: int, number: int, dropped: list[int]) -> None:
        self.env_index = env_index
        self.number = number
        finalize(self, dropped.append, number).atexit = False


class EnvPoolModel(ForwardModel):
    """Simulates with copies of the real environments, wrappers and all.

    Copies live in the process of their environment: with a ``SubprocVecEnv`` the workers simulate in
    parallel. A row that terminated or became invalid is not stepped further: it keeps its last observation
    and ``terminated``, and its reward is 0. The same holds for a row whose episode the environment itself
    truncated (``stopped``), but not for a ``TimeLimit``. The copies are closed when the pool is closed or
    collected; those of workers then stay until the next look-ahead.

    :param environments: the real environments.
    :raises SnapshotUnsupportedError: if one of them cannot be copied exactly.

    :ivar deterministic: found out by stepping copies. Set it to False if that missed random dynamics.
    """

    kind = "pool"

    def __init__(self, environments: Environments) -> None:
        self._environments = environments
        self._name = uuid.uuid4().hex
        #: The number of rows of each environment that has rows.
        self._counts: dict[int, int] = {}
        #: For each environment, numbers of kept states that are not needed any longer.
        self._dropped: list[list[int]] = [[] for _ in range(len(environments))]
        environments.when_gone(self, drop_copies, self._name)
        self.refresh()

    @property
    def n_rows(self) -> int:
        return sum(self._counts.values())

    def read_roots(self, env_indices: Sequence[int]) -> list[Any]:
        if self._is_unknown:  # the environments have been reset by now
            self.refresh()
        args: dict[int, tuple[Any, ...]] = {}
        for env_index in map(int, env_indices):
            args[env_index] = ([*self._dropped[env_index]],)
            self._dropped[env_index].clear()
        kept = self._each(Copies.keep_root, args)
        return [_Root(i, number, self._dropped[i]) for i, number in zip(args, kept, strict=True)]

    def set_roots(self, roots: Sequence[Any], index: np.ndarray, rng: np.random.Generator) -> None:
        per_root = np.bincount(index, minlength=len(roots)).tolist()
        args: dict[int, tuple[Any, ...]] = {}
        for env_index, group in groupby(range(len(roots)), key=lambda i: roots[i].env_index):
            if env_index in args:
                raise ValueError(f"the roots of environment {env_index} must follow each other")
            numbers = list(group)
            # Deterministic dynamics do not advance the caller's generator.
            seed = 0 if self.deterministic else int(rng.integers(2**63))
            args[env_index] = ([roots[i].number for i in numbers], [per_root[i] for i in numbers], seed)
        self._each(Copies.set_rows, args)
        self._counts = {env_index: sum(counts) for env_index, (_, counts, _) in args.items()}

    def select(self, index: np.ndarray) -> None:
        args: dict[int, tuple[Any, ...]] = {}
        start = 0
        for env_index, count in self._counts.items():
            low, high = np.searchsorted(index, (start, start + count))
            args[env_index] = (index[low:high] - start,)
            start += count
        self._each(Copies.select, args)
        self._counts = {env_index: len(arg[0]) for env_index, arg in args.items()}

    def step(self, actions: np.ndarray) -> Transition:
        if len(actions) != self.n_rows:
            raise ValueError(f"expected one action for each of {self.n_rows} rows, got {len(actions)}")
        parts = np.split(actions, np.cumsum(list(self._counts.values()))[:-1])
        args = {i: (part,) for i, part in zip(self._counts, parts, strict=True) if len(part)}
        results = self._each(Copies.step, args)
        error = next((trace for _, trace in results if trace), "")
        if error and not self.first_error:
            self.first_error = error
            logger.warning(
                "a copy of the environment raised in a look-ahead, which makes that row invalid: %s",
                error.strip().splitlines()[-1],
            )
        observations, rewards, *marks = zip(*(row for rows, _ in results for row in rows), strict=True)
        terminated, valid, stopped = (np.array(mark, dtype=bool) for mark in marks)
        return Transition(
            stack(list(observations)),
            np.array(rewards),
            terminated,
            valid,
            stopped if stopped.any() else None,
        )

    def refresh(self) -> None:
        # New copies are made from the environments' present simulators.
        self.close()
        found = self._each(Copies.open, dict.fromkeys(range(len(self._environments)), ()))
        self._is_unknown = any(randomness is None for randomness in found)
        self.deterministic = not any(randomness is not None and randomness.any for randomness in found)
        if self._is_unknown:
            kind = "dynamics that show after the first reset"
        else:
            kind = f"{'deterministic' if self.deterministic else 'random'} dynamics"
        self.description = f"pool of environment copies ({kind})"

    def close(self) -> None:
        # Worker processes that have ended took their copies with them.
        with contextlib.suppress(ForwardModelError, WorkerError):
            self._environments.apply(range(len(self._environments)), drop_copies, self._name)
        self._counts = {}

    def _each(self, method: Callable[..., Any], args: dict[int, tuple[Any, ...]]) -> list[Any]:
        """Call a method of :class:`Copies` for some environments, with the arguments of each."""
        return self._environments.apply_each(
            list(args), call_copies, [(self._name, method, *arg) for arg in args.values()]
        )
