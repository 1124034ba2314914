"""Copies of one environment, stepped as the rows of a pool, in the process where the environment lives."""

import traceback
import weakref
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_mcbs.models.probing import Randomness, probe_randomness
from sb3_mcbs.snapshot import (
    SIMULATION_DIVERGED,
    Snapshot,
    SnapshotEnvWrapper,
    SnapshotMismatchError,
)
from sb3_mcbs.snapshot.generators import isolated_globals
from sb3_mcbs.types import ForwardModelError, map_arrays


def _blank(space: spaces.Space) -> Any:
    """An observation for a row whose first step fails."""
    if isinstance(space, spaces.Dict):
        return {key: _blank(inner) for key, inner in space.spaces.items()}
    return np.zeros(space.shape or (), dtype=space.dtype)


def _is_finite(observation: Any) -> bool:
    values = observation.values() if isinstance(observation, dict) else (observation,)
    return all(bool(np.isfinite(v).all()) for v in values if np.issubdtype(v.dtype, np.inexact))


def _is_at_time_limit(layer: Any) -> bool:
    """Whether a ``TimeLimit``, Gymnasium's or RL Zoo's, has ended the episode."""
    while isinstance(layer, gym.Wrapper):
        elapsed, limit = (getattr(layer, name, None) for name in ("_elapsed_steps", "_max_episode_steps"))
        if elapsed is not None and limit is not None and elapsed >= limit:
            return True
        layer = layer.env
    return False


class RowStep(NamedTuple):
    """The last step of a row.

    :param valid: whether neither the simulation diverged nor the environment raised.
    :param stopped: whether the environment itself truncated the episode.
    """

    observation: Any
    reward: float
    terminated: bool
    valid: bool
    stopped: bool

    @property
    def ended(self) -> bool:
        """Whether the row is not stepped further."""
        return self.terminated or self.stopped or not self.valid


class _Row:
    """One copy, and its last step."""

    def __init__(self, env: SnapshotEnvWrapper) -> None:
        self.env = env
        self.last = RowStep(_blank(env.observation_space), 0.0, False, True, False)

    def start(self, snapshot: Snapshot, rng: np.random.Generator) -> None:
        """Restore a snapshot, with the environment's generators seeded from ``rng``."""
        self.env.restore(snapshot, rng=rng)
        self.last = RowStep(self.last.observation, 0.0, False, True, False)

    def step(self, action: np.ndarray) -> Exception | None:
        """Step the copy once, unless it has ended.

        :param action: for this row; copied, since an environment may keep it.
        :return: the exception that the environment raised, if any.
        """
        if self.last.ended:
            self.last = self.last._replace(reward=0.0)
            return None
        try:
            observation, reward, terminated, truncated, info = self.env.step(action.copy())
        except Exception as error:
            self.last = self.last._replace(reward=0.0, valid=False)
            return error
        observation, reward = map_arrays(np.array, observation), float(reward)
        valid = _is_finite(observation) and bool(np.isfinite(reward)) and SIMULATION_DIVERGED not in info
        # A time limit does not end a simulation. An environment that ends an episode itself may not go on.
        stopped = bool(truncated) and valid and not _is_at_time_limit(self.env)
        self.last = RowStep(observation, reward, bool(terminated), valid, stopped)
        return None


