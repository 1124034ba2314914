"""Adapters: how objects that are not ordinary Python state are captured."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary


class SnapshotAdapter(ABC):
    """How one kind of object inside an environment is captured, put back and copied.

    The object may be a simulator that an environment holds in an attribute, or the environment (or
    a wrapper) itself.

    :cvar with_attributes: whether the object's Python attributes are captured besides what :meth:`capture`
        returns. They are put back after :meth:`restore` has run, and a clone is given copies of them after
        :meth:`clone`. Those of an environment or wrapper that cannot be captured are the adapter's business;
        those of another object are refused, unless ``not_state`` names them.
    :cvar not_state: names of attributes that are neither captured nor put back.
    :cvar n_later_checks: for an adapter of whole environments: from how many states, farther and farther
        from the reset, the check before the first snapshot compares steps.
    :cvar advice: what a user can do about an environment that does not pass this check.
    :cvar what: what is captured, in words.
    """

    with_attributes: bool = False
    not_state: frozenset[str] = frozenset()
    n_later_checks: int = 1
    advice: str = ""
    what: str = ""

    def attach(self, env: Any) -> None:  # noqa: B027
        """Prepare an environment; called when it is wrapped in ``SnapshotEnvWrapper``.

        Only called for environments and wrappers, not for the objects that they hold.

        :param env: the environment or wrapper.
        :raises SnapshotUnsupportedError: if it cannot be captured after all.
        """

    @abstractmethod
    def capture(self, obj: Any) -> Any:
        """Read the present state.

        :param obj: the object.
        :return: the state: picklable, and never changed by what happens to the object later.
        """

    @abstractmethod
    def restore(self, obj: Any, state: Any) -> None:
        """Put an object into a captured state, in place.

        :param obj: the object, or its counterpart in another instance of the environment.
        :param state: what :meth:`capture` returned. It must not be altered: it may be restored again.
        """

    @abstractmethod
    def clone(self, obj: Any, copy: Callable[[Any], Any]) -> Any:
        """Make an independent object in the same state.

        :param obj: the object.
        :param copy: returns the copy of another object of the same environment, for objects that
            refer to each other.
        :return: the new object.
        """

    def validate(self, obj: Any, state: Any) -> None:  # noqa: B027
        """Refuse a state that does not belong to an object; called before anything is changed.

        :param obj: the object that would be restored.
        :param state: what :meth:`capture` returned.
        :raises SnapshotMismatchError: names the difference.
        """

    def reseed(self, obj: Any, seed: int) -> None:  # noqa: B027
        """Seed the object's own random generator afresh, if it has one.

        Called after :meth:`restore` when the environment is restored with a generator to draw from.

        :param obj: the object.
        :param seed: non-negative, below 2**63.
        """

    def fall_back(self, env: Any) -> bool:
        """Capture an environment another way from now on: it did not pass the check.

        :param env: the environment, which is then checked again.
        :return: False if there is no other way.
        """
        return False

    def watch(self, obj: Any) -> Callable[[], bool] | None:
        """Give a function that says whether a simulator gave up its state by itself.

        Some simulators do not fail when they diverge: they start afresh, and all their numbers are finite.
        The function is called after every step of the environment, so it has to be quick.

        :param obj: the object.
        :return: called without arguments; True if that happened since the last call. None if the object
            never does so, or fails loudly.
        """
        return None

    def place_of(self, obj: Any, view: Any) -> Any:
        """Say where in an object a view into it lies, so that a restore puts back which view was held.

        :param obj: the object.
        :param view: an array whose memory belongs to something that is not an array, or another object that
            a simulator hands out.
        :return: the place, picklable and equal for equal places; None if it is not a view into ``obj``.
        """
        return None

    def view_at(self, obj: Any, place: Any) -> Any:
        """Return the view that lies at a place.

        :param obj: the object, or its counterpart in another instance of the environment.
        :param place: what :meth:`place_of` returned.
        """
        raise NotImplementedError(f"{type(self).__name__} names places of views, and cannot find them")

    def clone_view(self, obj: Any, new: Any, view: Any) -> Any:
        """Find in a cloned object what corresponds to a view into the original.

        :param obj: the original.
        :param new: its clone.
        :param view: an array whose memory belongs to something that is not an array, or another object that
            a simulator hands out.
        :return: the corresponding view into ``new``, or None if it is not a view into ``obj``.
        """
        place = self.place_of(obj, view)
        return None if place is None else self.view_at(new, place)


Predicate = Callable[[Any], bool]

_registered: list[tuple[Predicate, SnapshotAdapter]] = []
_by_class: WeakKeyDictionary[type, SnapshotAdapter | None] = WeakKeyDictionary()
_on_change: list[Callable[[], None]] = []


def register_adapter(predicate: Predicate, adapter: SnapshotAdapter) -> None:
    """Say how objects of some kind are captured.

    The adapter that was registered last is asked first. A predicate is asked once per class, with
    the first object of that class that is met, and its answer is remembered.

    :param predicate: given an environment, a wrapper or an object that one of them holds, whether
        ``adapter`` is the one for it.
    :param adapter: what captures it.
    """
    if not callable(predicate):
        raise TypeError(f"The predicate must be callable, got {predicate!r}")
    if not isinstance(adapter, SnapshotAdapter):
        raise TypeError(f"The adapter must be an instance of a SnapshotAdapter subclass, got {adapter!r}")
    _registered.insert(0, (predicate, adapter))
    _by_class.clear()
    for forget in _on_change:
        forget()


def find_adapter(obj: Any) -> SnapshotAdapter | None:
    """Return the adapter for an object, or None if there is none.

    :param obj: an environment, a wrapper or an object that one of them holds.
    """
    cls = type(obj)
    if cls not in _by_class:
        _by_class[cls] = next((adapter for predicate, adapter in _registered if predicate(obj)), None)
    return _by_class[cls]


def call_on_change(forget: Callable[[], None]) -> None:
    """Have a function called whenever an adapter is registered.

    :param forget: drops what was derived from the registered adapters.
    """
    _on_change.append(forget)
