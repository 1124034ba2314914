"""Inputs and outputs of a search, for all strategies.

Arrays in, arrays out. Actions are scaled to [-1, 1], as a policy network returns them.
Axes: ``n_envs`` environments, ``beam`` candidates, ``sim`` simulations, ``act_dim`` action dimensions.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_mcbs.types import ForwardModel, Observations, PolicyRollouts, Transition, take_rows

RolloutFunction = Callable[[Sequence[Any], np.ndarray, np.ndarray, np.ndarray, int], PolicyRollouts]


class Roots(NamedTuple):
    """Where a search starts: the current states of the environments.

    :param model: simulates from these states; ``None`` if ``rollout_depth`` is 0.
    :param states: one per environment, from :meth:`ForwardModel.read_roots`.
    :param observations: ``[n_envs, *obs_shape]``, current observations.
    """

    model: ForwardModel | None
    states: Sequence[Any]
    observations: Observations


class PolicyFunctions(NamedTuple):
    """The agent's networks and settings, as a search uses them.

    :param policy: observations ``[rows, ...]`` -> actions ``[rows, act_dim]`` in [-1, 1], without
        exploration noise.
    :param value: observations ``[rows, ...]``, scaled actions ``[rows, act_dim]`` -> the critics'
        estimate of the return ``[rows]``: their minimum, or TQC's mean over all quantiles.
    :param gamma: discount factor per environment step.
    :param unscale_action: scaled actions ``[rows, act_dim]`` -> actions of the environment.
    :param scale_reward: rewards of the environment ``[rows]`` -> the critics' scale.
    :param act_dim: action dimensions.
    :param rollout: rolls the policy out in compiled code, with the arguments root states, root index
        ``[candidates]``, first actions, noise and the number of shared steps, as
        :meth:`MujocoBatchModel.roll_out`; ``None`` where that does not cover the networks or the environment.
    """

    policy: Callable[[Observations], np.ndarray]
    value: Callable[[Observations, np.ndarray], np.ndarray]
    gamma: float
    unscale_action: Callable[[np.ndarray], np.ndarray]
    scale_reward: Callable[[np.ndarray], np.ndarray]
    act_dim: int
    rollout: RolloutFunction | None = None


class CountedValue:
    """The critics with a counter.

    :param value: see :class:`PolicyFunctions`.

    :ivar evaluations: number of evaluated state-action pairs.
    """

    def __init__(self, value: Callable[[Observations, np.ndarray], np.ndarray]) -> None:
        self._value = value
        self.evaluations = 0

    def count(self, evaluations: int) -> None:
        """Count pairs that were evaluated elsewhere."""
        self.evaluations += evaluations

    def __call__(self, observations: Observations, actions: np.ndarray) -> np.ndarray:
        self.evaluations += len(actions)
        return self._value(observations, actions)


class FirstStep(NamedTuple):
    """The forward model's prediction for the chosen actions.

    :param observations: ``[n_envs, *obs_shape]``.
    :param rewards: ``[n_envs]``, not scaled.
    """

    observations: Observations
    rewards: np.ndarray


class Rollouts(NamedTuple):
    """Candidates and the results of their rollouts.

    :param candidates: ``[n_envs, beam, act_dim]``.
    :param values: ``[n_envs, beam, sim]`` in float64, not finite where a simulation was invalid.
    :param first_step: of every candidate, ``[n_envs * beam]``; ``None`` if nothing was simulated.
    :param simulated_steps: environment steps, each counted once.
    """

    candidates: np.ndarray
    values: np.ndarray
    first_step: FirstStep | None
    simulated_steps: int


class SearchResult(NamedTuple):
    """The outcome of one decision in every environment.

    :param actions: ``[n_envs, act_dim]``, the actions to execute, scaled.
    :param chosen: ``[n_envs]``, indices of the chosen candidates; -1 where every candidate was invalid and
        the policy's own action was taken.
    :param candidates: ``[n_envs, beam, act_dim]``, all simulated ones: the root actions of a tree, the first
        actions of all rounds of the cross-entropy method.
    :param values: ``[n_envs, beam]``, Q~_i; -inf where a simulation of the candidate was invalid. In a tree
        a dropped root action keeps its last value.
    :param first_step: the chosen candidates' first simulated step (of their first simulation);
        ``None`` if nothing was simulated. Meaningless where ``chosen`` is -1.
    :param simulated_steps: environment steps that were simulated, each counted once.
    :param invalid_rollouts: rollouts that diverged or whose value is not finite.
    :param rounds: finished rounds: 1, ``n_rounds``, or any number with a time budget.
    :param critic_evaluations: state-action pairs that the critics evaluated.
    :param surviving_roots: ``[n_envs]``, for a tree: number of root actions with a node at the end.
    :param plans: ``[n_envs, rollout_depth, act_dim]``, for the cross-entropy method: the chosen plans; 0
        where none was valid.
    """

    actions: np.ndarray
    chosen: np.ndarray
    candidates: np.ndarray
    values: np.ndarray
    first_step: FirstStep | None
    simulated_steps: int
    invalid_rollouts: int
    rounds: int = 1
    critic_evaluations: int = 0
    surviving_roots: np.ndarray | None = None
    plans: np.ndarray | None = None


def policy_alone(policy_actions: np.ndarray, simulated_steps: int = 0) -> SearchResult:
    """The result if no candidate was evaluated.

    :param policy_actions: ``[n_envs, act_dim]``, to be executed.
    :param simulated_steps: steps of an abandoned round.
    """
    n_envs, act_dim = policy_actions.shape
    return SearchResult(
        actions=policy_actions,
        chosen=np.full(n_envs, -1),
        candidates=np.zeros((n_envs, 0, act_dim), dtype=policy_actions.dtype),
        values=np.zeros((n_envs, 0)),
        first_step=None,
        simulated_steps=simulated_steps,
        invalid_rollouts=0,
        rounds=0,
    )


def stopped_values(step: Transition, functions: PolicyFunctions) -> tuple[np.ndarray, np.ndarray]:
    """Bootstrap rows whose episode the environment itself truncated.

    :param step: ``[rows]``, with ``stopped``.
    :param functions: the policy and the critics.
    :return: indices of those rows ``[n]``, and their values ``[n]`` in float64.
    """
    assert step.stopped is not None
    rows = np.flatnonzero(step.stopped & step.valid & ~step.terminated)
    if not len(rows):
        return rows, np.zeros(0)
    observations = take_rows(step.observations, rows)
    actions = functions.policy(observations)
    return rows, functions.value(observations, actions).astype(np.float64)
