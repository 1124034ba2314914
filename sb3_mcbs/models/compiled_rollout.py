"""ShortHorizon of Algorithm 1, to be compiled for one family like the loops of ``compiled_rows``.

Every thread takes its share of the candidates through all depths without meeting the others. Line numbers
are those of the paper's Algorithm 1.
"""

from typing import Any, NamedTuple

import numpy as np

from sb3_mcbs.models.compiled_networks import act, evaluate
from sb3_mcbs.models.compiled_rows import env_step
from sb3_mcbs.models.compiling import compiled
from sb3_mcbs.models.libmujoco import Simulation
from sb3_mcbs.types import PolicyArrays

#: Named tuples of the family's constants and fields: inserted when the loop is compiled.
Constants: Any = None
Data: Any = None


class RolloutRows(NamedTuple):
    """All rollouts: one row per simulation of every candidate. Results as in ``PolicyRollouts``.

    :param states: ``[rows, state_size]``, where the rollouts are at present.
    :param kept: ``[rows, n_kept]``, what the family keeps beside the states.
    :param actions: ``[rows, act_dim]``, the next actions, scaled to [-1, 1].
    :param noise: ``[horizon, rows, act_dim]``, added to the policy's actions after each step.
    :param n_steps: ``[candidates]``, simulated steps.
    """

    states: np.ndarray
    kept: np.ndarray
    actions: np.ndarray
    noise: np.ndarray
    returns: np.ndarray
    valid: np.ndarray
    terminated: np.ndarray
    lengths: np.ndarray
    observations: np.ndarray
    first_observations: np.ndarray
    first_rewards: np.ndarray
    n_steps: np.ndarray


def short_horizon(
    simulation: Simulation,
    constants: tuple[Any, ...],
    fields: tuple[np.ndarray, ...],
    policy: PolicyArrays,
    rollouts: RolloutRows,
    n_shared: int,
    bootstraps: bool,
    first: int,
    last: int,
) -> None:
    """Roll out the candidates from ``first`` to ``last - 1`` (Algorithm 1, lines 24 to 38).

    :param simulation: where they are simulated.
    :param constants: the family's constants.
    :param fields: the fields of that simulation.
    :param policy: the actor and its pipeline.
    :param rollouts: states, first actions and noise; changed in place.
    :param n_shared: steps that all simulations of a candidate share, since their actions do not differ yet.
    :param bootstraps: whether the critics' value of the end is added.
    :param first: the first candidate.
    :param last: the candidate after the last.
    """
    env, data = Constants(*constants), Data(*fields)
    n_sim = len(rollouts.returns) // len(rollouts.n_steps)
    rows = np.arange(first * n_sim, last * n_sim, n_sim)  # the first simulation stands for all of them
    observation = np.empty(rollouts.observations.shape[1])
    alpha = 1.0  # line 25
    for depth in range(1, len(rollouts.noise) + 1):  # line 26
        n_going = 0
        for row in rows:
            rollouts.n_steps[row // n_sim] += 1
            reward, done, valid = env_step(  # line 27
                simulation,
                env,
                data,
                rollouts.states[row],
                rollouts.kept[row],
                unscaled(policy, rollouts.actions[row]),
                observation,
            )
            note_step(policy, rollouts, row, n_sim, observation, reward, done, valid, alpha)  # line 28
            if valid and not done:  # lines 29 and 30
                rows[n_going] = row
                n_going += 1
        rows = rows[:n_going]
        alpha *= policy.gamma
        if depth < len(rollouts.noise) or bootstraps:
            act(policy, rollouts.observations, rows, rollouts.actions)
        if depth == n_shared and n_sim > 1:  # from here on the simulations differ
            rows = split(rollouts, rows, n_sim, first, last)
        for row in rows:  # lines 32 and 33
            add_noise(rollouts.actions[row], rollouts.noise[depth - 1, row])
    if bootstraps:
        values = evaluate(policy, rollouts.observations, rollouts.actions, rows)  # line 36
        for number in range(len(rows)):
            rollouts.returns[rows[number]] += alpha * values[number]  # line 37


@compiled
def unscaled(policy: PolicyArrays, action: np.ndarray) -> np.ndarray:
    """The action of the environment, rounded as by SB3.

    :param action: ``[act_dim]`` in [-1, 1].
    """
    return (action + np.float32(1)) * policy.half_range + policy.low


@compiled
def note_step(
    policy: PolicyArrays,
    rollouts: RolloutRows,
    row: int,
    n_sim: int,
    observation: np.ndarray,
    reward: float,
    done: bool,
    valid: bool,
    alpha: float,
) -> None:
    """Add one step to a row's results. A step that diverged leaves them as they were.

    :param row: the row.
    :param n_sim: rows per candidate.
    :param observation: ``[obs_dim]`` after the step.
    :param reward: of the environment.
    :param done: whether the row terminated.
    :param valid: whether it did not diverge.
    :param alpha: discount of this step.
    """
    if rollouts.n_steps[row // n_sim] == 1:
        rollouts.first_observations[row // n_sim] = observation
        rollouts.first_rewards[row // n_sim] = reward
    rollouts.valid[row] = valid
    if valid:
        scaled = min(max(reward / policy.reward_scale, -policy.reward_clip), policy.reward_clip)
        rollouts.returns[row] += alpha * scaled
        rollouts.terminated[row] = done
        rollouts.lengths[row] += 1
        rollouts.observations[row] = observation


@compiled
def split(rollouts: RolloutRows, rows: np.ndarray, n_sim: int, first: int, last: int) -> np.ndarray:
    """Copy each candidate's first simulation to its others.

    :param rows: of the candidates that go on.
    :param n_sim: rows per candidate.
    :param first: the first candidate.
    :param last: the candidate after the last.
    :return: all rows of the candidates that go on.
    """
    for source in range(first * n_sim, last * n_sim, n_sim):
        for row in range(source + 1, source + n_sim):
            rollouts.states[row] = rollouts.states[source]
            rollouts.kept[row] = rollouts.kept[source]
            rollouts.actions[row] = rollouts.actions[source]
            rollouts.observations[row] = rollouts.observations[source]
            rollouts.returns[row] = rollouts.returns[source]
            rollouts.valid[row] = rollouts.valid[source]
            rollouts.terminated[row] = rollouts.terminated[source]
            rollouts.lengths[row] = rollouts.lengths[source]
    everything = np.empty(len(rows) * n_sim, dtype=rows.dtype)
    for number in range(len(everything)):
        everything[number] = rows[number // n_sim] + number % n_sim
    return everything


@compiled
def add_noise(action: np.ndarray, noise: np.ndarray) -> None:
    """Add noise, and clip to [-1, 1] what is not NaN.

    :param action: ``[act_dim]``, changed.
    :param noise: ``[act_dim]``.
    """
    for i in range(len(action)):
        action[i] += noise[i]
        if action[i] > 1:
            action[i] = 1
        elif action[i] < -1:
            action[i] = -1
