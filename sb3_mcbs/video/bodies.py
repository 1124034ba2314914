"""MuJoCo's model and data within any environment."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from sb3_mcbs.snapshot import SnapshotEnvWrapper, is_data, is_physics


def mujoco_data(env: SnapshotEnvWrapper) -> Any | None:
    """Find the simulator of an environment.

    :param env: the environment.
    :return: its ``MjData``, also that of dm_control; ``None`` if it has none.
    """
    for simulator in env.simulators:
        if is_data(simulator):
            return simulator
        if is_physics(simulator):
            return simulator.data.ptr
    return None


def find_bodies(model: Any, names: Sequence[str]) -> list[int]:
    """Find bodies by name.

    :param model: the ``MjModel``.
    :param names: names of bodies; none: the first one that can move, or the end of a fixed robot.
    :return: their numbers.
    :raises ValueError: if there is no body of a name.
    """
    if not names:
        return [_main_body(model)]
    known = [model.body(number).name for number in range(1, model.nbody)]
    for name in names:
        if name not in known:
            raise ValueError(
                f"The model has no body {name!r}. Its bodies are {', '.join(filter(None, known))}."
            )
    return [model.body(name).id for name in names]


def _main_body(model: Any) -> int:
    """The root of a robot that can go somewhere; the end of one that is fixed."""
    moving = np.flatnonzero(model.body_weldid).tolist()
    if not moving:
        return model.nbody - 1
    goes = (mujoco.mjtJoint.mjJNT_FREE.value, mujoco.mjtJoint.mjJNT_SLIDE.value)
    if any(model.jnt_bodyid[joint] == moving[0] for joint in np.flatnonzero(np.isin(model.jnt_type, goes))):
        return moving[0]
    depths = np.zeros(model.nbody, dtype=int)
    for body in moving:  # parents come before their children
        if model.body_rootid[body] == model.body_rootid[moving[0]]:
            depths[body] = depths[model.body_parentid[body]] + 1
    return int(depths.argmax())


def body_positions(env: SnapshotEnvWrapper, bodies: Sequence[int]) -> np.ndarray:
    """Read where bodies are.

    :param env: an environment with MuJoCo.
    :param bodies: their numbers.
    :return: ``[bodies, 3]``.
    """
    data = mujoco_data(env)
    assert data is not None, "not simulated with MuJoCo"
    return data.xpos[list(bodies)].copy()
