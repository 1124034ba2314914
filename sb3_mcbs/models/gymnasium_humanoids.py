"""The families of Gymnasium's MuJoCo humanoids, versions 4 and 5."""

from functools import partial
from typing import Any

import numpy as np
from gymnasium.envs.mujoco import humanoid_v4, humanoid_v5, humanoidstandup_v4, humanoidstandup_v5

from sb3_mcbs.models.compiling import compiled
from sb3_mcbs.models.families import Constants, Family, register_family
from sb3_mcbs.models.gymnasium_families import upright_constants
from sb3_mcbs.models.row_arithmetic import put, sum_of_squares

_BODY_FIELDS = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")


def _body_constants(env: Any, version: int) -> Constants:
    """Which fields of the bodies an observation shows, and from which entry on."""
    # "is True" as in the environment, where any other true value leaves the field out.
    shows = {
        f"shows_{name}": version == 4 or getattr(env, f"_include_{name}_in_observation") is True
        for name in _BODY_FIELDS
    }
    return {**shows, "first_body": 0 if version == 4 else 1, "first_force": 0 if version == 4 else 6}


@compiled
def _put_bodies(env: Any, observation: np.ndarray, start: int, data: Any) -> None:
    if env.shows_cinert:
        start = put(observation, start, data.cinert[env.first_body :])
    if env.shows_cvel:
        start = put(observation, start, data.cvel[env.first_body :])
    if env.shows_qfrc_actuator:
        start = put(observation, start, data.qfrc_actuator[env.first_force :])
    if env.shows_cfrc_ext:
        put(observation, start, data.cfrc_ext[env.first_body :])


def _humanoid_constants(env: Any, version: int) -> Constants:
    low, high = (0.0, 0.0) if version == 4 else env._contact_cost_range
    return {
        **upright_constants(env, 2, version),
        **_body_constants(env, version),
        "contact_cost_weight": 0.0 if version == 4 else env._contact_cost_weight,
        "min_contact_cost": low,
        "max_contact_cost": high,
        "masses": env.model.body_mass.copy(),
        "mass": float(env.model.body_mass.sum()),
    }


def _keep_center(env: Any, data: Any, kept: np.ndarray) -> None:
    """The centre of mass along x, added up in the order of the environment's einsum."""
    total = 0.0
    for body in range(len(env.masses)):
        total += env.masses[body] * data.xipos[body, 0]
    kept[0] = total / env.mass


_center = compiled(_keep_center)


def _humanoid(env: Any, kept: np.ndarray, data: Any, action: np.ndarray, observation: np.ndarray) -> Any:
    now = np.empty(1)
    _center(env, data, now)
    x_velocity = (now[0] - kept[0]) / env.dt
    healthy = env.min_z < data.qpos[2] < env.max_z
    paid = env.healthy_reward * (1.0 if healthy or env.always_paid else 0.0)
    contact_cost = env.contact_cost_weight * sum_of_squares(data.cfrc_ext)
    contact_cost = min(max(contact_cost, env.min_contact_cost), env.max_contact_cost)
    costs = env.ctrl_cost_weight * sum_of_squares(data.ctrl) + contact_cost
    end = put(observation, 0, data.qpos[env.first_position :])
    end = put(observation, end, data.qvel)
    _put_bodies(env, observation, end, data)
    return env.forward_reward_weight * x_velocity + paid - costs, env.terminates and not healthy


def _standup_constants(env: Any, version: int) -> Constants:
    if version == 4:
        costs = {"ctrl_cost_weight": 0.1, "impact_cost_weight": 0.5e-6}
        low, high, first = 0.0, 10.0, 2
    else:
        costs = {"ctrl_cost_weight": env._ctrl_cost_weight, "impact_cost_weight": env._impact_cost_weight}
        low, high = env._impact_cost_range
        first = 2 if env._exclude_current_positions_from_observation else 0
    return {
        **_body_constants(env, version),
        **costs,
        "timestep": env.model.opt.timestep,
        "min_impact_cost": low,
        "max_impact_cost": high,
        "first_position": first,
    }


def _stand_up(env: Any, kept: np.ndarray, data: Any, action: np.ndarray, observation: np.ndarray) -> Any:
    up_cost = data.qpos[2] / env.timestep
    impact_cost = env.impact_cost_weight * sum_of_squares(data.cfrc_ext)
    impact_cost = min(max(impact_cost, env.min_impact_cost), env.max_impact_cost)
    end = put(observation, 0, data.qpos[env.first_position :])
    end = put(observation, end, data.qvel)
    _put_bodies(env, observation, end, data)
    return up_cost - env.ctrl_cost_weight * sum_of_squares(data.ctrl) - impact_cost + 1, False


_FIELDS = ("qpos", "qvel", "ctrl", *_BODY_FIELDS)
for _env_class, _version in ((humanoid_v4.HumanoidEnv, 4), (humanoid_v5.HumanoidEnv, 5)):
    _constants = partial(_humanoid_constants, version=_version)
    register_family(_env_class, Family(_constants, (*_FIELDS, "xipos"), _humanoid, _keep_center, n_kept=1))
for _standup_class, _version in (
    (humanoidstandup_v4.HumanoidStandupEnv, 4),
    (humanoidstandup_v5.HumanoidStandupEnv, 5),
):
    _constants = partial(_standup_constants, version=_version)
    register_family(_standup_class, Family(_constants, _FIELDS, _stand_up))
