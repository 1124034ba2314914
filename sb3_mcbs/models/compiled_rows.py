"""The loops over simulated rows, which :class:`~.simulator.Simulator` compiles for a family."""

from typing import Any, NamedTuple

import numpy as np

from sb3_mcbs.models.libmujoco import (
    INTEGRATION,
    Simulation,
    mj_get_state,
    mj_reset_data,
    mj_set_state,
    mjb_apply,
)
from sb3_mcbs.models.row_arithmetic import all_finite

#: The family's functions, and named tuples of its constants and fields: inserted when a loop is compiled.
transition: Any = None
keep: Any = None
Constants: Any = None
Data: Any = None


class Rows(NamedTuple):
    """The results of one step of many rows, and the states that it changes.

    :param states: ``[rows, state_size]``.
    :param kept: ``[rows, n_kept]``, what the family keeps beside the states.
    :param observations: ``[rows, obs_dim]``.
    :param rewards: ``[rows]``.
    :param terminated: ``[rows]`` bool.
    :param valid: ``[rows]`` bool, False where the simulation diverged or something is not finite.
    """

    states: np.ndarray
    kept: np.ndarray
    observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    valid: np.ndarray


def env_step(
    simulation: Simulation,
    env: Any,
    data: Any,
    state: np.ndarray,
    kept: np.ndarray,
    action: np.ndarray,
    observation: np.ndarray,
) -> tuple[float, bool, bool]:
    """Step one row.

    :param simulation: where it is simulated.
    :param env: the family's constants.
    :param data: the fields of that simulation.
    :param state: ``[state_size]``, changed.
    :param kept: ``[n_kept]``, changed.
    :param action: ``[act_dim]``.
    :param observation: ``[obs_dim]``, written.
    :return: reward, whether the row terminated, and whether it is valid.
    """
    mj_set_state(simulation.model, simulation.data, state.ctypes.data, INTEGRATION)
    simulation.controls[:] = action
    simulation.warnings[:] = 0
    if mjb_apply(simulation.guard, 0, 1, simulation.stepper, simulation.job.ctypes.data, 0):
        mj_reset_data(simulation.model, simulation.data)
        observation[:] = np.nan
        return np.nan, False, False
    reward, terminated = transition(env, kept, data, action, observation)
    mj_get_state(simulation.model, simulation.data, state.ctypes.data, INTEGRATION)
    keep(env, data, kept)
    valid = not simulation.warnings.any() and np.isfinite(reward) and all_finite(observation)
    return reward, terminated, valid


def step_rows(
    simulation: Simulation,
    constants: tuple[Any, ...],
    fields: tuple[np.ndarray, ...],
    rows: Rows,
    actions: np.ndarray,
    first: int,
    last: int,
) -> None:
    """Step the rows from ``first`` to ``last - 1``.

    :param simulation: where they are simulated.
    :param constants: the family's constants.
    :param fields: the fields of that simulation.
    :param rows: states to step and arrays to write.
    :param actions: ``[rows, act_dim]``.
    :param first: the first row.
    :param last: the row after the last.
    """
    env, data = Constants(*constants), Data(*fields)
    for row in range(first, last):
        rows.rewards[row], rows.terminated[row], rows.valid[row] = env_step(
            simulation, env, data, rows.states[row], rows.kept[row], actions[row], rows.observations[row]
        )
