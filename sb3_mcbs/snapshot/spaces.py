"""Spaces: their definitions, as plain values that can be compared and made into a space again."""

import operator
from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_mcbs.snapshot.generators import restore_np_random
from sb3_mcbs.snapshot.identity import ByIdentity
from sb3_mcbs.snapshot.object_graph import ATOMIC_CLASSES, Capture, Restore

#: A space's class, and its attributes without its generator. Spaces in it are definitions themselves.
_Definition = tuple[type, tuple[tuple[str, Any], ...]]

_GENERATOR = "_np_random"
#: Bounds of this many bytes at most are compared each time, in case somebody edits them in place.
_SMALL = 1024


def _parts_of(space: spaces.Space) -> list[spaces.Space]:
    """Return a space and the spaces in it."""
    parts = [space]
    for inner in _inner(space):
        parts += _parts_of(inner)
    return parts


def _inner(space: spaces.Space) -> list[spaces.Space]:
    """Return the spaces right within a space."""
    if isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiBinary):
        return []
    found = []
    for value in vars(space).values():
        items = value.values() if isinstance(value, dict) else value
        for item in items if isinstance(value, dict | list | tuple) else [value]:
            if isinstance(item, spaces.Space):
                found.append(item)
    return found


class _Known:
    """A space whose definition was made, and what shows that it has not changed since."""

    def __init__(self, space: spaces.Space, definition: _Definition) -> None:
        self.definition = definition
        self._values = _without_generator(space)
        self._bounds = [value for value in self._values if _is_small(value)]
        self._contents = [bounds.tobytes() for bounds in self._bounds]
        self._inner = [(inner, _definition_of(inner)) for inner in _inner(space)]

    def holds(self, space: spaces.Space) -> bool:
        """Return whether the definition is still that of the space."""
        values = _without_generator(space)
        if len(values) != len(self._values) or not all(map(operator.is_, values, self._values)):
            return False
        if self._contents != [bounds.tobytes() for bounds in self._bounds]:
            return False
        inner = _inner(space)
        if not (inner or self._inner):
            return True
        return len(inner) == len(self._inner) and all(
            one is other and _definition_of(one) is definition
            for one, (other, definition) in zip(inner, self._inner, strict=True)
        )


_cached: ByIdentity[_Known] = ByIdentity()


def _without_generator(space: spaces.Space) -> list[Any]:
    return [value for name, value in vars(space).items() if name != _GENERATOR]


def _is_small(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.nbytes <= _SMALL and value.dtype != bool


def _definition_of(space: spaces.Space) -> _Definition:
    """Say what a space contains: the same object as before, as long as nobody changed the space."""
    known = _cached.get(space)
    if known is not None and known.holds(space):
        return known.definition
    attributes = tuple((name, _plain(value)) for name, value in vars(space).items() if name != _GENERATOR)
    definition = (type(space), attributes)
    return _cached.put(space, _Known(space, definition)).definition


def _plain(value: Any) -> Any:
    """Return a value that never changes, for one that a space holds."""
    if isinstance(value, spaces.Space):
        return ("space", _definition_of(value))
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


def _is_defined_as(space: spaces.Space, definition: _Definition) -> bool:
    """Return whether a space contains what a definition says."""
    own = _definition_of(space)
    if own is definition:
        return True
    if not _equal(own, definition):
        return False
    known = _cached.get(space)
    assert known is not None
    known.definition = definition  # the next comparison sees that they are the same
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


def _made_of(definition: _Definition) -> Any:
    """Make a space, without a generator yet."""
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
        return _made_of(content)
    if form == "array":
        return content.copy()
    if form == "dict":
        return {key: _made(item) for key, item in content}
    if form == "other":
        return None
    return _CONTAINERS[form](_made(item) for item in content)


class SpaceHandler:
    """Spaces: what they contain is state, as environments may exchange them, and so are their generators.

    A space that is still the same stays where it is: others hold it, too.
    """

    name = "space"

    def capture(self, capture: Capture, obj: spaces.Space) -> Any:
        parts = _parts_of(obj)
        return _definition_of(obj), tuple(capture(part._np_random) for part in parts)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        definition, generators_of_parts = payload
        if not isinstance(current, spaces.Space) or not _is_defined_as(current, definition):
            current = _made_of(definition)
        parts = _parts_of(current)
        for part, value in zip(parts, generators_of_parts, strict=True):
            restore_np_random(restore, value, vars(part))
        return current


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


def values_of(observation: Any) -> Iterator[np.ndarray]:
    """Go through the arrays that an observation consists of; those of spaces in spaces, too.

    :param observation: an array, a plain value, or dicts, tuples and lists of them.
    """
    if isinstance(observation, dict):
        observation = tuple(observation.values())
    if isinstance(observation, tuple | list):
        for part in observation:
            yield from values_of(part)
    else:
        yield np.asarray(observation)


def random_action(space: Any, rng: np.random.Generator) -> np.ndarray:
    """Draw a uniform action, or one in [-1, 1] where the space has no bounds.

    :param space: a ``Box``.
    :param rng: where it is drawn from.
    """
    low = np.where(np.isfinite(space.low), space.low, -1.0)
    high = np.where(np.isfinite(space.high), space.high, 1.0)
    return np.asarray(rng.uniform(low, high)).astype(space.dtype)
