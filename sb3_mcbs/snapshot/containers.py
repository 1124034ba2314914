"""Lists, tuples, sets, deques and dictionaries."""

import operator
from collections import deque
from typing import Any

from sb3_mcbs.snapshot.errors import SnapshotUnsupportedError
from sb3_mcbs.snapshot.object_graph import ATOMIC_CLASSES, MISSING, Copier, Freezer, Ref, Thawer


class SequenceHandler:
    """Lists, tuples, sets and deques."""

    name = "sequence"

    def freeze(self, freezer: Freezer, obj: Any) -> Any:
        return type(obj), getattr(obj, "maxlen", None), freeze_items(freezer, obj)

    def thaw(self, thawer: Thawer, index: int, payload: Any, current: Any) -> Any:
        cls, maxlen, items = payload
        have = current if type(current) in (list, tuple, deque) else ()
        n_have = len(have)
        thawed = (
            thawer.thaw(item, have[place] if place < n_have else MISSING) if type(item) is Ref else item
            for place, item in enumerate(items)
        )
        if cls is tuple or cls is frozenset:
            parts = list(thawed)
            stays = thawer.is_original(index, current) and all(map(operator.is_, current, parts))
            return current if stays else cls(parts)
        if thawer.is_original(index, current):
            thawer.memo[index] = current
            thawer.do_then(_refill, current, list(thawed))
            return current
        made: Any = deque(maxlen=maxlen) if cls is deque else cls()
        thawer.memo[index] = made
        if cls is set:
            return _kept_or_filled(thawer, index, made, list(thawed), current)
        made.extend(thawed)
        return made

    def copy(self, copier: Copier, obj: Any) -> Any:
        cls = type(obj)
        if cls is tuple or cls is frozenset:
            return cls([copier.copy(item) for item in obj])
        made: Any = copier.enter(obj, deque(maxlen=obj.maxlen) if cls is deque else cls())
        (made.update if cls is set else made.extend)([copier.copy(item) for item in obj])
        return made


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


def _kept_or_filled(thawer: Thawer, index: int, made: set[Any], items: list[Any], current: Any) -> set[Any]:
    """Fill a set, or keep the one that is there if only that lists the items in the captured order.

    The order depends on what a set held before, which nobody can read.
    """
    made.update(items)
    if type(current) is not set or len(current) != len(made) or all(map(operator.is_, made, items)):
        return made
    if all(map(_is_same, current, items)) and thawer.claim(current):
        made = thawer.memo[index] = current
    return made


def _is_same(one: Any, other: Any) -> bool:
    if type(one) is not type(other):
        return False
    if type(one) is tuple:
        return len(one) == len(other) and all(map(_is_same, one, other))
    return type(one) in _EQUAL_IS_SAME and bool(one == other)


def freeze_items(freezer: Freezer, items: Any) -> tuple[Any, ...]:
    """Freeze the items of a container.

    :param freezer: what freezes them.
    :param items: a container with a length.
    """
    if ATOMIC_CLASSES.issuperset(map(type, items)):
        return tuple(items)
    frozen = []
    for place, item in enumerate(items):
        try:
            frozen.append(freezer.freeze(item))
        except SnapshotUnsupportedError as error:
            error.path.insert(0, f"[{place}]")
            raise
    return tuple(frozen)


class DictHandler:
    """Dictionaries."""

    name = "dict"

    def freeze(self, freezer: Freezer, obj: dict[Any, Any]) -> Any:
        frozen = []
        for key, value in obj.items():
            try:
                frozen.append((freezer.freeze(key), freezer.freeze(value)))
            except SnapshotUnsupportedError as error:
                error.path.insert(0, f"[{key!r}]")
                raise
        return tuple(frozen)

    def thaw(self, thawer: Thawer, index: int, payload: Any, current: Any) -> Any:
        made: dict[Any, Any] = {}
        stays = thawer.is_original(index, current)
        thawer.memo[index] = current if stays else made
        have = current if type(current) is dict else {}
        for key, value in payload:
            thawed_key = thawer.thaw(key)
            thawed = thawer.thaw(value, have.get(thawed_key, MISSING))
            if thawed is not MISSING:
                made[thawed_key] = thawed
        if stays:
            thawer.do_then(refill_dict, current, made)
            return current
        return made

    def copy(self, copier: Copier, obj: dict[Any, Any]) -> Any:
        made = copier.enter(obj, {})
        for key, value in obj.items():
            made[copier.copy(key)] = copier.copy(value)
        return made
