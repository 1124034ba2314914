"""The families of Gymnasium's small MuJoCo tasks: pendulums, Reacher and Pusher."""

from functools import partial
from typing import Any

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

from sb3_mcbs.models.compiling import compiled
from sb3_mcbs.models.families import Constants, Family, register_family
from sb3_mcbs.models.row_arithmetic import (
    all_finite,
    norm,
    put,
    put_clipped,
    scalar_power,
    weighted_squares,
    widens,
)

# Pendulums -----------------------------------------------------------------------------------


def _pendulum_constants(_env: Any, version: int) -> Constants:
    return {"always_paid": version == 4}


def _pendulum(env: Any, kept: np.ndarray, data: Any, action: np.ndarray, observation: np.ndarray) -> Any:
    put(observation, put(observation, 0, data.qpos), data.qvel)
    terminated = not all_finite(observation) or abs(observation[1]) > 0.2
    return (1.0 if env.always_paid or not terminated else 0.0), terminated


def _double_pendulum_constants(env: Any, version: int) -> Constants:
    if version == 4:
        return {"alive_bonus": 10, "paid_at_the_end": True, "n_forces": env.model.nv}
    return {"alive_bonus": env._healthy_reward, "paid_at_the_end": False, "n_forces": 1}


def _double_pendulum(
    env: Any, kept: np.ndarray, data: Any, action: np.ndarray, observation: np.ndarray
) -> Any:
    angles, qvel = data.qpos[1:], data.qvel
    end = put(observation, 0, data.qpos[:1])
    end = put(observation, end, np.sin(angles))
    end = put(observation, end, np.cos(angles))
    end = put_clipped(observation, end, qvel, -10.0, 10.0)
    put_clipped(observation, end, data.qfrc_constraint[: env.n_forces], -10.0, 10.0)
    x, y = data.site_xpos[0, 0], data.site_xpos[0, 2]
    terminated = y <= 1
    dist_penalty = 0.01 * scalar_power(x, 2.0) + scalar_power(y - 2, 2.0)
    vel_penalty = 1e-3 * scalar_power(qvel[1], 2.0) + 5e-3 * scalar_power(qvel[2], 2.0)
    alive_bonus = env.alive_bonus * (1.0 if env.paid_at_the_end or not terminated else 0.0)
    return alive_bonus - dist_penalty - vel_penalty, terminated


_DOUBLE = ("qpos", "qvel", "site_xpos", "qfrc_constraint")
for _pendulum_class, _double_class, _version in (
    (inverted_pendulum_v4.InvertedPendulumEnv, inverted_double_pendulum_v4.InvertedDoublePendulumEnv, 4),
    (inverted_pendulum_v5.InvertedPendulumEnv, inverted_double_pendulum_v5.InvertedDoublePendulumEnv, 5),
):
    _constants = partial(_pendulum_constants, version=_version)
    register_family(_pendulum_class, Family(_constants, ("qpos", "qvel"), _pendulum))
    _constants = partial(_double_pendulum_constants, version=_version)
    register_family(_double_class, Family(_constants, _DOUBLE, _double_pendulum))


# Reacher and Pusher --------------------------------------------------------------------------


def _arm_constants(env: Any, bodies: tuple[str, ...], n_target: int) -> Constants:
    """The weights, where there are any, and the bodies' ids."""
    control = getattr(env, "_reward_control_weight", 1)
    return {
        "near_weight": getattr(env, "_reward_near_weight", 1),
        "dist_weight": getattr(env, "_reward_dist_weight", 1),
        "control_weight": control,
        "control_widens": widens(control),
        "n_target": n_target,
        **{name: int(env.model.body(name).id) for name in bodies},
    }


def _keep_distance(env: Any, data: Any, kept: np.ndarray) -> None:
    kept[0] = norm(data.xpos[env.fingertip] - data.xpos[env.target])


@compiled
def _observe_reacher(env: Any, data: Any, observation: np.ndarray) -> None:
    end = put(observation, 0, np.cos(data.qpos[:2]))
    end = put(observation, end, np.sin(data.qpos[:2]))
    end = put(observation, end, data.qpos[2:])
    end = put(observation, end, data.qvel[:2])
    put(observation, end, (data.xpos[env.fingertip] - data.xpos[env.target])[: env.n_target])


def _reacher_v4(env: Any, kept: np.ndarray, data: Any, action: np.ndarray, observation: np.ndarray) -> Any:
    _observe_reacher(env, data, observation)
    # This version pays for the distance at which the step began.
    return -kept[0] - weighted_squares(1, False, action), False


def _reacher_v5(env: Any, kept: np.ndarray, data: Any, action: np.ndarray, observation: np.ndarray) -> Any:
    _observe_reacher(env, data, observation)
    reward_dist = -norm(data.xpos[env.fingertip] - data.xpos[env.target]) * env.dist_weight
    return reward_dist - weighted_squares(env.control_weight, env.control_widens, action), False


def _pusher_v5(env: Any, kept: np.ndarray, data: Any, action: np.ndarray, observation: np.ndarray) -> Any:
    arm, pushed, goal = data.xpos[env.tips_arm], data.xpos[env.object], data.xpos[env.goal]
    reward_near = -norm(pushed - arm) * env.near_weight
    reward_dist = -norm(pushed - goal) * env.dist_weight
    reward_ctrl = -weighted_squares(env.control_weight, env.control_widens, action)
    end = put(observation, 0, data.qpos[:7])
    end = put(observation, end, data.qvel[:7])
    end = put(observation, end, arm)
    end = put(observation, end, pushed)
    put(observation, end, goal)
    return reward_dist + reward_ctrl + reward_near, False


_ARM = ("qpos", "qvel", "xpos")
_REACHER = ("fingertip", "target")
register_family(
    reacher_v4.ReacherEnv,
    Family(partial(_arm_constants, bodies=_REACHER, n_target=3), _ARM, _reacher_v4, _keep_distance, n_kept=1),
)
register_family(
    reacher_v5.ReacherEnv, Family(partial(_arm_constants, bodies=_REACHER, n_target=2), _ARM, _reacher_v5)
)
register_family(
    pusher_v5.PusherEnv,
    Family(partial(_arm_constants, bodies=("tips_arm", "object", "goal"), n_target=3), _ARM, _pusher_v5),
)
