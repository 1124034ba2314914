"""The layers of an environment: its wrappers, outermost first, and the environment itself."""

import inspect
from typing import Any, NamedTuple

import gymnasium as gym
from gymnasium import spaces

from sb3_mcbs.snapshot.graph import class_name

#: Attributes of a layer that say how it was made or how it is drawn.
NOT_STATE = frozenset(
    {
        "spec",
        "_cached_spec",
        "metadata",
        "_metadata",
        "_saved_kwargs",
        "_ezpickle_args",
        "_ezpickle_kwargs",
        "render_mode",
    }
)

# A wrapper's ``env`` is the layer below. An environment may hold its simulator under this name.
_WRAPPER_NOT_STATE = NOT_STATE | {"env"}

_MONITOR = "stable_baselines3.common.monitor.Monitor"
# Monitor's file and the time since it was made belong to one instance.
_MONITOR_NOT_STATE = _WRAPPER_NOT_STATE | {"results_writer", "t_start"}

_RECORDERS = frozenset(
    {
        "gymnasium.wrappers.rendering.RecordVideo",
        "gymnasium.wrappers.rendering.RenderCollection",
        "gymnasium.wrappers.rendering.HumanRendering",
        "sb3_mcbs.snapshot.wrapper.SnapshotEnvWrapper",
    }
)

# RL Zoo puts its class in place of Gymnasium's when it is imported; their state is the same.
_SAME_CLASS = {"rl_zoo3.gym_patches.PatchedTimeLimit": "gymnasium.wrappers.common.TimeLimit"}


class Layer(NamedTuple):
    """One layer.

    :param env: the wrapper or the environment.
    :param name: its class; equal for classes whose states can be exchanged.
    :param recorder: whether it only draws or records: it has no state of ours and a copy is made without it.
    :param monitor: whether it is SB3's ``Monitor``: it has state, and a copy is made without it.
    :param not_state: names of attributes that are not captured.
    """

    env: Any
    name: str
    recorder: bool
    monitor: bool
    not_state: frozenset[str]


def layers_of(env: Any) -> list[Layer]:
    """Return the layers of an environment, outermost first.

    :param env: the environment with its wrappers.
    """
    layers: list[Layer] = []
    while True:
        names = [class_name(cls) for cls in type(env).__mro__]
        recorder, monitor = not _RECORDERS.isdisjoint(names), _MONITOR in names
        name = _SAME_CLASS.get(names[0], names[0])
        if not isinstance(env, gym.Wrapper):
            return [*layers, Layer(env, name, recorder, monitor, NOT_STATE)]
        not_state = _MONITOR_NOT_STATE if monitor else _WRAPPER_NOT_STATE
        layers.append(Layer(env, name, recorder, monitor, not_state))
        env = env.env


def describe_space(space: Any) -> str:
    """Describe the shape of a space: observations of equal descriptions are interchangeable.

    :param space: the space.
    """
    if isinstance(space, spaces.Dict):
        return "{" + ", ".join(f"{key}: {describe_space(inner)}" for key, inner in space.spaces.items()) + "}"
    if isinstance(space, spaces.Tuple):
        return "(" + ", ".join(describe_space(inner) for inner in space.spaces) + ")"
    shape = getattr(space, "shape", None)
    size = f"({space.n})" if isinstance(space, spaces.Discrete) else f"{shape} {getattr(space, 'dtype', '')}"
    return f"{type(space).__name__}{size}"


#: The attribute that an environment has whose ``reset`` and ``step`` are recorded for a replay.
RECORDER = "_snapshot_recorder"


def replaced_method(layer: Any) -> str | None:
    """Return the name of a method that was replaced on an instance, if one was.

    :param layer: the wrapper or the environment.
    """
    ours = {"reset", "step"} if RECORDER in vars(layer) else ()
    for name in vars(layer):
        if name not in ours and inspect.isroutine(inspect.getattr_static(type(layer), name, None)):
            return name
    return None
