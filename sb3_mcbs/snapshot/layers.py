"""The layers of an environment: its wrappers, outermost first, and the environment itself."""

import inspect
from typing import Any, NamedTuple

import gymnasium as gym
from gymnasium import spaces

from sb3_mcbs.snapshot.object_graph import class_name
from sb3_mcbs.snapshot.stand_ins import MONITOR, StandIn, left_out_class, set_by

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

#: Monitor's file and the time since it was made belong to one instance.
OF_ONE_MONITOR = frozenset({"results_writer", "t_start"})

# Gymnasium's environments draw everything anew whenever they draw.
_DRAWN = frozenset({"screen", "surf", "window", "window_surface"})
_GYMNASIUM = tuple(f"gymnasium.envs.{part}." for part in ("classic_control", "box2d", "toy_text"))

# RL Zoo puts its class in place of Gymnasium's when it is imported; their state is the same.
_SAME_CLASS = {"rl_zoo3.gym_patches.PatchedTimeLimit": "gymnasium.wrappers.common.TimeLimit"}


class Layer(NamedTuple):
    """One layer.

    :param env: the wrapper or the environment.
    :param cls: its class, or that of the wrapper in whose place it is.
    :param name: of its class; equal for classes whose states can be exchanged.
    :param left_out: whether it only monitors, draws or records: in a copy a stand-in takes its place, and a
        snapshot holds what others have set on it.
    :param monitor: whether it is SB3's ``Monitor``; what that itself remembers is captured on request.
    :param own: names of the attributes that such a layer itself sets, besides its stand-in's.
    :param not_state: names of attributes that are not captured, these and the next included.
    :param drawn: names of attributes for what an environment of Gymnasium draws on; there is none in a copy.
    """

    env: Any
    cls: type
    name: str
    left_out: bool
    monitor: bool
    own: frozenset[str]
    not_state: frozenset[str]
    drawn: frozenset[str] = frozenset()


def layers_of(env: Any) -> list[Layer]:
    """Return the layers of an environment, outermost first.

    :param env: the environment with its wrappers.
    """
    layers: list[Layer] = []
    while isinstance(env, gym.Wrapper):
        layers.append(_layer(env))
        env = env.env
    cls = type(env)
    own = any(base.__module__.startswith(_GYMNASIUM) for base in cls.__mro__)
    drawn = _DRAWN if own else frozenset()
    return [*layers, Layer(env, cls, class_name(cls), False, False, frozenset(), NOT_STATE | drawn, drawn)]


def _layer(env: Any) -> Layer:
    cls = type(env).stands_for if isinstance(env, StandIn) else type(env)
    name = class_name(cls)
    name = _SAME_CLASS.get(name, name)
    known = left_out_class(cls)
    if known is None:
        return Layer(env, cls, name, False, False, frozenset(), _WRAPPER_NOT_STATE)
    monitors = class_name(known) == MONITOR and not isinstance(env, StandIn)
    own = set_by(known)
    return Layer(env, cls, name, True, monitors, own, _WRAPPER_NOT_STATE | own)


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
