"""Objects of Python and of compiled classes."""

import copyreg
import ctypes
from typing import Any

from sb3_mcbs.snapshot.containers import freeze_items
from sb3_mcbs.snapshot.errors import SnapshotUnsupportedError
from sb3_mcbs.snapshot.graph import MISSING, Copier, Freezer, Thawer, class_name


class ObjectKind:
    """Objects of ordinary Python classes: their attributes are their state."""

    name = "object"

    def freeze(self, freezer: Freezer, obj: Any) -> Any:
        attributes = []
        for name, value in attributes_of(obj).items():
            try:
                attributes.append((name, freezer.freeze(value)))
            except SnapshotUnsupportedError as error:
                error.path.insert(0, f".{name}")
                raise
        return type(obj), tuple(attributes)

    def thaw(self, thawer: Thawer, index: int, payload: Any, current: Any) -> Any:
        cls, attributes = payload
        reused = type(current) is cls and thawer.claim(current)
        made = thawer.memo[index] = current if reused else object.__new__(cls)
        have = attributes_of(made)
        values = {}
        for name, value in attributes:
            thawed = thawer.thaw(value, have.get(name, MISSING))
            if thawed is not MISSING:
                values[name] = thawed
        thawer.do_then(set_attributes, made, values, set(have).difference(name for name, _ in attributes))
        return made

    def copy(self, copier: Copier, obj: Any) -> Any:
        made = copier.enter(obj, object.__new__(type(obj)))
        set_attributes(made, {name: copier.copy(value) for name, value in attributes_of(obj).items()}, set())
        return made


def attributes_of(obj: Any) -> dict[str, Any]:
    """Return the attributes of an object, those in slots included.

    :param obj: an object of an ordinary Python class.
    """
    attributes = dict(getattr(obj, "__dict__", ()))
    for name in copyreg._slotnames(type(obj)):  # type: ignore[attr-defined]
        value = getattr(obj, name, MISSING)
        if value is not MISSING:
            attributes[name] = value
    return attributes


def set_attributes(obj: Any, values: dict[str, Any], gone: set[str]) -> None:
    """Set attributes directly, past any ``__setattr__``.

    :param obj: the object.
    :param values: what to set.
    :param gone: names of attributes to delete.
    """
    for name in gone:
        object.__delattr__(obj, name)
    own = getattr(obj, "__dict__", None)
    slots = copyreg._slotnames(type(obj))  # type: ignore[attr-defined]
    if own is not None and not slots:
        own.update(values)
        return
    for name, value in values.items():
        if name in slots:
            object.__setattr__(obj, name, value)
        else:
            own[name] = value  # type: ignore[index]


class ReducedKind:
    """Objects of compiled classes that say themselves what they are made of, as for pickling."""

    name = "reduced"

    def freeze(self, freezer: Freezer, obj: Any) -> Any:
        function, arguments, state, items, pairs = _reduce(obj)
        return (
            freezer.freeze(function),
            freezer.freeze(arguments),
            freezer.freeze(state),
            freeze_items(freezer, items),
            tuple((freezer.freeze(key), freezer.freeze(value)) for key, value in pairs),
        )

    def thaw(self, thawer: Thawer, index: int, payload: Any, current: Any) -> Any:
        function, arguments, state, items, pairs = payload
        made = thawer.memo[index] = thawer.thaw(function)(*thawer.thaw(arguments))
        content = [thawer.thaw(item) for item in items]
        return _fill(made, thawer.thaw(state), content, [(thawer.thaw(k), thawer.thaw(v)) for k, v in pairs])

    def copy(self, copier: Copier, obj: Any) -> Any:
        function, arguments, state, items, pairs = _reduce(obj)
        made = copier.enter(obj, function(*copier.copy(arguments)))
        content = [copier.copy(item) for item in items]
        return _fill(made, copier.copy(state), content, [(copier.copy(k), copier.copy(v)) for k, v in pairs])


def _reduce(obj: Any) -> tuple[Any, tuple[Any, ...], Any, list[Any], list[Any]]:
    """Take an object apart as pickle would."""
    if isinstance(obj, ctypes._SimpleCData | ctypes._Pointer | ctypes._CFuncPtr | ctypes.CDLL):  # type: ignore[attr-defined]
        raise SnapshotUnsupportedError(f"a {class_name(type(obj))} is a handle into compiled code")
    if hasattr(type(obj), "fileno"):
        raise SnapshotUnsupportedError(f"a {class_name(type(obj))} is an open file, socket or pipe")
    try:
        reducer = copyreg.dispatch_table.get(type(obj))
        reduced = reducer(obj) if reducer else obj.__reduce_ex__(4)
    except Exception as error:
        raise SnapshotUnsupportedError(f"its class is {class_name(type(obj))} and {error}") from error
    if isinstance(reduced, str):
        raise SnapshotUnsupportedError(f"its class is {class_name(type(obj))} and it is a global, {reduced}")
    function, arguments, state, items, pairs = (*reduced, None, None, None)[:5]
    return function, arguments, state, list(items or ()), list(pairs or ())


def _fill(made: Any, state: Any, items: list[Any], pairs: list[Any]) -> Any:
    """Give an object that was made from its reduced form its content, as pickle would."""
    if state is not None and hasattr(made, "__setstate__"):
        made.__setstate__(state)
    elif state is not None:
        in_dict, in_slots = state if isinstance(state, tuple) and len(state) == 2 else (state, None)
        vars(made).update(in_dict or {})
        for name, value in (in_slots or {}).items():
            setattr(made, name, value)
    if items:
        (made.extend if hasattr(made, "extend") else lambda given: [made.append(item) for item in given])(
            items
        )
    for key, value in pairs:
        made[key] = value
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
    places = len(copyreg._slotnames(cls))  # type: ignore[attr-defined]
    places += (cls.__dictoffset__ > 0) + (cls.__weakrefoffset__ > 0)
    return cls.__itemsize__ == 0 and cls.__basicsize__ <= object.__basicsize__ + places * pointer
