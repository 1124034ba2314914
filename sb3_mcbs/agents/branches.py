"""Simulated transitions of the current actor, from which the critics and the actor learn.

Rollouts branch off stored states and follow the current actor for some steps, as in MBPO (Janner et al.,
2019), with the simulator as the model: every transition is exact, and hardly any is older than
:data:`KEPT_UPDATES` gradient steps.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs.networks.functions import STOCHASTIC, Actor
from sb3_mcbs.networks.torch_settings import one_thread

#: How often a transition is learned from, on average.
USES = 2
#: Gradient steps whose transitions are kept; more where rollouts ended early.
KEPT_UPDATES = 400


def n_rollouts(n_sampled: int, n_steps: int) -> int:
    """How many rollouts go on side by side.

    :param n_sampled: transitions that are sampled per gradient step.
    :param n_steps: steps of each rollout per gradient step.
    """
    return math.ceil(n_sampled / (USES * n_steps))


def as_samples(
    buffer: Any,
    env: VecNormalize | None,
    first: np.ndarray,
    actions: np.ndarray,
    last: np.ndarray,
    *columns: np.ndarray,
) -> ReplayBufferSamples:
    """Convert transitions for the networks.

    :param buffer: the replay buffer that they stand beside.
    :param env: normalises observations.
    :param first: ``[n, obs_dim]``, observations as the environment returns them.
    :param actions: ``[n, act_dim]``, scaled.
    :param last: ``[n, obs_dim]``, where the targets bootstrap.
    :param columns: ``[n, 1]`` float32: whether they terminated there, discounted returns, discounts.
    """
    terminated, returns, discounts = map(buffer.to_torch, columns)
    return ReplayBufferSamples(
        buffer.to_torch(buffer._normalize_obs(first, env)),
        buffer.to_torch(actions),
        buffer.to_torch(buffer._normalize_obs(last, env)),
        terminated,
        returns,
        discounts,
    )


class _Step(NamedTuple):
    """One simulated step of some rollouts.

    :param before: ``[m, obs_dim]``, observations, as the environment returns them.
    :param actions: ``[m, act_dim]``, scaled.
    :param after: ``[m, obs_dim]``, the next observations.
    :param rewards: ``[m]``, scaled for the networks.
    :param bonus: ``[m]``, of the entropy of the actions.
    :param terminated: ``[m]`` bool.
    :param valid: ``[m]`` bool, whether the rollout had not ended before, and the step did not diverge.
    """

    before: np.ndarray
    actions: np.ndarray
    after: np.ndarray
    rewards: np.ndarray
    bonus: np.ndarray
    terminated: np.ndarray
    valid: np.ndarray


class Branches:
    """Rollouts of the current actor, and their latest transitions.

    The rollouts are continued by ``value_expansion`` steps per gradient step. Each transition's target
    reaches to the end of these steps, or to a termination.

    :param buffer: the replay buffer whose states they branch off.
    :param n: rollouts that are continued side by side.
    :param n_steps: steps of each per gradient step.
    :param length: steps until a rollout ends, and another one branches off in its place.

    :ivar shape: ``(n, n_steps, length)``.
    :ivar states: ``[n, state_size]``, where the rollouts are at present.
    :ivar observations: ``[n, obs_dim]`` there, as the environment returns them.
    :ivar left: ``[n]``, steps that are left of them; 0 where none has begun.
    :ivar transitions: first observations, actions, last observations, whether terminated, discounted
        returns and discounts: ``[capacity, *]`` each.
    :ivar n_added: transitions so far; the latest are kept.
    """

    def __init__(self, buffer: Any, n: int, n_steps: int, length: int) -> None:
        self.shape = n, n_steps, length
        self.states = np.zeros((n, buffer.expansion_states.shape[-1]))
        self.observations = np.zeros((n, *buffer.observations.shape[2:]), buffer.observations.dtype)
        self.left = np.zeros(n, dtype=int)
        self._is_new = True

        def rows(a: np.ndarray) -> np.ndarray:
            return np.zeros((KEPT_UPDATES * n * n_steps, *a.shape[2:]), a.dtype)

        self.transitions = (
            rows(buffer.observations),
            rows(buffer.actions),
            rows(buffer.observations),
            rows(buffer.rewards[..., None]),
            rows(buffer.rewards[..., None]),
            rows(buffer.rewards[..., None]),
        )
        self.n_added = 0

    def __len__(self) -> int:
        return min(self.n_added, len(self.transitions[1]))

    def fits(self, buffer: Any, shape: tuple[int, int, int]) -> bool:
        """Whether these are branches of this shape, with states as the replay buffer's.

        :param buffer: the replay buffer.
        :param shape: see :attr:`shape`.
        """
        return self.shape == shape and self.states.shape[1] == buffer.expansion_states.shape[2]

    def go_on(
        self, buffer: Any, agent: Any, act: Actor, rng: np.random.Generator, env: VecNormalize | None
    ) -> None:
        """Continue the rollouts.

        :param buffer: the replay buffer.
        :param agent: whose environments they simulate. The steps are added to its ``n_simulated_steps``.
        :param act: the actor that they follow.
        :param rng: samples states to branch off, and the actor's actions.
        :param env: normalises observations and rewards.
        """
        self._branch_off(buffer, rng)
        going = np.flatnonzero(self.left > 0)
        if not len(going):
            return
        with one_thread():
            segment = self._simulate(going, buffer, agent, act, rng, env)
        self._store(segment, agent.gamma)

    def _branch_off(self, buffer: Any, rng: np.random.Generator) -> None:
        """Begin rollouts in the place of those that ended, where the sampled row has a state."""
        ended = np.flatnonzero(self.left <= 0)
        at = rng.integers(0, buffer.size(), len(ended)), rng.integers(0, buffer.n_envs, len(ended))
        held = buffer.expansion_held[at]
        ended, at = ended[held], (at[0][held], at[1][held])
        self.states[ended] = buffer.expansion_states[at]
        self.observations[ended] = buffer.next_observations[at]
        length = self.shape[2]
        # The first ones end at different times, so that later ones do not begin all at once.
        self.left[ended] = rng.integers(1, length + 1, len(ended)) if self._is_new else length
        self._is_new = self._is_new and not len(ended)

    def _simulate(
        self,
        going: np.ndarray,
        buffer: Any,
        agent: Any,
        act: Actor,
        rng: np.random.Generator,
        env: VecNormalize | None,
    ) -> list[_Step]:
        """Simulate the steps of one gradient step.

        :param going: ``[m]``, indices of the rollouts.
        :return: the steps.
        """
        planner, n_steps = agent.planner, self.shape[1]
        model, view = planner.model, planner.source.view
        model.set_roots(list(self.states[going]), np.arange(len(going)), rng)
        before = self.observations[going]
        seen = buffer._normalize_obs(before, env)
        goes_on = np.ones(len(going), dtype=bool)
        steps = []
        for _ in range(n_steps):
            actions, bonus = act(seen, rng)
            if not isinstance(agent, STOCHASTIC):
                noise = agent.beam_noise * rng.standard_normal(actions.shape, dtype=np.float32)
                actions = np.clip(actions + noise, -1, 1)
            step = model.step(planner.unscale(actions))
            agent.n_simulated_steps += len(going)
            after: Any = view.observe(step.observations, normalize=False)
            rewards = buffer._normalize_reward(step.rewards, env)
            steps.append(_Step(before, actions, after, rewards, bonus, step.terminated, goes_on & step.valid))
            goes_on = goes_on & step.goes_on
            # The actor gets nothing that is not finite.
            seen = np.where(step.valid[:, None], buffer._normalize_obs(after, env), seen)
            before = after
        self.states[going] = model.rows()
        self.observations[going] = after
        self.left[going] = np.where(goes_on, self.left[going] - n_steps, 0)
        return steps

    def _store(self, steps: list[_Step], gamma: float) -> None:
        """Add the transitions of one gradient step, each with the target of the steps that follow it.

        :param steps: from first to last.
        :param gamma: the discount factor.
        """
        returns = bonus = np.zeros(len(steps[0].rewards))
        lengths = np.zeros(len(returns), dtype=int)
        last = steps[-1].after.copy()
        terminated = np.zeros(len(returns), dtype=bool)
        followed = np.zeros(len(returns), dtype=bool)
        for step in reversed(steps):
            ends = step.valid & ~followed
            returns = step.rewards + np.where(followed, gamma * (bonus + returns), 0.0)
            lengths = np.where(followed, lengths + 1, 1)
            last[ends] = step.after[ends]
            terminated[ends] = step.terminated[ends]
            self._add(step, last, terminated, returns, gamma**lengths)
            followed, bonus = step.valid, step.bonus

    def _add(self, step: _Step, last: np.ndarray, *columns: np.ndarray) -> None:
        """Add one transition of each rollout that was going.

        :param step: its first step.
        :param last: ``[m, obs_dim]``, where its target bootstraps.
        :param columns: ``[m]``: whether it terminated there, the discounted return until there, the discount.
        """
        valid = step.valid
        n = int(valid.sum())
        rows = (self.n_added + np.arange(n)) % len(self.transitions[1])
        values = step.before, step.actions, last, *(column[:, None] for column in columns)
        for kept, new in zip(self.transitions, values, strict=True):
            kept[rows] = new[valid]
        self.n_added += n

    def sample(
        self, n: int, buffer: Any, rng: np.random.Generator, env: VecNormalize | None
    ) -> ReplayBufferSamples:
        """Sample the kept transitions.

        :param n: how many.
        :param buffer: the replay buffer, which converts them for the networks.
        :param rng: draws them.
        :param env: normalises observations.
        """
        rows = rng.integers(0, len(self), n)
        return as_samples(buffer, env, *(array[rows] for array in self.transitions))
