"""What a search simulated: the actions of every rollout, and the way of a body along them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_mcbs.search import SearchSettings, TreeSettings
from sb3_mcbs.snapshot import Snapshot, SnapshotEnvWrapper
from sb3_mcbs.types import ForwardModel, Transition
from sb3_mcbs.video.bodies import body_positions


class Rollout(NamedTuple):
    """One simulated sequence of actions.

    :param candidate: index of the candidate whose rollout this is, as in ``SearchResult.values``.
    :param actions: ``[steps, *act_shape]``, of the environment.
    """

    candidate: int
    actions: np.ndarray


class _Step(NamedTuple):
    """The rows of the step before that were continued ``[rows]``, and the actions ``[rows, *act_shape]``."""

    parents: np.ndarray
    actions: np.ndarray


class RecordedModel(ForwardModel):
    """A forward model that records the actions it simulates.

    :param model: the forward model that simulates.

    :ivar recorded: that model.
    """

    def __init__(self, model: ForwardModel) -> None:
        self.recorded = model
        self.kind, self.description = model.kind, model.description
        self._rounds: list[list[_Step]] = []
        self._parents = np.zeros(0, dtype=int)
        self._follow()

    def _follow(self) -> None:
        self.deterministic, self.first_error = self.recorded.deterministic, self.recorded.first_error

    @property
    def n_rows(self) -> int:
        return self.recorded.n_rows

    def read_roots(self, env_indices: Sequence[int]) -> list[Any]:
        roots = self.recorded.read_roots(env_indices)
        self._follow()
        return roots

    def set_roots(self, roots: Sequence[Any], index: np.ndarray, rng: np.random.Generator) -> None:
        self.recorded.set_roots(roots, index, rng)
        self._rounds.append([])
        self._parents = np.arange(len(index))

    def select(self, index: np.ndarray) -> None:
        self.recorded.select(index)
        self._parents = self._parents[index]

    def step(self, actions: np.ndarray) -> Transition:
        transition = self.recorded.step(actions)
        self._follow()
        self._rounds[-1].append(_Step(self._parents, actions.copy()))
        self._parents = np.arange(len(actions))
        return transition

    def refresh(self) -> None:
        self.recorded.refresh()

    def close(self) -> None:
        self.recorded.close()

    def forget(self) -> None:
        """Forget all rollouts: before a decision."""
        self._rounds.clear()

    def rollouts(self, settings: SearchSettings) -> list[Rollout]:
        """Return the rollouts since :meth:`forget`, of one decision in one environment.

        :param settings: settings of the decision.
        """
        # In a deterministic environment a row is all simulations of a candidate, until their noise differs.
        n_sim = 1 if self.deterministic else settings.distinct_simulations(deterministic=False)
        found, before = [], 0
        for steps in self._rounds:
            if not steps:
                continue
            n_candidates = len(steps[0].actions) // n_sim
            for row, actions in _leaves(steps):
                # A tree has the root actions of one simulation side by side.
                own = row % n_candidates if isinstance(settings, TreeSettings) else row // n_sim
                found.append(Rollout(before + own, actions))
            before += n_candidates
        return found


def _leaves(steps: list[_Step]) -> list[tuple[int, np.ndarray]]:
    """Rows that were not continued: their row in the first step, and all actions from there."""
    found = []
    for last, step in enumerate(steps):
        continued = set(steps[last + 1].parents.tolist()) if last + 1 < len(steps) else set()
        for leaf in sorted(set(range(len(step.actions))) - continued):
            row, actions = leaf, []
            for earlier in reversed(steps[1 : last + 1]):
                actions.append(earlier.actions[row])
                row = int(earlier.parents[row])
            actions.append(steps[0].actions[row])
            found.append((row, np.stack(actions[::-1])))
    return found


def replay(
    copy: SnapshotEnvWrapper,
    state: Snapshot,
    actions: np.ndarray,
    bodies: Sequence[int],
    rng: np.random.Generator,
) -> np.ndarray:
    """Follow bodies along a rollout.

    :param copy: a copy of the environment, which is left at the end of the rollout.
    :param state: where the rollout starts.
    :param actions: ``[steps, *act_shape]``.
    :param bodies: numbers of the bodies.
    :param rng: replaces the environment's generators.
    :return: ``[1 + steps, bodies, 3]``, positions; fewer where the rollout ends.
    """
    copy.restore(state, rng)
    positions = [body_positions(copy, bodies)]
    for action in actions:
        terminated = copy.step(action)[2]
        positions.append(body_positions(copy, bodies))
        if terminated:
            break
    return np.stack(positions)
