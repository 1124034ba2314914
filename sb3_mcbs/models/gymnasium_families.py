"""The families of Gymnasium's MuJoCo runners and walkers, versions 4 and 5.

Each function follows the environment's ``step`` line by line; sums keep their order and their
dtype (the control cost of a float32 action is a float32).
"""

from functools import partial
from typing import Any

import numpy as np
from gymnasium.envs.mujoco import (
    ant_v4,
    ant_v5,
    half_cheetah_v4,
    half_cheetah_v5,
    hopper_v4,
    hopper_v5,
    swimmer_v4,
    swimmer_v5,
    walker2d_v4,
    walker2d_v5,
)

from sb3_mcbs.models.compiling import compiled
from sb3_mcbs.models.families import Constants, Family, register_family
from sb3_mcbs.models.row_arithmetic import (
    all_finite,
    put,
    put_clipped,
    sum_of_squares,
    weighted_squares,
    widens,
)


def control_constants(env: Any, skipped: int) -> Constants:
    """What all environments with a control cost read.

    :param env: the environment.
    :param skipped: the first positions, which observations leave out by default.
    """
    return {
        "dt": env.dt,
        "forward_reward_weight": getattr(env, "_forward_reward_weight", 1.0),
        "ctrl_cost_weight": env._ctrl_cost_weight,
        "ctrl_cost_widens": widens(env._ctrl_cost_weight),
        "first_position": skipped if env._exclude_current_positions_from_observation else 0,
    }


def upright_constants(env: Any, skipped: int, version: int) -> Constants:
    """What environments read that can fall.

    :param env: the environment.
    :param skipped: the first positions, which observations leave out by default.
    :param version: of the environment. Version 4 pays the healthy reward always if it does not terminate.
    """
    min_z, max_z = env._healthy_z_range
    return {
        **control_constants(env, skipped),
        "min_z": min_z,
        "max_z": max_z,
        "healthy_reward": env._healthy_reward,
        "terminates": bool(env._terminate_when_unhealthy),
        "always_paid": version == 4 and bool(env._terminate_when_unhealthy),
    }


# Runners in the plane ------------------------------------------------------------------------


def keep_x(env: Any, data: Any, kept: np.ndarray) -> None:
    kept[0] = data.qpos[0]


def run(env: Any, kept: np.ndarray, data: Any, action: np.ndarray, observation: np.ndarray) -> Any:
    """HalfCheetah and Swimmer: run along x, never fall."""
    x_velocity = (data.qpos[0] - kept[0]) / env.dt
    cost = weighted_squares(env.ctrl_cost_weight, env.ctrl_cost_widens, action)
    end = put(observation, 0, data.qpos[env.first_position :])
    put(observation, end, data.qvel)
    return env.forward_reward_weight * x_velocity - cost, False


def _walker_constants(env: Any, version: int) -> Constants:
    min_angle, max_angle = env._healthy_angle_range
    min_state, max_state = getattr(env, "_healthy_state_range", (-np.inf, np.inf))
    return {
        **upright_constants(env, 1, version),
        "min_angle": min_angle,
        "max_angle": max_angle,
        "limits_state": hasattr(env, "_healthy_state_range"),
        "min_state": min_state,
        "max_state": max_state,
    }


@compiled
def _all_between(low: float, values: np.ndarray, high: float) -> bool:
    for value in values:  # noqa: SIM110
        if not low < value < high:
            return False
    return True


@compiled
def _walker_is_healthy(env: Any, qpos: np.ndarray, qvel: np.ndarray) -> bool:
    z, angle = qpos[1], qpos[2]
    healthy = env.min_z < z < env.max_z and env.min_angle < angle < env.max_angle
    if env.limits_state:
        low, high = env.min_state, env.max_state
        healthy = healthy and _all_between(low, qpos[2:], high) and _all_between(low, qvel, high)
    return healthy


def walk(env: Any, kept: np.ndarray, data: Any, action: np.ndarray, observation: np.ndarray) -> Any:
    """Hopper and Walker2d: run along x and stay upright."""
    x_velocity = (data.qpos[0] - kept[0]) / env.dt
    healthy = _walker_is_healthy(env, data.qpos, data.qvel)
    paid = env.healthy_reward * (1.0 if healthy or env.always_paid else 0.0)
    cost = weighted_squares(env.ctrl_cost_weight, env.ctrl_cost_widens, action)
    end = put(observation, 0, data.qpos[env.first_position :])
    put_clipped(observation, end, data.qvel, -10.0, 10.0)
    return env.forward_reward_weight * x_velocity + paid - cost, env.terminates and not healthy


_PLANE = ("qpos", "qvel")
for _env_class, _skipped in (
    (half_cheetah_v4.HalfCheetahEnv, 1),
    (half_cheetah_v5.HalfCheetahEnv, 1),
    (swimmer_v4.SwimmerEnv, 2),
    (swimmer_v5.SwimmerEnv, 2),
):
    _constants = partial(control_constants, skipped=_skipped)
    register_family(_env_class, Family(_constants, _PLANE, run, keep_x, n_kept=1))
for _walker_class, _version in (
    (hopper_v4.HopperEnv, 4),
    (hopper_v5.HopperEnv, 5),
    (walker2d_v4.Walker2dEnv, 4),
    (walker2d_v5.Walker2dEnv, 5),
):
    _constants = partial(_walker_constants, version=_version)
    register_family(_walker_class, Family(_constants, _PLANE, walk, keep_x, n_kept=1))


# Ant -----------------------------------------------------------------------------------------


def _ant_constants(env: Any, version: int) -> Constants:
    low, high = env._contact_force_range
    shown = env._use_contact_forces if version == 4 else env._include_cfrc_ext_in_observation
    return {
        **upright_constants(env, 2, version),
        "torso": int(env.model.body("torso" if version == 4 else env._main_body).id),
        "contact_costs": bool(version == 5 or shown),
        "contact_cost_weight": env._contact_cost_weight,
        "min_force": low,
        "max_force": high,
        "shows_forces": bool(shown),
        "first_body": 0 if version == 4 else 1,
    }


def _keep_torso(env: Any, data: Any, kept: np.ndarray) -> None:
    kept[0] = data.xpos[env.torso, 0]


def _ant(env: Any, kept: np.ndarray, data: Any, action: np.ndarray, observation: np.ndarray) -> Any:
    x_velocity = (data.xpos[env.torso, 0] - kept[0]) / env.dt
    finite = all_finite(data.qpos) and all_finite(data.qvel)
    healthy = finite and env.min_z <= data.qpos[2] <= env.max_z
    paid = env.healthy_reward * (1.0 if healthy or env.always_paid else 0.0)
    rewards = x_velocity * env.forward_reward_weight + paid
    costs = weighted_squares(env.ctrl_cost_weight, env.ctrl_cost_widens, action)
    forces = np.empty(data.cfrc_ext.size)
    put_clipped(forces, 0, data.cfrc_ext, env.min_force, env.max_force)
    if env.contact_costs:
        costs = costs + env.contact_cost_weight * sum_of_squares(forces)
    end = put(observation, 0, data.qpos[env.first_position :])
    end = put(observation, end, data.qvel)
    if env.shows_forces:
        put(observation, end, forces[6 * env.first_body :])
    return rewards - costs, env.terminates and not healthy


for _ant_class, _version in ((ant_v4.AntEnv, 4), (ant_v5.AntEnv, 5)):
    _constants = partial(_ant_constants, version=_version)
    register_family(
        _ant_class, Family(_constants, ("qpos", "qvel", "xpos", "cfrc_ext"), _ant, _keep_torso, n_kept=1)
    )
