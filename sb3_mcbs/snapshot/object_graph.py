"""Ordinary state as a graph: captured into plain values, and put back.

An environment's attributes form a graph: wrappers refer to each other, arrays are shared, functions
close over objects. Two classes walk it, each with a memo, so that what was shared stays shared. The
handler of an object (:mod:`sb3_mcbs.snapshot.handlers`) says what is done with it. A clone is captured
and restored where nothing is (:mod:`sb3_mcbs.snapshot.cloning`).
"""

import copy as copy_module
import re
import types
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from sb3_mcbs.snapshot.errors import SnapshotError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.places import Places

#: Stands for "there is nothing at this place".
MISSING: Any = type("Missing", (), {"__repr__": lambda self: "MISSING"})()

#: Classes whose objects never change.
ATOMIC_CLASSES: frozenset[type] = frozenset(
    {type(None), bool, int, float, complex, str, bytes, range, slice, type(Ellipsis), type(NotImplemented)}
    | {re.Pattern, types.GenericAlias, property, np.ufunc}
    | {np.bool_, np.float64, np.float32, np.int64, np.int32, np.uint8}
)

#: What a restore does with random generators.
RngMode = str | np.random.Generator


def class_name(cls: type) -> str:
    """Name a class with its module.

    :param cls: the class.
    """
    # Some compiled classes have no module.
    return f"{getattr(cls, '__module__', None)}.{cls.__qualname__}"


class Ref:
    """A captured value that stands for the node with this number."""

    __slots__ = ("index",)

    def __init__(self, index: int) -> None:
        self.index = index

    def __reduce__(self) -> tuple[type, tuple[int]]:
        return Ref, (self.index,)


class TypeHandler(Protocol):
    """Captures and restores the objects of some types."""

    name: str

    def capture(self, capture: "Capture", obj: Any) -> Any:
        """Return the object's content as plain values and references to nodes."""

    def restore(self, restore: "Restore", index: int, payload: Any, current: Any) -> Any:
        """Return the object for a captured content; ``current`` is what is at its place now."""


Node = tuple[str, Any]


class Capture:
    """Turns values into captured values and nodes.

    :param handler_of: the handler of an object; None for objects that never change and stand for themselves.
    :param known: id of an object -> the node it is, for objects that are named rather than captured.
    :param n_known: how many nodes those are, the first ones.
    :param places: names views into simulators.
    """

    def __init__(
        self,
        handler_of: Callable[[Any], TypeHandler | None],
        known: dict[int, Ref],
        n_known: int,
        places: Places | None = None,
    ) -> None:
        self.places = places or Places()
        self.nodes: list[Node] = [("known", None)] * n_known
        #: The object that each node was made of.
        self.objects: list[Any] = [None] * n_known
        #: The objects that adapters captured.
        self.adapted: list[Any] = []
        #: The tensors that were captured.
        self.tensors: list[Any] = []
        #: Whether weak references were.
        self.weak = False
        self._handler_of = handler_of
        self._memo = dict(known)
        self._owners: dict[int, Ref] = {}
        # An id is only unique among objects that live, and some parts of objects are temporary.
        self._alive: list[Any] = []

    def __call__(self, value: Any) -> Any:
        """Return a captured value.

        :param value: any value that an environment holds.
        :raises SnapshotUnsupportedError: if part of it cannot be captured.
        """
        if type(value) in ATOMIC_CLASSES or (handler := self._handler_of(value)) is None:
            return value
        ref = self._memo.get(id(value))
        if ref is not None:
            return ref
        ref = self._memo[id(value)] = Ref(len(self.nodes))
        self.nodes.append(("pending", None))
        self.objects.append(value)
        try:
            self.nodes[ref.index] = (handler.name, handler.capture(self, value))
        except (SnapshotError, RecursionError):
            raise
        except Exception as error:
            raise SnapshotUnsupportedError(
                f"capturing a {class_name(type(value))} raised {type(error).__name__}: {error}"
            ) from error
        return ref

    def part(self, value: Any, path: str, *names: Any) -> Any:
        """Return a captured value that is part of an object.

        :param value: the part.
        :param path: where in the object it is, for an error: a format string.
        :param names: the fields of ``path``.
        :raises SnapshotUnsupportedError: names the part.
        """
        try:
            return self(value)
        except SnapshotUnsupportedError as error:
            error.path.insert(0, path.format(*names))
            raise

    def owner_of(self, part: Any, obj: Any) -> Ref | None:
        """Return the node that a part was captured with; None if an object is the first to have it.

        :param part: what several objects may consist of, such as the bit generator of a generator.
        :param obj: the object that is being captured; from now on, the part's owner if it has none.
        """
        owner = self._owners.get(id(part))
        if owner is None:
            self._owners[id(part)] = self._memo[id(obj)]
            self._alive.append(part)
        return owner

    def attempt(self, *values: Any) -> tuple[Any, ...] | None:
        """Return captured values, or None where :meth:`__call__` would raise for one of them.

        :param values: any values that an environment holds.
        """
        n_nodes, n_adapted, n_tensors = len(self.nodes), len(self.adapted), len(self.tensors)
        try:
            return tuple([self(value) for value in values])
        except (SnapshotUnsupportedError, RecursionError):
            for obj in self.objects[n_nodes:]:
                self._memo.pop(id(obj), None)
            self._owners = {part: ref for part, ref in self._owners.items() if ref.index < n_nodes}
            del self.nodes[n_nodes:]
            del self.objects[n_nodes:]
            del self.adapted[n_adapted:]
            del self.tensors[n_tensors:]
            return None


