"""Spaces: what one contains, as plain values that can be compared and made a space again."""

import operator
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_mcbs.snapshot.graph import ATOMIC_CLASSES

#: A space's class, and its attributes without its generator. Spaces in it are definitions themselves.
Definition = tuple[type, tuple[tuple[str, Any], ...]]

_GENERATOR = "_np_random"
#: Bounds of this many bytes at most are compared each time, in case somebody edits them in place.
_SMALL = 1024

_cached: dict[int, tuple[Any, list[Any], bytes, Definition]] = {}


def parts_of(space: spaces.Space) -> list[spaces.Space]:
    """Return a space and the spaces in it.

    :param space: the space.
    """
    if isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiBinary):
        return [space]
    parts = [space]
    for value in vars(space).values():
        inner = value.values() if isinstance(value, dict) else value
        for item in inner if isinstance(inner, list | tuple | type({}.values())) else [value]:
            if isinstance(item, spaces.Space):
                parts.extend(parts_of(item))
    return parts


def definition_of(space: spaces.Space) -> Definition:
    """Say what a space contains.

    :param space: the space.
    :return: the same object as before, as long as nobody changed the space.
    """
    own = {name: value for name, value in vars(space).items() if name != _GENERATOR}
    values = list(own.values())
    content = b"".join(_content(values))
    known = _cached.get(id(space))
    if known is not None and known[0]() is space and known[2] == content and _are_same(known[1], values):
        return known[3]
    definition = (
        type(space),
        tuple((name, _plain(value)) for name, value in own.items() if name != _GENERATOR),
    )
    if len(parts_of(space)) == 1:  # others change when a part of them does
        key = id(space)
        forget = weakref.ref(space, lambda _: _cached.pop(key, None))
        _cached[key] = (forget, values, content, definition)
    return definition


def _content(values: list[Any]) -> Iterator[bytes]:
    for value in values:
        if isinstance(value, np.ndarray) and value.nbytes <= _SMALL:
            yield value.tobytes()


def _are_same(left: list[Any], right: list[Any]) -> bool:
    return len(left) == len(right) and all(map(operator.is_, left, right))


def _plain(value: Any) -> Any:
    """Return a value that never changes, for one that a space holds."""
    if isinstance(value, spaces.Space):
        return ("space", definition_of(value))
    if isinstance(value, np.ndarray):
        return ("array", value.copy())
    if isinstance(value, dict):
        return ("dict", tuple((key, _plain(item)) for key, item in value.items()))
    if isinstance(value, list | tuple | frozenset | set):
        items = sorted(value, key=repr) if isinstance(value, frozenset | set) else value
        return (type(value).__name__, tuple(_plain(item) for item in items))
    if type(value) in ATOMIC_CLASSES or isinstance(value, np.dtype | np.generic | type):
        return value
    return ("other", None)  # such as a function: whatever is there


def is_defined_as(space: spaces.Space, definition: Definition) -> bool:
    """Return whether a space contains what a definition says.

    :param space: the space.
    :param definition: what :func:`definition_of` returned.
    """
    own = definition_of(space)
    if own is definition:
        return True
    if not _equal(own, definition):
        return False
    known = _cached.get(id(space))
    if known is not None:  # the next comparison sees that they are the same
        _cached[id(space)] = (*known[:3], definition)
    return True


def _equal(left: Any, right: Any) -> bool:
    if left is right:
        return True
    if type(left) is tuple and type(right) is tuple:
        return len(left) == len(right) and all(
            _equal(one, other) for one, other in zip(left, right, strict=True)
        )
    if isinstance(left, np.ndarray):
        return (
            isinstance(right, np.ndarray) and left.dtype == right.dtype and np.array_equal(left, right, True)
        )
    return type(left) is type(right) and bool(left == right)


_CONTAINERS = {"list": list, "tuple": tuple, "set": set, "frozenset": frozenset}


def made_of(definition: Definition) -> Any:
    """Make a space, without a generator yet.

    :param definition: what :func:`definition_of` returned.
    """
    cls, attributes = definition
    space: Any = object.__new__(cls)
    vars(space).update({name: _made(value) for name, value in attributes})
    vars(space)[_GENERATOR] = None
    return space


def _made(value: Any) -> Any:
    if type(value) is not tuple:
        return value
    form, content = value
    if form == "space":
        return made_of(content)
    if form == "array":
        return content.copy()
    if form == "dict":
        return {key: _made(item) for key, item in content}
    if form == "other":
        return None
    return _CONTAINERS[form](_made(item) for item in content)


def random_action(space: Any, rng: np.random.Generator) -> np.ndarray:
    """Draw a uniform action, or one in [-1, 1] where the space has no bounds.

    :param space: a ``Box``.
    :param rng: where it is drawn from.
    """
    low = np.where(np.isfinite(space.low), space.low, -1.0)
    high = np.where(np.isfinite(space.high), space.high, 1.0)
    return np.asarray(rng.uniform(low, high)).astype(space.dtype)
