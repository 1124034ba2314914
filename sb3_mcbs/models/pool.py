"""The forward model for any environment: real copies, restored from snapshots and stepped."""

import contextlib
import logging
import uuid
from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any
from weakref import finalize

import numpy as np

from sb3_mcbs.models.copies import drop_copies, keep_root, open_copies, select_rows, set_rows, step_rows
from sb3_mcbs.models.environments import Environments
from sb3_mcbs.models.workers import WorkerError
from sb3_mcbs.types import ForwardModel, ForwardModelError, Transition, stack

logger = logging.getLogger("sb3_mcbs")


class _Root:
    """Stands for a state that is kept next to its environment, as long as this object lives."""

    def __init__(self, env_index: int, number: int, dropped: list[int]) -> None:
        self.env_index = env_index
        self.number = number
        finalize(self, dropped.append, number).atexit = False


class EnvPoolModel(ForwardModel):
    """Simulates with copies of the real environments, wrappers and all.

    Copies live where their environment lives: with a ``SubprocVecEnv`` the workers simulate, at the
    same time. A row that terminated or became invalid is not stepped further: it keeps its last
    observation and ``terminated``, and its reward is 0. So does one whose episode the environment itself
    truncated (``stopped``), but not at a ``TimeLimit``. The copies go when the pool is closed or
    collected; those of workers then stay until the next look-ahead.

    :param environments: the real environments.
    :raises SnapshotUnsupportedError: if one of them cannot be copied exactly.

    :ivar deterministic: found out by stepping copies; may be set to False by whoever knows better.
    :ivar kind: "pool".
    :ivar description: one line that says what simulates.
    """

    kind = "pool"

    def __init__(self, environments: Environments) -> None:
        self._environments = environments
        self._name = uuid.uuid4().hex
        #: Which environments have rows, and how many.
        self._counts: dict[int, int] = {}
        #: Numbers of states that are kept next to the environments and that nobody needs, by environment.
        self._dropped: list[list[int]] = [[] for _ in range(len(environments))]
        environments.when_gone(self, drop_copies, self._name)
        self.refresh()

    @property
    def n_rows(self) -> int:
        return sum(self._counts.values())

    def read_roots(self, env_indices: Sequence[int]) -> list[Any]:
        if self._is_unknown:  # the environments have been reset by now
            self.refresh()
        dropped = [self._dropped[int(i)] for i in env_indices]
        args = [(self._name, [*numbers]) for numbers in dropped]
        for numbers in dropped:
            numbers.clear()
        kept = self._environments.apply_each(env_indices, keep_root, args)
        return [
            _Root(int(i), number, self._dropped[int(i)]) for i, number in zip(env_indices, kept, strict=True)
        ]

    def set_roots(self, roots: Sequence[Any], index: np.ndarray, rng: np.random.Generator) -> None:
        per_root = np.bincount(index, minlength=len(roots)).tolist()
        args: dict[int, tuple[Any, ...]] = {}
        for env_index, group in groupby(range(len(roots)), key=lambda i: roots[i].env_index):
            if env_index in args:
                raise ValueError(f"the roots of environment {env_index} must follow each other")
            numbers = list(group)
            # Rows whose dynamics are not random need no randomness of the caller's.
            seed = 0 if self.deterministic else int(rng.integers(2**63))
            args[env_index] = ([roots[i].number for i in numbers], [per_root[i] for i in numbers], seed)
        self._each(set_rows, args)
        self._counts = {env_index: sum(counts) for env_index, (_, counts, _) in args.items()}

    def select(self, index: np.ndarray) -> None:
        args: dict[int, tuple[Any, ...]] = {}
        start = 0
        for env_index, count in self._counts.items():
            low, high = np.searchsorted(index, (start, start + count))
            args[env_index] = (index[low:high] - start,)
            start += count
        self._each(select_rows, args)
        self._counts = {env_index: len(arg[0]) for env_index, arg in args.items()}

    def step(self, actions: np.ndarray) -> Transition:
        if len(actions) != self.n_rows:
            raise ValueError(f"expected one action for each of {self.n_rows} rows, got {len(actions)}")
        parts = np.split(actions, np.cumsum(list(self._counts.values()))[:-1])
        args = {i: (part,) for i, part in zip(self._counts, parts, strict=True) if len(part)}
        results = self._each(step_rows, args)
        errors = [result[5] for result in results if result[5]]
        if errors and not self.first_error:
            self.first_error = errors[0]
            logger.warning(
                "a copy of the environment raised in a look-ahead, which makes that row invalid: %s",
                self.first_error.strip().splitlines()[-1],
            )
        observations = stack([observation for result in results for observation in result[0]])
        rewards, terminated, valid, stopped = (
            np.concatenate([result[k] for result in results]) for k in (1, 2, 3, 4)
        )
        return Transition(observations, rewards, terminated, valid, stopped if stopped.any() else None)

    def refresh(self) -> None:
        # New copies carry what the environments' simulators are now.
        self.close()
        found = self._environments.apply(range(len(self._environments)), open_copies, self._name)
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

    def _each(self, function: Callable[..., Any], args: dict[int, tuple[Any, ...]]) -> list[Any]:
        return self._environments.apply_each(
            list(args), function, [(self._name, *arg) for arg in args.values()]
        )