class Copies:
    """The rows of one environment, and the states they may start from.

    :param wrapper: the environment; not kept alive.
    """

    def __init__(self, wrapper: SnapshotEnvWrapper) -> None:
        self._wrapper = weakref.proxy(wrapper)
        #: Whether the environment draws from the global generators.
        self.isolate = False
        #: Snapshots by number. They are large, so they stay in this process.
        self.roots: dict[int, Snapshot] = {}
        self._n_roots = 0
        self.rows: list[_Row] = []
        self._spare: list[_Row] = []
        self._rng = np.random.default_rng(0)

    def open(self) -> Randomness | None:
        """Find out whether the environment can be copied, and which random numbers its steps use.

        :return: ``None`` if that is unknown before its first reset.
        :raises SnapshotUnsupportedError: if it cannot be copied exactly.
        """
        randomness = probe_randomness(self._wrapper)
        self.isolate = randomness is not None and randomness.shared
        return randomness

    def keep_root(self, dropped: list[int]) -> int:
        """Keep the environment's present state.

        :param dropped: numbers of kept states that are not needed any longer.
        :return: the number of the state.
        """
        for number in dropped:
            self.roots.pop(number, None)
        self._n_roots += 1
        self.roots[self._n_roots] = self._wrapper.snapshot(monitor=False)
        return self._n_roots

    def set_rows(self, roots: list[int], counts: list[int], seed: int) -> None:
        """Make ``counts[i]`` rows that start at the state with the number ``roots[i]``."""
        if any(number not in self.roots for number in roots):
            raise ForwardModelError("the roots are from before the model was refreshed: read them again")
        snapshots = [self.roots[number] for number in roots]
        try:
            self._start_rows(snapshots, counts, seed)
        except SnapshotMismatchError:
            # The environment has exchanged its simulator since it was copied.
            self._close_rows()
            self._start_rows(snapshots, counts, seed)

    def _start_rows(self, snapshots: list[Snapshot], counts: list[int], seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._spare += self.rows
        self.rows = []
        for snapshot, count in zip(snapshots, counts, strict=True):
            for _ in range(count):
                row = self._take()
                self.rows.append(row)
                row.start(snapshot, self._rng)

    def _take(self) -> _Row:
        return self._spare.pop() if self._spare else _Row(self._wrapper.clone())

    def select(self, index: np.ndarray) -> None:
        """Make row i what row ``index[i]`` was."""
        named = set(index.tolist())
        self._spare += [row for number, row in enumerate(self.rows) if number not in named]
        chosen: list[_Row] = []
        first: dict[int, _Row] = {}
        snapshots: dict[int, Snapshot] = {}
        for number in index.tolist():
            if number not in first:
                row = first[number] = self.rows[number]
            else:
                source = first[number]
                row = self._take()
                if not source.last.ended:
                    if number not in snapshots:
                        snapshots[number] = source.env.snapshot()
                    row.env.restore(snapshots[number], rng=self._rng)
                row.last = source.last
            chosen.append(row)
        self.rows = chosen

    def step(self, actions: np.ndarray) -> tuple[list[RowStep], str]:
        """Step every row.

        :param actions: ``[rows, *act_shape]``.
        :return: the step of every row, and the traceback of the first error that an environment raised.
        """
        isolation = isolated_globals(int(self._rng.integers(2**32))) if self.isolate else nullcontext()
        with isolation:
            errors = [row.step(action) for row, action in zip(self.rows, actions, strict=True)]
        first = next((error for error in errors if error is not None), None)
        trace = "" if first is None else "".join(traceback.format_exception(first))
        return [row.last for row in self.rows], trace

    def _close_rows(self) -> None:
        for row in (*self.rows, *self._spare):
            row.env.close()
        self.rows, self._spare = [], []

    def close(self) -> None:
        """Close every copy, and forget all states."""
        self._close_rows()
        self.roots.clear()


# The copies of an environment by the pool's name. In a worker process nothing else could hold them.
_COPIES: WeakKeyDictionary[SnapshotEnvWrapper, dict[str, Copies]] = WeakKeyDictionary()


def copies_of(wrapper: SnapshotEnvWrapper, pool: str) -> Copies:
    """The copies that a pool keeps of an environment; none yet at first."""
    return _COPIES.setdefault(wrapper, {}).setdefault(pool, Copies(wrapper))


def call_copies(wrapper: SnapshotEnvWrapper, pool: str, method: Callable[..., Any], *args: Any) -> Any:
    """Call a method of the copies that a pool keeps of an environment."""
    return method(copies_of(wrapper, pool), *args)


def drop_copies(wrapper: SnapshotEnvWrapper, pool: str) -> None:
    """Close the copies that a pool keeps of an environment, if it has any."""
    copies = _COPIES.get(wrapper, {}).pop(pool, None)
    if copies is not None:
        copies.close()
