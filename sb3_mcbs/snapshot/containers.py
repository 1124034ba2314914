"""Lists, tuples, sets, deques and dictionaries."""

import operator
from collections import deque
from typing import Any

from sb3_mcbs.snapshot.errors import SnapshotUnsupportedError
from sb3_mcbs.snapshot.object_graph import ATOMIC_CLASSES, MISSING, Capture, Ref, Restore


class TupleHandler:
    """Tuples and frozen sets."""

    name = "tuple"

    def capture(self, capture: Capture, obj: Any) -> Any:
        return type(obj), capture_items(capture, obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        cls, items = payload
        parts = _restore_items(restore, items, current)
        stays = restore.is_original(index, current) and all(map(operator.is_, current, parts))
        return current if stays else cls(parts)


class SequenceHandler:
    """Lists, sets and deques."""

    name = "sequence"

    def capture(self, capture: Capture, obj: Any) -> Any:
        return type(obj), getattr(obj, "maxlen", None), capture_items(capture, obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        cls, maxlen, items = payload
        if restore.is_original(index, current):
            restore.memo[index] = current
            restore.do_then(_refill, current, _restore_items(restore, items, current))
            return current
        made: Any = deque(maxlen=maxlen) if cls is deque else cls()
        restore.memo[index] = made
        if cls is set:
            return _kept_or_filled(restore, index, made, _restore_items(restore, items, current), current)
        made.extend(_restore_items(restore, items, current))
        return made


def _restore_items(restore: Restore, items: tuple[Any, ...], current: Any) -> list[Any]:
    have = current if type(current) in (list, tuple, deque) else ()
    n_have = len(have)
    return [
        restore(item, have[place] if place < n_have else MISSING) if type(item) is Ref else item
        for place, item in enumerate(items)
    ]


def _refill(container: Any, items: list[Any]) -> None:
    """Have a list, deque or set hold other items; one that holds them already keeps their order."""
    if len(container) != len(items) or not all(map(operator.is_, container, items)):
        container.clear()
        (container.update if isinstance(container, set) else container.extend)(items)


def refill_dict(current: dict[Any, Any], items: dict[Any, Any]) -> None:
    """Have a dictionary hold other items.

    :param current: the dictionary.
    :param items: what it shall hold.
    """
    current.clear()
    current.update(items)


# Equal objects of these are the same, bit for bit.
_EQUAL_IS_SAME = frozenset({type(None), bool, int, str, bytes})


def _kept_or_filled(restore: Restore, index: int, made: set[Any], items: list[Any], current: Any) -> set[Any]:
    """Fill a set, or keep the one that is there if only that lists the items in the captured order.

    The order depends on what a set held before, which nobody can read.
    """
    made.update(items)
    if type(current) is not set or len(current) != len(made) or all(map(operator.is_, made, items)):
        return made
    if all(map(_is_same, current, items)) and restore.claim(current):
        made = restore.memo[index] = current
    return made


def _is_same(one: Any, other: Any) -> bool:
    if type(one) is not type(other):
        return False
    if type(one) is tuple:
        return len(one) == len(other) and all(map(_is_same, one, other))
    return type(one) in _EQUAL_IS_SAME and bool(one == other)


def capture_items(capture: Capture, items: Any) -> tuple[Any, ...]:
    """Capture the items of a container.

    :param capture: what captures them.
    :param items: a container with a length.
    """
    if ATOMIC_CLASSES.issuperset(map(type, items)):
        return tuple(items)
    captured: list[Any] = []
    try:
        for item in items:
            captured.append(capture(item))
    except SnapshotUnsupportedError as error:
        error.path.insert(0, f"[{len(captured)}]")
        raise
    return tuple(captured)


class DictHandler:
    """Dictionaries."""

    name = "dict"

    def capture(self, capture: Capture, obj: dict[Any, Any]) -> Any:
        captured: list[Any] = []
        key = None
        try:
            for key, value in obj.items():
                captured.append((capture(key), capture(value)))
        except SnapshotUnsupportedError as error:
            error.path.insert(0, f"[{key!r}]")
            raise
        return tuple(captured)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        made: dict[Any, Any] = {}
        stays = restore.is_original(index, current)
        restore.memo[index] = current if stays else made
        have = current if type(current) is dict else {}
        for key, value in payload:
            restored_key = restore(key)
            restored = restore(value, have.get(restored_key, MISSING))
            if restored is not MISSING:
                made[restored_key] = restored
        if stays:
            restore.do_then(refill_dict, current, made)
            return current
        return made
