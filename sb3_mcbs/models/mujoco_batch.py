"""The forward model for known MuJoCo environments: compiled code on threads."""

import os
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from sb3_mcbs.models.compiled_rollout import RolloutRows, short_horizon
from sb3_mcbs.models.compiled_rows import Rows, step_rows
from sb3_mcbs.models.environments import Environments
from sb3_mcbs.models.families import family_of
from sb3_mcbs.models.libmujoco import INTEGRATION
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
from sb3_mcbs.models.simulator import Simulator
from sb3_mcbs.models.workers import WorkerError
from sb3_mcbs.types import ForwardModel, ForwardModelError, PolicyArrays, PolicyRollouts, Transition

# Inherited from the parent of a forked process. Freeing one would wait for threads that do not exist.
_OF_THE_PARENT: list[Simulator] = []


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

    :ivar simulator: the compiled code and its threads.
    :ivar states: ``[rows, state_size]``, the present integration states.
    """

    deterministic = True
    kind = "mujoco"

    def __init__(self, environments: Environments, n_threads: int = 0) -> None:
        if n_threads < 0:
            raise ValueError(f"n_threads must be 0 (all processors) or more, got {n_threads}")
        self._environments = environments
        self._n_threads = n_threads or available_cpus()
        self.simulator: Simulator = None  # type: ignore[assignment]
        self.refresh()

    @property
    def n_rows(self) -> int:
        return len(self.states)

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
        self._known, self._n_kept = known, family.n_kept
        self._state_size = mujoco.mj_stateSize(known.model, INTEGRATION)
        self._reading = self._state_size, SimpleNamespace(**known.constants)
        self._act_dim = known.model.nu
        self.states = np.zeros((0, self._state_size))
        self._kept = np.zeros((0, self._n_kept))
        self._diverged = self._ended = np.zeros(0, dtype=bool)
        self._any_marked = False
        name = known.env_class.__name__
        n_threads = f"{self._n_threads} thread{'s' if self._n_threads > 1 else ''}"
        self.description = f"MuJoCo batch of {name} (compiled, {n_threads})"
        self._build()

    def _build(self) -> None:
        """Make the simulations and threads."""
        self.close()
        known, family = self._known, family_of(self._known.env_class)
        assert family is not None
        try:
            # It refuses models whose rows cannot share an MjData, which holds here as well.
            Batch(known.model, 1, 1)
            name = known.env_class.__name__
            self.simulator = Simulator(
                family, name, known.constants, known.model, known.frame_skip, self._n_threads
            )
        except ValueError as error:
            raise ForwardModelError(f"the batch cannot simulate this model: {error}") from error
        self._process = os.getpid()

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

    def read_roots(self, env_indices: Sequence[int]) -> list[Any]:
        return self._environments.apply(env_indices, read_root, *self._reading)

    def set_roots(self, roots: Sequence[Any], index: np.ndarray, rng: np.random.Generator) -> None:
        self.states, self._kept = self.split_roots(roots, index)
        self._diverged, self._ended = np.zeros((2, len(index)), dtype=bool)
        self._any_marked = False

    def split_roots(self, roots: Sequence[Any], index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Copy roots for rows.

        :param roots: from :meth:`read_roots`.
        :param index: ``[rows]``, the root of every row.
        :return: states ``[rows, state_size]``, and what the family keeps beside them ``[rows, n_kept]``.
        :raises ValueError: if the roots are not those of this model.
        """
        if self._process != os.getpid():
            self._build()  # threads do not survive a fork
        table = np.stack(roots)[index]
        if table.shape[1] != self._state_size + self._n_kept:
            raise ValueError("these roots were read by another model")
        states, kept = table[:, : self._state_size], table[:, self._state_size :]
        return np.ascontiguousarray(states), np.ascontiguousarray(kept)

    def rows(self) -> np.ndarray:
        """The present states of all rows ``[rows, *]``, each of which :meth:`set_roots` takes as a root."""
        return np.concatenate([self.states, self._kept], axis=1)

    def select(self, index: np.ndarray) -> None:
        self.states, self._kept = self.states[index], self._kept[index]
        self._diverged, self._ended = self._diverged[index], self._ended[index]

    def step(self, actions: np.ndarray) -> Transition:
        n_rows = self.n_rows
        expected = (n_rows, self._act_dim)
        if actions.shape != expected:
            raise ValueError(f"expected actions of shape {expected} [rows, act_dim], got {actions.shape}")
        terminated, valid = np.empty((2, n_rows), dtype=bool)
        observations, rewards = np.empty((n_rows, self._obs_dim)), np.empty(n_rows)
        rows = Rows(self.states, self._kept, observations, rewards, terminated, valid)
        self.simulator.run(step_rows, n_rows, rows, np.ascontiguousarray(actions))
        if self._any_marked or not valid.all() or terminated.any():
            self._any_marked = True
            # A row cannot become invalid after it has terminated.
            self._diverged |= ~valid & ~self._ended
            self._ended |= terminated
            valid = ~self._diverged
        return Transition(observations, rewards, terminated, valid)

    def roll_out(
        self,
        roots: Sequence[Any],
        index: np.ndarray,
        policy: PolicyArrays,
        actions: np.ndarray,
        noise: np.ndarray,
        n_shared: int,
        bootstraps: bool = True,
    ) -> PolicyRollouts:
        """Roll a policy out, through all depths at once. The rows of :meth:`set_roots` are left as they are.

        :param roots: from :meth:`read_roots`.
        :param index: ``[candidates]`` integers into ``roots``.
        :param policy: the actor and what lies between it and the environment.
        :param actions: ``[candidates, act_dim]`` float32, the first ones, scaled to [-1, 1].
        :param noise: ``[horizon, candidates, sim, act_dim]`` float32, added to the policy's actions after
            each step. The first ``n_shared - 1`` are the same for all simulations of a candidate.
        :param n_shared: steps that all simulations of a candidate share.
        :param bootstraps: whether the returns contain the critics' values of the ends.
        :return: the rollouts.
        """
        horizon, n_candidates, n_sim, act_dim = noise.shape
        n_rows = n_candidates * n_sim
        states, kept = self.split_roots(roots, np.repeat(index, n_sim))
        rows = RolloutRows(
            states,
            kept,
            np.repeat(actions, n_sim, axis=0),
            np.ascontiguousarray(noise.reshape(horizon, n_rows, act_dim)),
            returns=np.zeros(n_rows),
            valid=np.ones(n_rows, dtype=bool),
            terminated=np.zeros(n_rows, dtype=bool),
            lengths=np.zeros(n_rows, dtype=np.int64),
            observations=np.zeros((n_rows, self._obs_dim)),
            first_observations=np.zeros((n_candidates, self._obs_dim)),
            first_rewards=np.zeros(n_candidates),
            n_steps=np.zeros(n_candidates, dtype=np.int64),
        )
        self.simulator.run(short_horizon, n_candidates, policy, rows, n_shared, bootstraps)
        shape = n_candidates, n_sim
        return PolicyRollouts(
            rows.returns.reshape(shape),
            rows.valid.reshape(shape),
            rows.terminated.reshape(shape),
            rows.lengths.reshape(shape),
            rows.observations.reshape(*shape, self._obs_dim),
            rows.actions.reshape(*shape, act_dim),
            rows.first_observations,
            rows.first_rewards,
            int(rows.n_steps.sum()),
        )

    def _check(self) -> None:
        """Compare with copies of the real environments on random transitions.

        :raises NotRecognizedError: at the first difference.
        """
        sample: Sample = self._environments.apply([0], sample_transitions, *self._reading)[0]
        self._obs_dim = sample.observations[0, 0].size
        rng = np.random.default_rng(0)
        # All transitions as one batch, then whole rollouts, which also check what a row carries from step
        # to step.
        flat = Sample(*(array.reshape(-1, 1, *array.shape[2:]) for array in sample))
        for part in (flat, sample):
            self.set_roots(list(part.roots[:, 0]), np.arange(len(part.roots)), rng)
            for step in range(part.roots.shape[1]):
                self._compare(self.step(part.actions[:, step]), part, step)
        self.set_roots([np.zeros(self._state_size + self._n_kept)], np.zeros(0, dtype=int), rng)

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
        if self.simulator is None:
            return
        if self._process == os.getpid():
            self.simulator.close()
        else:
            _OF_THE_PARENT.append(self.simulator)
