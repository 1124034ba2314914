"""Lists, tuples, sets, deques and dictionaries."""

from collections import deque
from typing import Any

from sb3_mcbs.snapshot.errors import SnapshotUnsupportedError
from sb3_mcbs.snapshot.graph import ATOMIC_CLASSES, MISSING, Copier, Freezer, Ref, Thawer


class SequenceKind:
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
            return cls(thawed)
        made: Any = deque(maxlen=maxlen) if cls is deque else cls()
        thawer.memo[index] = made
        (made.update if cls is set else made.extend)(thawed)
        return made

    def copy(self, copier: Copier, obj: Any) -> Any:
        cls = type(obj)
        if cls is tuple or cls is frozenset:
            return cls([copier.copy(item) for item in obj])
        made: Any = copier.enter(obj, deque(maxlen=obj.maxlen) if cls is deque else cls())
        (made.update if cls is set else made.extend)([copier.copy(item) for item in obj])
        return made


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


class DictKind:
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
        thawer.memo[index] = made
        have = current if type(current) is dict else {}
        for key, value in payload:
            thawed_key = thawer.thaw(key)
            thawed = thawer.thaw(value, have.get(thawed_key, MISSING))
            if thawed is not MISSING:
                made[thawed_key] = thawed
        return made

    def copy(self, copier: Copier, obj: dict[Any, Any]) -> Any:
        made = copier.enter(obj, {})
        for key, value in obj.items():
            made[copier.copy(key)] = copier.copy(value)
        return made
