"""Real copies of one environment, stepped as the rows of a pool.

The functions at the end run where the environment lives, and find its copies by the pool's name.
"""

import traceback
from contextlib import nullcontext
from typing import Any
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
from sb3_mcbs.types import ForwardModelError


def _copied(observation: Any) -> Any:
    if isinstance(observation, dict):
        return {key: np.array(value) for key, value in observation.items()}
    return np.array(observation)


def _blank(space: spaces.Space) -> Any:
    """An observation for a row that never gave one."""
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


class _Row:
    """One copy, and what its last step gave.

    :ivar ended: no further steps: the episode ended, or the simulation is of no use.
    :ivar stopped: the environment itself truncated the episode.
    """

    def __init__(self, env: SnapshotEnvWrapper) -> None:
        self.env = env
        self.observation = _blank(env.observation_space)
        self.reward = 0.0
        self.ended = self.terminated = self.stopped = False
        self.valid = True

    def start(self, snapshot: Snapshot, rng: np.random.Generator) -> None:
        """Restore a snapshot, with random generators of the look-ahead's own."""
        self.env.restore(snapshot, rng=rng)
        self.ended = self.terminated = self.stopped = False
        self.valid = True

    def become(self, other: "_Row", snapshot: Snapshot | None, rng: np.random.Generator) -> None:
        """Take over another row's state, with random generators of its own.

        :param other: the row.
        :param snapshot: of its copy; None if it has ended.
        :param rng: where the generators come from.
        """
        if snapshot is not None:
            self.env.restore(snapshot, rng=rng)
        self.observation, self.reward = other.observation, other.reward
        self.ended, self.terminated, self.valid = other.ended, other.terminated, other.valid
        self.stopped = other.stopped

    def step(self, action: np.ndarray) -> Exception | None:
        """Step the copy once, unless it has ended.

        :param action: for this row; copied, since an environment may keep it.
        :return: what the environment raised.
        """
        self.reward = 0.0
        if self.ended:
            return None
        try:
            observation, reward, terminated, truncated, info = self.env.step(action.copy())
        except Exception as error:
            self.ended, self.valid = True, False
            return error
        self.observation, self.reward, self.terminated = _copied(observation), float(reward), bool(terminated)
        finite = _is_finite(self.observation) and bool(np.isfinite(self.reward))
        self.valid = finite and SIMULATION_DIVERGED not in info
        # A time limit does not end a simulation. An environment that ends an episode itself may not go on.
        self.stopped = bool(truncated) and self.valid and not _is_at_time_limit(self.env)
        self.ended = self.terminated or self.stopped or not self.valid
        return None


