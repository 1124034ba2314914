"""The families of Gymnasium's small MuJoCo tasks: pendulums, Reacher and Pusher."""

import numpy as np
from gymnasium.envs.mujoco import (
    inverted_double_pendulum_v4,
    inverted_double_pendulum_v5,
    inverted_pendulum_v4,
    inverted_pendulum_v5,
    pusher_v5,
    reacher_v4,
    reacher_v5,
)

from sb3_mcbs.models.families import (
    Constants,
    Family,
    Fields,
    Outcome,
    Rows,
    no_termination,
    register_family,
    row_norms,
    scalar_power,
    sum_of_squares,
)


def _body(env: Constants, rows: Rows, name: str) -> np.ndarray:
    position: np.ndarray = rows.xpos[:, env.body(name)]
    return position


# Pendulums -----------------------------------------------------------------------------------


def _pendulum_fields(_env: Constants) -> Fields:
    return Fields(before=(), after=("qpos", "qvel"))


def _pendulum(after: Rows) -> tuple[np.ndarray, np.ndarray]:
    observation = np.concatenate((after.qpos, after.qvel), axis=1)
    return observation, ~np.isfinite(observation).all(axis=1) | (np.abs(observation[:, 1]) > 0.2)


def _pendulum_v4(env: Constants, before: Rows, after: Rows, actions: np.ndarray) -> Outcome:
    observation, terminated = _pendulum(after)
    return observation, np.ones(len(actions)), terminated


def _pendulum_v5(env: Constants, before: Rows, after: Rows, actions: np.ndarray) -> Outcome:
    observation, terminated = _pendulum(after)
    return observation, (~terminated).astype(np.float64), terminated


def _double_pendulum_fields(_env: Constants) -> Fields:
    return Fields(before=(), after=("qpos", "qvel", "site_xpos", "qfrc_constraint"))


def _double_pendulum(after: Rows, n_constraint_forces: int | None) -> tuple[np.ndarray, ...]:
    angles = np.ascontiguousarray(after.qpos[:, 1:])
    forces = np.clip(after.qfrc_constraint, -10, 10)[:, :n_constraint_forces]
    parts = (after.qpos[:, :1], np.sin(angles), np.cos(angles), np.clip(after.qvel, -10, 10), forces)
    x, y = after.site_xpos[:, 0, 0], after.site_xpos[:, 0, 2]
    dist_penalty = 0.01 * scalar_power(x, 2) + scalar_power(y - 2, 2)
    vel_penalty = 1e-3 * scalar_power(after.qvel[:, 1], 2) + 5e-3 * scalar_power(after.qvel[:, 2], 2)
    return np.concatenate(parts, axis=1), dist_penalty, vel_penalty, y <= 1


def _double_pendulum_v4(env: Constants, before: Rows, after: Rows, actions: np.ndarray) -> Outcome:
    observation, dist_penalty, vel_penalty, terminated = _double_pendulum(after, None)
    return observation, 10 - dist_penalty - vel_penalty, terminated


def _double_pendulum_v5(env: Constants, before: Rows, after: Rows, actions: np.ndarray) -> Outcome:
    observation, dist_penalty, vel_penalty, terminated = _double_pendulum(after, 1)
    alive_bonus = env._healthy_reward * (~terminated).astype(np.int64)
    return observation, alive_bonus - dist_penalty - vel_penalty, terminated


register_family(inverted_pendulum_v4.InvertedPendulumEnv, Family((), _pendulum_fields, _pendulum_v4))
register_family(inverted_pendulum_v5.InvertedPendulumEnv, Family((), _pendulum_fields, _pendulum_v5))
register_family(
    inverted_double_pendulum_v4.InvertedDoublePendulumEnv,
    Family((), _double_pendulum_fields, _double_pendulum_v4),
)
register_family(
    inverted_double_pendulum_v5.InvertedDoublePendulumEnv,
    Family(("_healthy_reward",), _double_pendulum_fields, _double_pendulum_v5),
)


# Reacher and Pusher --------------------------------------------------------------------------


def _to_target(env: Constants, rows: Rows) -> np.ndarray:
    return _body(env, rows, "fingertip") - _body(env, rows, "target")


def _reacher_observation(env: Constants, after: Rows, n_target: int) -> np.ndarray:
    theta = np.ascontiguousarray(after.qpos[:, :2])
    parts = (
        np.cos(theta),
        np.sin(theta),
        after.qpos[:, 2:],
        after.qvel[:, :2],
        _to_target(env, after)[:, :n_target],
    )
    return np.concatenate(parts, axis=1)


def _reacher_fields_v4(_env: Constants) -> Fields:
    return Fields(before=("xpos",), after=("qpos", "qvel", "xpos"))


def _reacher_v4(env: Constants, before: Rows, after: Rows, actions: np.ndarray) -> Outcome:
    # This version pays for the distance at which the step began.
    reward = -row_norms(_to_target(env, before)) + -sum_of_squares(actions)
    return _reacher_observation(env, after, 3), reward, no_termination(len(actions))


def _arm_fields_v5(_env: Constants) -> Fields:
    return Fields(before=(), after=("qpos", "qvel", "xpos"))


def _reacher_v5(env: Constants, before: Rows, after: Rows, actions: np.ndarray) -> Outcome:
    reward_dist = -row_norms(_to_target(env, after)) * env._reward_dist_weight
    reward = reward_dist + -sum_of_squares(actions) * env._reward_control_weight
    return _reacher_observation(env, after, 2), reward, no_termination(len(actions))


def _pusher_v5(env: Constants, before: Rows, after: Rows, actions: np.ndarray) -> Outcome:
    arm, pushed, goal = (_body(env, after, name) for name in ("tips_arm", "object", "goal"))
    reward_near = -row_norms(pushed - arm) * env._reward_near_weight
    reward_dist = -row_norms(pushed - goal) * env._reward_dist_weight
    reward_ctrl = -sum_of_squares(actions) * env._reward_control_weight
    observation = np.concatenate((after.qpos[:, :7], after.qvel[:, :7], arm, pushed, goal), axis=1)
    return observation, reward_dist + reward_ctrl + reward_near, no_termination(len(actions))


_WEIGHTS = ("_reward_dist_weight", "_reward_control_weight")
register_family(reacher_v4.ReacherEnv, Family((), _reacher_fields_v4, _reacher_v4))
register_family(reacher_v5.ReacherEnv, Family(_WEIGHTS, _arm_fields_v5, _reacher_v5))
register_family(pusher_v5.PusherEnv, Family((*_WEIGHTS, "_reward_near_weight"), _arm_fields_v5, _pusher_v5))