class Restore:
    """Turns captured values back into objects, without changing any that is there until :meth:`commit`.

    :param nodes: the nodes that the captured values refer to.
    :param handlers: by name.
    :param known: the objects that stand for the first nodes, in order.
    :param rng: what happens to random generators: "restore", "keep", or a generator to seed them from.
    :param originals: the objects that the nodes were made of, if those are to be put back themselves.
    :param places: finds views into simulators.
    :param foreign: ids of functions and classes that are there and belong to another environment.
    """

    def __init__(
        self,
        nodes: Sequence[Node],
        handlers: dict[str, TypeHandler],
        known: list[Any],
        rng: RngMode,
        originals: list[Any] | None = None,
        places: Places | None = None,
        foreign: frozenset[int] = frozenset(),
    ) -> None:
        self.rng = rng
        self.foreign = foreign
        self.places = places or Places()
        #: The objects that adapters put back, by the number of their node.
        self.adapted: dict[int, Any] = {}
        self._originals = originals
        #: Whether objects that are there are put back themselves, with the content that they had.
        self.in_place = originals is not None
        self.memo: dict[int, Any] = dict(enumerate(known))
        self.nodes = nodes
        self._handlers = handlers
        self._claimed: set[int] = {id(obj) for obj in known}
        self._first: list[tuple[Any, ...]] = []
        self._then: list[tuple[Any, ...]] = []

    def __call__(self, value: Any, current: Any = MISSING) -> Any:
        """Return the object for a captured value.

        :param value: a captured value.
        :param current: what is at its place now, if anything.
        :raises SnapshotMismatchError: if the snapshot cannot have come from here.
        """
        if type(value) is not Ref:
            return value
        index = value.index
        if index in self.memo:
            return self.memo[index]
        name, payload = self.nodes[index]
        if self._originals is not None:
            current = self._originals[index]
        try:
            restored = self.memo[index] = self._handlers[name].restore(self, index, payload, current)
        except SnapshotError:
            raise
        except Exception as error:
            raise cannot_be_made(name if current is MISSING else class_name(type(current)), error) from error
        return restored

    def is_original(self, index: int, current: Any) -> bool:
        """Return whether an object is the one that a node was made of, and is to stay the one that it is.

        :param index: number of the node.
        :param current: an object that is there.
        """
        return self.in_place and self._originals is not None and current is self._originals[index]

    def claim(self, obj: Any) -> bool:
        """Return whether an object may stand for one more node, and note that it now does.

        :param obj: an object that is there already.
        """
        if obj is MISSING or id(obj) in self._claimed:
            return False
        self._claimed.add(id(obj))
        return True

    def do_first(self, *call: Any) -> None:
        """Plan a call that puts back a simulator: these run before attributes are set.

        :param call: the function and its arguments.
        """
        self._first.append(call)

    def do_then(self, *call: Any) -> None:
        """Plan a call that changes an object.

        :param call: the function and its arguments.
        """
        self._then.append(call)

    def commit(self) -> None:
        """Make the planned calls."""
        for function, *arguments in (*self._first, *self._then):
            function(*arguments)
        self._first, self._then = [], []


def cannot_be_made(what: str, error: Exception) -> SnapshotUnsupportedError:
    """Say that an object cannot be made from its captured content.

    :param what: its class.
    :param error: what making it raised.
    """
    return SnapshotUnsupportedError(
        f"making another {what} of the same content raised {type(error).__name__}: {error}"
    )


def private_copy(obj: Any) -> Any:
    """Copy an observation so that later in-place edits do not reach it.

    :param obj: an observation: an array, or dicts and tuples of arrays, or a plain value.
    """
    if isinstance(obj, np.ndarray):
        return obj.copy()
    if isinstance(obj, dict):
        return {key: private_copy(value) for key, value in obj.items()}
    if isinstance(obj, tuple):
        return tuple(private_copy(value) for value in obj)
    return obj if type(obj) in ATOMIC_CLASSES or isinstance(obj, np.generic) else copy_module.deepcopy(obj)