class Copies:
    """The rows of one environment, and the states that they may start from."""

    def __init__(self) -> None:
        #: Whether the environment draws from the global generators.
        self.isolate = False
        #: By number. Snapshots are large, and stay where the environment lives.
        self.roots: dict[int, Snapshot] = {}
        self._n_roots = 0
        self.rows: list[_Row] = []
        self._spare: list[_Row] = []
        self._rng = np.random.default_rng(0)

    def _take(self, wrapper: SnapshotEnvWrapper) -> _Row:
        return self._spare.pop() if self._spare else _Row(wrapper.clone())

    def keep_root(self, wrapper: SnapshotEnvWrapper, dropped: list[int]) -> int:
        """Keep the environment's present state.

        :param dropped: the numbers of those that nobody needs any longer.
        :return: its number.
        """
        for number in dropped:
            self.roots.pop(number, None)
        self._n_roots += 1
        self.roots[self._n_roots] = wrapper.snapshot(monitor=False)
        return self._n_roots

    def set_rows(self, wrapper: SnapshotEnvWrapper, roots: list[int], counts: list[int], seed: int) -> None:
        """Make ``counts[i]`` rows that start at the state with the number ``roots[i]``."""
        missing = [number for number in roots if number not in self.roots]
        if missing:
            raise ForwardModelError("the roots are from before the model was refreshed: read them again")
        snapshots = [self.roots[number] for number in roots]
        try:
            self._start_rows(wrapper, snapshots, counts, seed)
        except SnapshotMismatchError:
            # The environment has exchanged its simulator since it was copied.
            self._close_rows()
            self._start_rows(wrapper, snapshots, counts, seed)

    def _start_rows(
        self, wrapper: SnapshotEnvWrapper, snapshots: list[Snapshot], counts: list[int], seed: int
    ) -> None:
        self._rng = np.random.default_rng(seed)
        self._spare += self.rows
        self.rows = []
        for snapshot, count in zip(snapshots, counts, strict=True):
            for _ in range(count):
                row = self._take(wrapper)
                self.rows.append(row)
                row.start(snapshot, self._rng)

    def select(self, wrapper: SnapshotEnvWrapper, index: np.ndarray) -> None:
        """Make row i what row ``index[i]`` was."""
        named = set(index.tolist())
        self._spare += [row for number, row in enumerate(self.rows) if number not in named]
        chosen: list[_Row] = []
        first: dict[int, _Row] = {}
        snapshots: dict[int, Snapshot | None] = {}
        for number in index.tolist():
            if number not in first:
                row = first[number] = self.rows[number]
            else:
                source = first[number]
                if number not in snapshots:
                    snapshots[number] = None if source.ended else source.env.snapshot()
                row = self._take(wrapper)
                row.become(source, snapshots[number], self._rng)
            chosen.append(row)
        self.rows = chosen

    def step(
        self, actions: np.ndarray
    ) -> tuple[list[Any], np.ndarray, np.ndarray, np.ndarray, np.ndarray, str]:
        """Step every row.

        :param actions: ``[rows, *act_shape]``.
        :return: observations (one per row), rewards, terminated, valid and stopped ``[rows]``, and the
            traceback of the first error that an environment raised.
        """
        isolation = isolated_globals(int(self._rng.integers(2**32))) if self.isolate else nullcontext()
        with isolation:
            errors = [row.step(action) for row, action in zip(self.rows, actions, strict=True)]
        first = next((error for error in errors if error is not None), None)
        trace = "" if first is None else "".join(traceback.format_exception(first))
        observations = [row.observation for row in self.rows]
        rewards = np.array([row.reward for row in self.rows])
        terminated = np.array([row.terminated for row in self.rows], dtype=bool)
        valid = np.array([row.valid for row in self.rows], dtype=bool)
        stopped = np.array([row.stopped for row in self.rows], dtype=bool)
        return observations, rewards, terminated, valid, stopped, trace

    def _close_rows(self) -> None:
        for row in (*self.rows, *self._spare):
            row.env.close()
        self.rows, self._spare = [], []

    def close(self) -> None:
        """Close every copy, and forget all states."""
        self._close_rows()
        self.roots.clear()


# A pool's copies of an environment, next to it: in a worker process nothing else could hold them.
_COPIES: WeakKeyDictionary[SnapshotEnvWrapper, dict[str, Copies]] = WeakKeyDictionary()


def copies_of(wrapper: SnapshotEnvWrapper, pool: str) -> Copies:
    """The copies that a pool keeps of an environment; none yet at first."""
    return _COPIES.setdefault(wrapper, {}).setdefault(pool, Copies())


def open_copies(wrapper: SnapshotEnvWrapper, pool: str) -> Randomness | None:
    """Prepare to keep copies of an environment.

    :return: what random numbers its steps use; ``None`` if that can only be said after its first reset.
    :raises SnapshotUnsupportedError: if it cannot be copied exactly.
    """
    randomness = probe_randomness(wrapper)
    copies_of(wrapper, pool).isolate = randomness is not None and randomness.shared
    return randomness


def set_rows(wrapper: SnapshotEnvWrapper, pool: str, *args: Any) -> None:
    """:meth:`Copies.set_rows`, next to the environment."""
    copies_of(wrapper, pool).set_rows(wrapper, *args)


def select_rows(wrapper: SnapshotEnvWrapper, pool: str, index: np.ndarray) -> None:
    """:meth:`Copies.select`, next to the environment."""
    copies_of(wrapper, pool).select(wrapper, index)


def step_rows(wrapper: SnapshotEnvWrapper, pool: str, actions: np.ndarray) -> Any:
    """:meth:`Copies.step`, next to the environment."""
    return copies_of(wrapper, pool).step(actions)


def drop_copies(wrapper: SnapshotEnvWrapper, pool: str) -> None:
    """Close the copies that a pool keeps of an environment, if it has any."""
    copies = _COPIES.get(wrapper, {}).pop(pool, None)
    if copies is not None:
        copies.close()


def keep_root(wrapper: SnapshotEnvWrapper, pool: str, dropped: list[int]) -> int:
    """:meth:`Copies.keep_root`, next to the environment."""
    return copies_of(wrapper, pool).keep_root(wrapper, dropped)
