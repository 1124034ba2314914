"""Objects of Python and of compiled classes."""

import contextlib
import copyreg
import ctypes
import functools
import gc
import io
import types
from collections import Counter, OrderedDict, defaultdict
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from sb3_mcbs.snapshot.containers import TupleHandler, capture_items, refill_dict
from sb3_mcbs.snapshot.errors import SnapshotError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.object_graph import (
    ATOMIC_CLASSES,
    MISSING,
    Capture,
    Ref,
    Restore,
    cannot_be_made,
    class_name,
)


class ObjectHandler:
    """Objects of ordinary Python classes: their attributes are their state."""

    name = "object"

    def capture(self, capture: Capture, obj: Any) -> Any:
        return capture(type(obj)), capture_content(capture, obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        cls, attributes = payload
        cls = restore(cls, MISSING if current is MISSING else type(current))
        made_anew = _is_value(cls) and not restore.is_original(index, current)
        if made_anew or type(current) is not cls or not restore.claim(current):
            have = attributes_of(current) if type(current) is cls else {}
            return _made_anew(restore, index, cls, attributes, have)
        restore.memo[index] = current
        restore_content(restore, attributes, current)
        return current


Attributes = tuple[tuple[str, Any], ...]


def capture_content(capture: Capture, obj: Any, leave_out: frozenset[str] = frozenset()) -> Attributes:
    """Capture the attributes of an object.

    :param capture: what captures them.
    :param obj: the object.
    :param leave_out: names of attributes that are not state.
    :return: names and captured values.
    """
    return tuple(
        [
            (name, value if type(value) in ATOMIC_CLASSES else capture.part(value, ".{}", name))
            for name, value in attributes_of(obj).items()
            if name not in leave_out
        ]
    )


def restore_content(
    restore: Restore, attributes: Attributes, obj: Any, leave_out: frozenset[str] = frozenset()
) -> None:
    """Plan to put back the attributes of an object that is there.

    :param restore: keeps the plan.
    :param attributes: names and captured values.
    :param obj: the object.
    :param leave_out: names of attributes that stay as they are.
    """
    have = attributes_of(obj)
    values = {}
    for name, value in attributes:
        restored = restore(value, have.get(name, MISSING))
        if restored is not MISSING:
            values[name] = restored
    gone = set(have).difference(leave_out, [name for name, _ in attributes])
    restore.do_then(_set_changed if restore.in_place else set_attributes, obj, values, gone)


def _set_changed(obj: Any, values: dict[str, Any], gone: Iterable[str]) -> None:
    """Set only the attributes that changed: some classes do not let theirs be set."""
    have = attributes_of(obj)
    set_attributes(
        obj, {name: value for name, value in values.items() if have.get(name, MISSING) is not value}, gone
    )


def blank(cls: type) -> Any:
    """Make an object without calling its constructor.

    :param cls: its class.
    """
    try:
        return object.__new__(cls)
    except TypeError:  # some compiled classes, such as SimpleNamespace, want their own
        made: Any = cls
        return made.__new__(cls)


def _is_value(cls: type) -> bool:
    """Return whether objects of a class are hashed by what they hold.

    Sets and dictionaries look them up by their hash. So they have to be complete from the start, and existing
    ones must not be changed.
    """
    return cls.__hash__ is not None and cls.__hash__ is not object.__hash__


def _made_anew(restore: Restore, index: int, cls: type, attributes: Any, have: dict[str, Any]) -> Any:
    """Make an object and set its attributes at once.

    Those that its hash is computed from come first: the others may lead to a set that holds the object.
    """
    made: Any = blank(cls)
    restore.memo[index] = made
    put = _setter(made)
    values = {}
    for name, value in sorted(attributes, key=lambda item: not _is_hashed(restore, item[1])):
        restored = restore(value, have.get(name, MISSING))
        if restored is not MISSING:
            values[name] = restored
            put(name, restored)
    _set_in_order(made, {name: values[name] for name, _ in attributes if name in values})
    return made


def _is_hashed(restore: Restore, value: Any) -> bool:
    """Return whether an attribute holds what hashes are computed from: a constant, or a tuple of some."""
    return type(value) is not Ref or restore.nodes[value.index][0] == TupleHandler.name


def _setter(obj: Any) -> Callable[[str, Any], None]:
    """Return what sets one attribute of an object that is being made."""
    if _slots_of(type(obj)):
        return lambda name, value: set_attributes(obj, {name: value})
    return attributes_of(obj).__setitem__


def _set_in_order(obj: Any, values: dict[str, Any]) -> None:
    """Set attributes again, in the order in which they are to be listed."""
    if type(obj).__dictoffset__:
        obj.__dict__.clear()
    set_attributes(obj, values)


def attributes_of(obj: Any) -> dict[str, Any]:
    """Return the attributes of an object, those in slots included. Not to be altered.

    :param obj: an object of an ordinary Python class, a layer included.
    """
    slots = _slots_of(type(obj))
    if not slots and type(obj).__dictoffset__:
        return obj.__dict__
    # Objects that pass on what they do not have would be asked for it by getattr().
    attributes = dict(obj.__dict__) if type(obj).__dictoffset__ else {}
    for name in slots:
        with contextlib.suppress(AttributeError):
            attributes[name] = object.__getattribute__(obj, name)
    return attributes


def _slots_of(cls: type) -> list[str]:
    # This is where Python keeps them once it has found them.
    slots = cls.__dict__.get("__slotnames__")
    return copyreg._slotnames(cls) if slots is None else slots  # type: ignore[attr-defined]


def set_attributes(obj: Any, values: dict[str, Any], gone: Iterable[str] = ()) -> None:
    """Set attributes directly, past any ``__setattr__``.

    :param obj: the object.
    :param values: what to set.
    :param gone: names of attributes to delete.
    """
    for name in gone:
        object.__delattr__(obj, name)
    own = obj.__dict__ if type(obj).__dictoffset__ else None
    slots = _slots_of(type(obj))
    if own is not None and not slots:
        own.update(values)
        return
    for name, value in values.items():
        if name in slots:
            object.__setattr__(obj, name, value)
        else:
            own[name] = value  # type: ignore[index]


class ReducedHandler:
    """Objects of compiled classes that say themselves what they are made of, as for pickling."""

    name = "reduced"

    def capture(self, capture: Capture, obj: Any) -> Any:
        function, arguments, state, items, pairs = _reduce(obj)
        return (
            capture(function),
            capture(arguments),
            capture(state),
            capture_items(capture, items),
            tuple((capture(key), capture(value)) for key, value in pairs),
            class_name(type(obj)),
        )

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        in_place = restore.in_place
        # Others may read at once what they are made of, before that is as it was.
        restore.in_place = in_place and isinstance(current, _ONLY_REFER)
        try:
            made = self._make(restore, index, payload, current)
        except SnapshotError:
            raise
        except Exception as error:
            raise cannot_be_made(payload[-1], error) from error
        restore.in_place = in_place
        if restore.is_original(index, current) and type(current) in _DICTIONARIES:
            restore.do_then(refill_dict, current, made)
            return current
        return made

    def _make(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        function, arguments, state, items, pairs, cls = payload
        # What is at its place says what is at the places inside.
        have = _reduced_or_nothing(current) if class_name(type(current)) == cls else _NOTHING_THERE
        make = restore(function, have.function)
        made = restore.memo[index] = make(*restore(arguments, have.arguments))
        content = [
            restore(item, have.items[place] if place < len(have.items) else MISSING)
            for place, item in enumerate(items)
        ]
        pairs_there = dict(have.pairs)
        filled = []
        for key, value in pairs:
            restored_key = restore(key)
            filled.append((restored_key, restore(value, pairs_there.get(restored_key, MISSING))))
        return _fill(made, restore(state, have.state), content, filled)


class Reduced(NamedTuple):
    """An object taken apart: what makes it, and what it is given then."""

    function: Any
    arguments: Any
    state: Any
    items: list[Any]
    pairs: list[Any]


_DICTIONARIES = (OrderedDict, defaultdict, Counter)
_ONLY_REFER = (*_DICTIONARIES, functools.partial, types.MappingProxyType)
_NOTHING_THERE = Reduced(MISSING, MISSING, MISSING, [], [])


#: As ``copyreg.dispatch_table`` has them for pickling.
_REDUCERS: dict[type, Callable[[Any], Any]] = {
    types.MappingProxyType: lambda proxy: (types.MappingProxyType, (gc.get_referents(proxy)[0],))
}


def _reduced_or_nothing(obj: Any) -> Reduced:
    try:
        return _reduce(obj)
    except SnapshotUnsupportedError:
        return _NOTHING_THERE


def _reduce(obj: Any) -> Reduced:
    """Take an object apart as pickle would."""
    if isinstance(obj, ctypes._SimpleCData | ctypes._Pointer | ctypes._CFuncPtr | ctypes.CDLL):  # type: ignore[attr-defined]
        raise SnapshotUnsupportedError(f"a {class_name(type(obj))} is a handle into compiled code")
    if hasattr(type(obj), "fileno") and not isinstance(obj, io.BytesIO | io.StringIO):
        raise SnapshotUnsupportedError(f"a {class_name(type(obj))} is an open file, socket or pipe")
    try:
        reducer = _REDUCERS.get(type(obj)) or copyreg.dispatch_table.get(type(obj))
        reduced = reducer(obj) if reducer else obj.__reduce_ex__(4)
    except Exception as error:
        raise SnapshotUnsupportedError(f"its class is {class_name(type(obj))} and {error}") from error
    if isinstance(reduced, str):
        raise SnapshotUnsupportedError(f"its class is {class_name(type(obj))} and it is a global, {reduced}")
    function, arguments, state, items, pairs = (*reduced, None, None, None)[:5]
    return Reduced(function, arguments, state, list(items or ()), list(pairs or ()))


def _fill(made: Any, state: Any, items: list[Any], pairs: list[Any]) -> Any:
    """Give an object that was made from its reduced form its content, in the order in which pickle does."""
    if items:
        (made.extend if hasattr(made, "extend") else lambda given: [made.append(item) for item in given])(
            items
        )
    for key, value in pairs:
        made[key] = value
    if state is made:
        # A dictionary whose items are its attributes.
        made.__dict__ = made
    elif state is not None and hasattr(made, "__setstate__"):
        made.__setstate__(state)
    elif state is not None:
        in_dict, in_slots = state if isinstance(state, tuple) and len(state) == 2 else (state, None)
        vars(made).update(in_dict or {})
        for name, value in (in_slots or {}).items():
            setattr(made, name, value)
    return made


def is_global(obj: Any) -> bool:
    """Return whether an object of a compiled class is a global of some module, such as a compiled function.

    :param obj: the object.
    """
    try:
        return isinstance(obj.__reduce_ex__(4), str)
    except Exception:
        return False


def is_ordinary(cls: type) -> bool:
    """Return whether all of an object's state is in attributes: no compiled part, no open handle."""
    if hasattr(cls, "fileno") or issubclass(cls, ctypes.CDLL):
        return False
    # An object of a compiled class, or of a class derived from one, is larger than its attributes need.
    pointer = ctypes.sizeof(ctypes.c_void_p)
    places = len(_slots_of(cls))
    places += (cls.__dictoffset__ > 0) + (cls.__weakrefoffset__ > 0)
    return cls.__itemsize__ == 0 and cls.__basicsize__ <= object.__basicsize__ + places * pointer
