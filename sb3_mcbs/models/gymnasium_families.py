"""The families of Gymnasium's MuJoCo runners, walkers and humanoids, versions 4 and 5.

Each function follows the environment's ``step`` line by line; sums keep their order and their
dtype (the control cost of a float32 action is a float32).
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from gymnasium.envs.mujoco import (
    ant_v4,
    ant_v5,
    half_cheetah_v4,
    half_cheetah_v5,
    hopper_v4,
    hopper_v5,
    humanoid_v4,
    humanoid_v5,
    humanoidstandup_v4,
    humanoidstandup_v5,
    swimmer_v4,
    swimmer_v5,
    walker2d_v4,
    walker2d_v5,
)

from sb3_mcbs.models.families import (
    Constants,
    Family,
    Fields,
    Outcome,
    Rows,
    no_termination,
    register_family,
    sum_of_squares,
)

_EXCLUDE = "_exclude_current_positions_from_observation"


def _positions(env: Constants, after: Rows, skipped: int) -> np.ndarray:
    if env._exclude_current_positions_from_observation:
        positions: np.ndarray = after.qpos[:, skipped:]
        return positions
    return after.qpos


def _control_cost(env: Constants, actions: np.ndarray) -> np.ndarray:
    cost: np.ndarray = env._ctrl_cost_weight * sum_of_squares(actions)
    return cost


def _healthy_reward_v4(env: Constants, healthy: np.ndarray) -> np.ndarray:
    paid = np.logical_or(healthy, env._terminate_when_unhealthy)
    reward: np.ndarray = paid * env._healthy_reward
    return reward


def _healthy_reward_v5(env: Constants, healthy: np.ndarray) -> np.ndarray:
    reward: np.ndarray = healthy * env._healthy_reward
    return reward


def _unhealthy(env: Constants, healthy: np.ndarray) -> np.ndarray:
    return ~healthy if env._terminate_when_unhealthy else no_termination(len(healthy))


def _state_only(_env: Constants) -> Fields:
    return Fields(before=("qpos",), after=("qpos", "qvel"))


# Runners in the plane ------------------------------------------------------------------------


def _runner(env: Constants, before: Rows, after: Rows, actions: np.ndarray, skipped: int) -> Outcome:
    """HalfCheetah and Swimmer: run along x, never fall."""
    x_velocity = (after.qpos[:, 0] - before.qpos[:, 0]) / env.dt
    reward = env._forward_reward_weight * x_velocity - _control_cost(env, actions)
    observation = np.concatenate((_positions(env, after, skipped), after.qvel), axis=1)
    return observation, reward, no_termination(len(actions))


def _healthy_walker(env: Constants, after: Rows) -> np.ndarray:
    z, angle = after.qpos[:, 1], after.qpos[:, 2]
    (min_z, max_z), (min_angle, max_angle) = env._healthy_z_range, env._healthy_angle_range
    healthy: np.ndarray = (min_z < z) & (z < max_z) & (min_angle < angle) & (angle < max_angle)
    return healthy


def _healthy_hopper(env: Constants, after: Rows) -> np.ndarray:
    state = np.concatenate((after.qpos, after.qvel), axis=1)[:, 2:]
    low, high = env._healthy_state_range
    return np.logical_and(low < state, state < high).all(axis=1) & _healthy_walker(env, after)


def _walker(
    env: Constants,
    before: Rows,
    after: Rows,
    actions: np.ndarray,
    is_healthy: Callable[[Constants, Rows], np.ndarray],
    healthy_reward: Callable[[Constants, np.ndarray], np.ndarray],
) -> Outcome:
    """Hopper and Walker2d: run along x and stay upright."""
    x_velocity = (after.qpos[:, 0] - before.qpos[:, 0]) / env.dt
    healthy = is_healthy(env, after)
    reward = (
        env._forward_reward_weight * x_velocity + healthy_reward(env, healthy) - _control_cost(env, actions)
    )
    observation = np.concatenate((_positions(env, after, 1), np.clip(after.qvel, -10, 10)), axis=1)
    return observation, reward, _unhealthy(env, healthy)


_RUNNER = ("_forward_reward_weight", "_ctrl_cost_weight", _EXCLUDE)
_UPRIGHT = (*_RUNNER, "_healthy_reward", "_terminate_when_unhealthy", "_healthy_z_range")
_WALKER = (*_UPRIGHT, "_healthy_angle_range")
_HOPPER = (*_WALKER, "_healthy_state_range")

for _env_class, _skipped in (
    (half_cheetah_v4.HalfCheetahEnv, 1),
    (half_cheetah_v5.HalfCheetahEnv, 1),
    (swimmer_v4.SwimmerEnv, 2),
    (swimmer_v5.SwimmerEnv, 2),
):
    register_family(_env_class, Family(_RUNNER, _state_only, partial(_runner, skipped=_skipped)))
for _walker_class, _names, _is_healthy, _paid in (
    (hopper_v4.HopperEnv, _HOPPER, _healthy_hopper, _healthy_reward_v4),
    (hopper_v5.HopperEnv, _HOPPER, _healthy_hopper, _healthy_reward_v5),
    (walker2d_v4.Walker2dEnv, _WALKER, _healthy_walker, _healthy_reward_v4),
    (walker2d_v5.Walker2dEnv, _WALKER, _healthy_walker, _healthy_reward_v5),
):
    _walk = partial(_walker, is_healthy=_is_healthy, healthy_reward=_paid)
    register_family(_walker_class, Family(_names, _state_only, _walk))


# Ant -----------------------------------------------------------------------------------------


def _ant_fields(env: Constants, contact: bool) -> Fields:
    return Fields(before=("xpos",), after=("qpos", "qvel", "xpos", *(("cfrc_ext",) if contact else ())))


def _ant_fields_v4(env: Constants) -> Fields:
    return _ant_fields(env, contact=bool(env._use_contact_forces))


def _ant_fields_v5(env: Constants) -> Fields:
    return _ant_fields(
        env, contact=bool(env._include_cfrc_ext_in_observation or env._contact_cost_weight != 0)
    )


def _ant_x_velocity(env: Constants, before: Rows, after: Rows, body: int) -> np.ndarray:
    velocity: np.ndarray = (after.xpos[:, body, 0] - before.xpos[:, body, 0]) / env.dt
    return velocity


def _healthy_ant(env: Constants, after: Rows) -> np.ndarray:
    low, high = env._healthy_z_range
    z = after.qpos[:, 2]
    finite = np.isfinite(after.qpos).all(axis=1) & np.isfinite(after.qvel).all(axis=1)
    healthy: np.ndarray = finite & (low <= z) & (z <= high)
    return healthy


def _contact_forces(env: Constants, after: Rows) -> np.ndarray:
    low, high = env._contact_force_range
    return np.clip(after.cfrc_ext, low, high)


def _ant_v4(env: Constants, before: Rows, after: Rows, actions: np.ndarray) -> Outcome:
    healthy = _healthy_ant(env, after)
    rewards = _ant_x_velocity(env, before, after, env.body("torso")) + _healthy_reward_v4(env, healthy)
    costs = _control_cost(env, actions)
    parts = [_positions(env, after, 2), after.qvel]
    if env._use_contact_forces:
        forces = _contact_forces(env, after)
        costs = costs + env._contact_cost_weight * sum_of_squares(forces)
        parts.append(forces.reshape(len(forces), -1))
    return np.concatenate(parts, axis=1), rewards - costs, _unhealthy(env, healthy)


def _ant_v5(env: Constants, before: Rows, after: Rows, actions: np.ndarray) -> Outcome:
    healthy = _healthy_ant(env, after)
    x_velocity = _ant_x_velocity(env, before, after, env.body(env._main_body))
    rewards = x_velocity * env._forward_reward_weight + _healthy_reward_v5(env, healthy)
    costs = _control_cost(env, actions)
    parts = [_positions(env, after, 2), after.qvel]
    if hasattr(after, "cfrc_ext"):
        forces = _contact_forces(env, after)
        costs = costs + env._contact_cost_weight * sum_of_squares(forces)
        if env._include_cfrc_ext_in_observation:
            parts.append(forces[:, 1:].reshape(len(forces), -1))
    return np.concatenate(parts, axis=1), rewards - costs, _unhealthy(env, healthy)


_ANT = (
    "_ctrl_cost_weight",
    "_contact_cost_weight",
    "_contact_force_range",
    "_healthy_reward",
    "_terminate_when_unhealthy",
    "_healthy_z_range",
    _EXCLUDE,
)
_ANT_V4 = (*_ANT, "_use_contact_forces")
_ANT_V5 = (*_ANT, "_forward_reward_weight", "_main_body", "_include_cfrc_ext_in_observation")
register_family(ant_v4.AntEnv, Family(_ANT_V4, _ant_fields_v4, _ant_v4))
register_family(ant_v5.AntEnv, Family(_ANT_V5, _ant_fields_v5, _ant_v5))


# Humanoids -----------------------------------------------------------------------------------

_BODY_FIELDS = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")
_INCLUDES = tuple(f"_include_{name}_in_observation" for name in _BODY_FIELDS)


def _mass_centers(env: Constants, rows: Rows) -> np.ndarray:
    # One einsum over [bodies, rows x 3] adds the bodies in the order of the environment's einsum.
    by_body = rows.xipos.transpose(1, 0, 2).reshape(env.model.nbody, -1)
    centers = np.einsum("b,bk->k", env.model.body_mass, by_body).reshape(-1, 3)
    result: np.ndarray = centers / env.model.body_mass.sum()
    return result


def _flat(field: np.ndarray) -> np.ndarray:
    return field.reshape(len(field), -1)


def _body_observation_v4(after: Rows) -> list[np.ndarray]:
    return [_flat(getattr(after, name)) for name in _BODY_FIELDS]


def _included_v5(env: Constants) -> tuple[str, ...]:
    # "is True" as in the environment, where any other true value leaves the field out.
    names = zip(_BODY_FIELDS, _INCLUDES, strict=True)
    return tuple(field for field, include in names if getattr(env, include) is True)


def _body_observation_v5(env: Constants, after: Rows) -> list[np.ndarray]:
    skipped = {"qfrc_actuator": 6}
    return [_flat(getattr(after, name)[:, skipped.get(name, 1) :]) for name in _included_v5(env)]


def _humanoid_fields_v4(env: Constants) -> Fields:
    return Fields(before=("xipos",), after=("qpos", "qvel", "ctrl", "xipos", *_BODY_FIELDS))


def _humanoid_fields_v5(env: Constants) -> Fields:
    contact = ("cfrc_ext",) if env._contact_cost_weight != 0 else ()
    names = ("qpos", "qvel", "ctrl", "xipos", *_included_v5(env), *contact)
    return Fields(before=("xipos",), after=tuple(dict.fromkeys(names)))


def _impact(after: Rows, weight: float, cost_range: tuple[float, float]) -> np.ndarray:
    # Without a weight the forces are not simulated, but the range may still make it cost something.
    forces = sum_of_squares(after.cfrc_ext) if hasattr(after, "cfrc_ext") else np.zeros(len(after.qpos))
    return np.clip(weight * forces, *cost_range)


def _humanoid_progress(env: Constants, before: Rows, after: Rows) -> np.ndarray:
    x_velocity = (_mass_centers(env, after)[:, 0] - _mass_centers(env, before)[:, 0]) / env.dt
    progress: np.ndarray = env._forward_reward_weight * x_velocity
    return progress


def _healthy_humanoid(env: Constants, after: Rows) -> np.ndarray:
    low, high = env._healthy_z_range
    healthy: np.ndarray = (low < after.qpos[:, 2]) & (after.qpos[:, 2] < high)
    return healthy


def _humanoid_v4(env: Constants, before: Rows, after: Rows, actions: np.ndarray) -> Outcome:
    healthy = _healthy_humanoid(env, after)
    rewards = _humanoid_progress(env, before, after) + _healthy_reward_v4(env, healthy)
    parts = [_positions(env, after, 2), after.qvel, *_body_observation_v4(after)]
    return np.concatenate(parts, axis=1), rewards - _control_cost(env, after.ctrl), _unhealthy(env, healthy)


def _humanoid_v5(env: Constants, before: Rows, after: Rows, actions: np.ndarray) -> Outcome:
    healthy = _healthy_humanoid(env, after)
    rewards = _humanoid_progress(env, before, after) + _healthy_reward_v5(env, healthy)
    contact_cost = _impact(after, env._contact_cost_weight, env._contact_cost_range)
    costs = _control_cost(env, after.ctrl) + contact_cost
    parts = [_positions(env, after, 2), after.qvel, *_body_observation_v5(env, after)]
    return np.concatenate(parts, axis=1), rewards - costs, _unhealthy(env, healthy)


def _standup_fields_v4(env: Constants) -> Fields:
    return Fields(before=(), after=("qpos", "qvel", "ctrl", *_BODY_FIELDS))


def _standup_fields_v5(env: Constants) -> Fields:
    contact = ("cfrc_ext",) if env._impact_cost_weight != 0 else ()
    names = ("qpos", "qvel", "ctrl", *_included_v5(env), *contact)
    return Fields(before=(), after=tuple(dict.fromkeys(names)))


def _standup_v4(env: Constants, before: Rows, after: Rows, actions: np.ndarray) -> Outcome:
    uph_cost = (after.qpos[:, 2] - 0) / env.model.opt.timestep
    impact_cost = 0.5e-6 * sum_of_squares(after.cfrc_ext)
    impact_cost = np.where(impact_cost > 10, 10, impact_cost)
    reward = uph_cost - 0.1 * sum_of_squares(after.ctrl) - impact_cost + 1
    parts = [after.qpos[:, 2:], after.qvel, *_body_observation_v4(after)]
    return np.concatenate(parts, axis=1), reward, no_termination(len(actions))


def _standup_v5(env: Constants, before: Rows, after: Rows, actions: np.ndarray) -> Outcome:
    uph_cost = (after.qpos[:, 2] - 0) / env.model.opt.timestep
    impact_cost = _impact(after, env._impact_cost_weight, env._impact_cost_range)
    reward = uph_cost - _control_cost(env, after.ctrl) - impact_cost + 1
    parts = [_positions(env, after, 2), after.qvel, *_body_observation_v5(env, after)]
    return np.concatenate(parts, axis=1), reward, no_termination(len(actions))


register_family(humanoid_v4.HumanoidEnv, Family(_UPRIGHT, _humanoid_fields_v4, _humanoid_v4))
_HUMANOID = (*_UPRIGHT, "_contact_cost_weight", "_contact_cost_range", *_INCLUDES)
register_family(humanoid_v5.HumanoidEnv, Family(_HUMANOID, _humanoid_fields_v5, _humanoid_v5))
register_family(humanoidstandup_v4.HumanoidStandupEnv, Family((), _standup_fields_v4, _standup_v4))
_STANDUP = ("_ctrl_cost_weight", "_impact_cost_weight", "_impact_cost_range", _EXCLUDE, *_INCLUDES)
register_family(humanoidstandup_v5.HumanoidStandupEnv, Family(_STANDUP, _standup_fields_v5, _standup_v5))
