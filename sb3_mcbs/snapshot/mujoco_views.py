"""Views into MuJoCo's models and data: arrays, ``model.opt``, ``data.body("torso")``."""

import operator
import re
import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_mcbs.snapshot.identity import ByIdentity

# What a model or its data hand out as objects of their own, and those of them that hold arrays.
_PARTS = ("opt", "stat", "vis", "contact", "warning", "timer", "solver")
_WITH_ARRAYS = ("opt", "stat", "warning", "timer", "solver")

_PART = "part"
# What owns the memory of MuJoCo's arrays.
_OWNER = "PyCapsule"

#: Finding the place of an array means to compare it with hundreds of others.
_known: ByIdentity[tuple[Any, tuple[Any, ...]]] = ByIdentity()
_fields: dict[type, tuple[list[str], list[str]]] = {}


def public(cls: type) -> tuple[str, ...]:
    """Name the public members of a class.

    :param cls: the class.
    """
    return tuple(name for name in dir(cls) if not name.startswith("_"))


def address(array: np.ndarray) -> int:
    """Return where the memory of an array begins.

    :param array: the array.
    """
    return int(array.__array_interface__["data"][0])


def place_of(obj: Any, view: Any) -> tuple[Any, ...] | None:
    """Say where in a model or in data a view lies; None if it is no view into that.

    Arrays that lie elsewhere after each step, such as those of constraints, have no place.

    :param obj: an ``MjModel`` or an ``MjData``.
    :param view: an array, or another object that one hands out.
    """
    if not isinstance(view, np.ndarray):
        return _place_of_part(obj, view)
    known = _known.get(view)
    if known is not None:
        return known[1] if known[0]() is obj else None
    place = _find(obj, view, _arrays(obj)[0]) if _is_of_mujoco(view) else None
    if place is not None:
        _known.put(view, (weakref.ref(obj), place))
    return place


def view_at(obj: Any, place: tuple[Any, ...]) -> Any:
    """Return the view that lies at a place.

    :param obj: an ``MjModel`` or an ``MjData``.
    :param place: what :func:`place_of` returned, for this or for another one.
    """
    path, *where = place
    if path == _PART:
        part = getattr(obj, where[0])
        return part(where[1]) if len(where) > 1 else part
    field = operator.attrgetter(path)(obj)
    if not where:
        return field
    offset, shape, dtype, strides, writeable = where
    view = np.ndarray(shape, dtype, field.reshape(-1).view(np.uint8), offset, strides)
    view.setflags(write=writeable)
    return view


def counterpart(obj: Any, new: Any, view: Any) -> Any:
    """Return what a view is in a copy that was just made; None if it is no view into the original.

    :param obj: the original.
    :param new: the copy.
    :param view: an array, or another object that the original hands out.
    """
    place = place_of(obj, view)
    if place is None and isinstance(view, np.ndarray):
        place = _find(obj, view, _arrays(obj)[1])
    return None if place is None else view_at(new, place)


def _is_of_mujoco(view: np.ndarray) -> bool:
    base: Any = view.base
    while isinstance(base, np.ndarray):
        base = base.base
    return type(base).__name__ == _OWNER


def _arrays(obj: Any) -> tuple[list[str], list[str]]:
    """Name the arrays that stay where they are for as long as an object lives, and the others."""
    if type(obj) not in _fields:
        paths = [*public(type(obj))]
        for part in _WITH_ARRAYS:
            held = getattr(obj, part, None)
            paths += [] if held is None else [f"{part}.{name}" for name in public(type(held))]
        reads = {path: operator.attrgetter(path) for path in paths}
        arrays = [path for path, read in reads.items() if isinstance(read(obj), np.ndarray)]
        staying = [path for path in arrays if reads[path](obj) is reads[path](obj)]
        _fields[type(obj)] = staying, [path for path in arrays if path not in staying]
    return _fields[type(obj)]


def _find(obj: Any, view: np.ndarray, paths: Sequence[str]) -> tuple[Any, ...] | None:
    for path in paths:
        field = operator.attrgetter(path)(obj)
        if view is field:
            return (path,)
        # The numbers of warnings and timers lie between other numbers.
        if field.flags.c_contiguous and np.shares_memory(field, view):
            offset = address(view) - address(field)
            return path, offset, view.shape, view.dtype, view.strides, view.flags.writeable
    return None


def _place_of_part(obj: Any, part: Any) -> tuple[Any, ...] | None:
    accessor = re.fullmatch(r"_Mj(Data|Model)(\w+)Views", type(part).__name__)
    if accessor is not None:
        name = accessor[2].lower()
        found = getattr(obj, name, None)
        return (_PART, name, part.id) if found is not None and found(part.id) is part else None
    return next(((_PART, name) for name in _PARTS if getattr(obj, name, None) is part), None)
