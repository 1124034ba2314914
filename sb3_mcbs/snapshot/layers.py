"""The layers of an environment: its wrappers, outermost first, and the environment itself."""

import inspect
from typing import Any, NamedTuple

import gymnasium as gym

from sb3_mcbs.snapshot.errors import SnapshotUnsupportedError
from sb3_mcbs.snapshot.generators import restore_np_random
from sb3_mcbs.snapshot.handlers import plan_adapter, stays
from sb3_mcbs.snapshot.object_graph import ATOMIC_CLASSES, MISSING, Capture, Ref, Restore, class_name
from sb3_mcbs.snapshot.objects import attributes_of, set_attributes
from sb3_mcbs.snapshot.registry import SnapshotAdapter, find_adapter
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
    :param cls: its class; of a stand-in, the class of the wrapper that it replaces.
    :param name: of its class; equal for classes whose states can be exchanged.
    :param left_out: whether it only monitors, draws or records. A clone has a stand-in instead, and a
        snapshot holds what others have set on it.
    :param monitor: whether it is SB3's ``Monitor``; what that itself remembers is captured on request.
    :param own: names of the attributes that a left-out layer sets itself; its stand-in has none of them.
    :param not_state: names of attributes that are not captured, ``own`` and ``drawn`` included.
    :param drawn: names of the attributes that an environment of Gymnasium draws on; None in a clone.
    :param adapter: what captures its simulator, if an adapter is registered for it.
    """

    env: Any
    cls: type
    name: str
    left_out: bool
    monitor: bool
    own: frozenset[str]
    not_state: frozenset[str]
    drawn: frozenset[str]
    adapter: SnapshotAdapter | None


class CapturedLayer(NamedTuple):
    """The captured state of one layer.

    :param name: its class.
    :param left_out: whether it may be missing where the state is put back, with nothing in its place.
    :param adapted: what the layer's adapter captured, in a tuple; None if it has no adapter.
    :param attributes: the captured value of each captured attribute; None if none are captured.
    :param own: the same of what only a ``Monitor`` itself sets; None if that was left out.
    :param cls: the layer's captured class, which has state of its own if it was made for this layer.
    """

    name: str
    left_out: bool
    adapted: tuple[Any] | None
    attributes: dict[str, Any] | None
    own: dict[str, Any] | None
    cls: Any


def layers_of(env: Any) -> list[Layer]:
    """Return the layers of an environment, outermost first.

    :param env: the environment with its wrappers.
    """
    layers: list[Layer] = []
    while isinstance(env, gym.Wrapper):
        layers.append(_layer(env))
        env = env.env
    own = any(base.__module__.startswith(_GYMNASIUM) for base in type(env).__mro__)
    return [*layers, _layer(env, NOT_STATE, _DRAWN if own else frozenset())]


def _layer(
    env: Any, not_state: frozenset[str] = _WRAPPER_NOT_STATE, drawn: frozenset[str] = frozenset()
) -> Layer:
    cls = type(env).stands_for if isinstance(env, StandIn) else type(env)
    name = class_name(cls)
    name = _SAME_CLASS.get(name, name)
    known = left_out_class(cls) if isinstance(env, gym.Wrapper) else None
    if known is not None:
        monitors = class_name(known) == MONITOR and not isinstance(env, StandIn)
        own = set_by(known)
        return Layer(env, cls, name, True, monitors, own, not_state | own, drawn, None)
    adapter = find_adapter(env)
    its = frozenset() if adapter is None else adapter.not_state
    return Layer(env, cls, name, False, False, frozenset(), not_state | drawn | its, drawn, adapter)


def capture_layer(capture: Capture, layer: Layer, monitor: bool) -> CapturedLayer:
    """Capture the state of a layer.

    :param capture: what captures it.
    :param layer: the layer.
    :param monitor: whether what a ``Monitor`` holds is captured.
    :raises SnapshotUnsupportedError: names what cannot be captured.
    """
    env, adapter = layer.env, layer.adapter
    adapted = None if adapter is None else (adapter.capture(env),)
    attributes = own = cls = None
    if adapter is None or adapter.with_attributes:
        attributes = capture_attributes(capture, env, layer.not_state, adapter is not None)
    if layer.monitor and monitor:
        own = capture_attributes(capture, env, _all_but_remembered(layer), False)
    if adapter is None:
        cls = capture(layer.cls)
    return CapturedLayer(
        layer.name, layer.left_out, adapted, attributes, own, cls if type(cls) is Ref else None
    )


def restore_layer(restore: Restore, layer: Layer, saved: CapturedLayer) -> None:
    """Plan to put back the state of a layer.

    :param restore: keeps the plan.
    :param layer: the layer.
    :param saved: its captured state.
    """
    if saved.adapted is not None:
        plan_adapter(restore, layer.adapter, layer.env, saved.adapted[0])
    restore(saved.cls, layer.cls)
    if saved.attributes is not None:
        restore_attributes(restore, layer.env, layer.not_state, saved.attributes, layer.adapter is None)
    if saved.own is not None and layer.monitor:
        restore_attributes(restore, layer.env, _all_but_remembered(layer), saved.own, False)


def _all_but_remembered(layer: Layer) -> frozenset[str]:
    """Name the attributes of a ``Monitor`` that others have set, and those that belong to one instance."""
    return frozenset(attributes_of(layer.env)) - layer.own | OF_ONE_MONITOR


def capture_attributes(
    capture: Capture, env: Any, not_state: frozenset[str], skip_unsupported: bool
) -> dict[str, Any]:
    """Capture the attributes of a layer.

    :param capture: what captures them.
    :param env: the wrapper or environment.
    :param not_state: names of attributes to leave out.
    :param skip_unsupported: leave out what cannot be captured instead of raising an error.
    :return: the captured value of each.
    :raises SnapshotUnsupportedError: names the attribute.
    """
    attributes = {}
    for name, value in attributes_of(env).items():
        if name in not_state:
            continue
        if type(value) in ATOMIC_CLASSES:
            attributes[name] = value
        elif skip_unsupported:
            captured = capture.attempt(value)
            if captured is not None:
                attributes[name] = captured[0]
        else:
            attributes[name] = _capture_attribute(capture, env, name, value)
    return attributes


def _capture_attribute(capture: Capture, env: Any, name: str, value: Any) -> Any:
    try:
        return capture(value)
    except SnapshotUnsupportedError as error:
        error.path.insert(0, f"{type(env).__name__}.{name}")
        raise
    except RecursionError as error:
        too_deep = SnapshotUnsupportedError("objects in it hold each other too many levels deep")
        too_deep.path.append(f"{type(env).__name__}.{name}")
        raise too_deep from error


def _restore_attribute(restore: Restore, env: Any, name: str, value: Any, current: Any = MISSING) -> Any:
    try:
        return restore(value, current)
    except SnapshotUnsupportedError as error:
        error.path.insert(0, f"{type(env).__name__}.{name}")
        raise


def restore_attributes(
    restore: Restore, env: Any, not_state: frozenset[str], attributes: dict[str, Any], delete_others: bool
) -> None:
    """Plan to put back the attributes of a layer.

    :param restore: keeps the plan.
    :param env: the wrapper or environment.
    :param not_state: names of attributes that are left alone.
    :param attributes: captured attributes.
    :param delete_others: whether attributes that were not there are deleted.
    """
    have = attributes_of(env)
    values = dict(attributes)
    for name, value in attributes.items():
        if value is None:
            there = have.get(name)
            if there is not None and stays(there):  # such as a window that was opened since
                del values[name]
        elif type(value) is Ref and name != "_np_random":
            values[name] = _restore_attribute(restore, env, name, value, have.get(name, MISSING))
            if values[name] is MISSING:
                del values[name]
    # Gymnasium keeps it on the class until it is first needed.
    values.pop("_np_random", None)
    if not isinstance(env, gym.Wrapper):
        restore_np_random(restore, attributes.get("_np_random"), vars(env))
    gone = set()
    if delete_others:
        for name in have.keys() - attributes.keys():
            if name not in not_state and not _stays(name, have[name]):
                gone.add(name)
    restore.do_then(set_attributes, env, values, gone)


def _stays(name: str, value: Any) -> bool:
    return name == "_np_random" or stays(value)


def capture_for_clone(capture: Capture, layer: Layer) -> dict[str, Any]:
    """Capture the attributes that a layer's clone is to have.

    :param capture: of the clone.
    :param layer: of the original.
    :return: the captured value of each.
    :raises SnapshotUnsupportedError: names the attribute.
    """
    attributes: dict[str, Any] = {}
    for name, value in attributes_of(layer.env).items():
        if name in layer.own:
            continue
        if name == "render_mode" or name in layer.drawn:
            attributes[name] = None
        elif name == "_ezpickle_kwargs" and "render_mode" in value:
            attributes[name] = {**value, "render_mode": None}
        elif name in layer.not_state or type(value) in ATOMIC_CLASSES:
            attributes[name] = value
        else:
            attributes[name] = _capture_attribute(capture, layer.env, name, value)
    return attributes


def restore_into_clone(restore: Restore, made: Any, attributes: dict[str, Any]) -> None:
    """Give a layer's clone its attributes.

    :param restore: of the clone.
    :param made: the clone of the layer, which has no attributes yet.
    :param attributes: of :func:`capture_for_clone`.
    """
    values = {
        name: _restore_attribute(restore, made, name, value) if type(value) is Ref else value
        for name, value in attributes.items()
    }
    set_attributes(made, values)


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
