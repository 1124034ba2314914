"""What is remembered about objects that cannot be hashed, or are equal to others."""

import weakref
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class ByIdentity(Generic[T]):
    """Remembers one thing about each of some objects, for as long as they live."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Any, T]] = {}

    def get(self, obj: Any) -> T | None:
        """Return what is remembered about an object, None if nothing is.

        :param obj: the object.
        """
        known = self._known.get(id(obj))
        return known[1] if known is not None and known[0]() is obj else None

    def put(self, obj: Any, value: T) -> T:
        """Remember something about an object.

        :param obj: the object.
        :param value: what is remembered; it must not hold the object.
        """
        key = id(obj)
        self._known[key] = weakref.ref(obj, lambda _: self._known.pop(key, None)), value
        return value
