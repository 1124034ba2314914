"""MuJoCo's model and data within any environment."""

from collections.abc import Sequence
from typing import Any

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
    :param names: names of bodies; none: the first body that can move.
    :return: their numbers.
    :raises ValueError: if there is no body of a name.
    """
    if not names:
        moving = np.flatnonzero(model.body_weldid)
        return moving[:1].tolist()
    known = [model.body(number).name for number in range(1, model.nbody)]
    for name in names:
        if name not in known:
            raise ValueError(
                f"The model has no body {name!r}. Its bodies are {', '.join(filter(None, known))}."
            )
    return [model.body(name).id for name in names]


def body_positions(env: SnapshotEnvWrapper, bodies: Sequence[int]) -> np.ndarray:
    """Read where bodies are.

    :param env: an environment with MuJoCo.
    :param bodies: their numbers.
    :return: ``[bodies, 3]``.
    """
    data = mujoco_data(env)
    assert data is not None, "not simulated with MuJoCo"
    return data.xpos[list(bodies)].copy()
