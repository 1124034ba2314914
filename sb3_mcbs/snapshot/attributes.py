"""The attributes of one layer: captured and put back."""

from typing import Any

import gymnasium as gym

from sb3_mcbs.snapshot.drawing import stays
from sb3_mcbs.snapshot.errors import SnapshotUnsupportedError
from sb3_mcbs.snapshot.handlers import handler_of
from sb3_mcbs.snapshot.object_graph import ATOMIC_CLASSES, MISSING, Capture, Ref, Restore
from sb3_mcbs.snapshot.objects import attributes_of, set_attributes
from sb3_mcbs.snapshot.randomness import restore_np_random


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
            attributes[name] = capture_attribute(capture, env, name, value)
    return attributes


def capture_attribute(capture: Capture, env: Any, name: str, value: Any) -> Any:
    """Capture one attribute of a layer.

    :param capture: what captures it.
    :param env: the wrapper or environment.
    :param name: of the attribute.
    :param value: of the attribute.
    :raises SnapshotUnsupportedError: names the attribute.
    """
    try:
        return capture(value)
    except SnapshotUnsupportedError as error:
        error.path.insert(0, f"{type(env).__name__}.{name}")
        raise
    except RecursionError as error:
        too_deep = SnapshotUnsupportedError("objects in it hold each other too many levels deep")
        too_deep.path.append(f"{type(env).__name__}.{name}")
        raise too_deep from error


def restore_attribute(restore: Restore, env: Any, name: str, value: Any, current: Any = MISSING) -> Any:
    """Plan to put back one attribute of a layer, and return its value.

    :param restore: keeps the plan.
    :param env: the wrapper or environment.
    :param name: of the attribute.
    :param value: its captured value.
    :param current: what the attribute is now.
    :raises SnapshotUnsupportedError: names the attribute.
    """
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
            if there is not None and stays(there, handler_of):  # such as a window that was opened since
                del values[name]
        elif type(value) is Ref and name != "_np_random":
            values[name] = restore_attribute(restore, env, name, value, have.get(name, MISSING))
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
    return name == "_np_random" or stays(value, handler_of)
