"""Clones: captured state that is restored where nothing is yet."""

from typing import Any

from sb3_mcbs.snapshot.errors import SnapshotUnsupportedError
from sb3_mcbs.snapshot.handlers import HANDLERS, handler_of
from sb3_mcbs.snapshot.object_graph import Capture, Ref, Restore, TypeHandler
from sb3_mcbs.snapshot.objects import attributes_of, capture_content, set_attributes
from sb3_mcbs.snapshot.places import Places
from sb3_mcbs.snapshot.pygame_values import is_display
from sb3_mcbs.snapshot.registry import find_adapter


class Cloner:
    """Copies values; what is shared among them is shared among the copies.

    Original and copy share what is not state, such as modules and fonts. A copy has no windows. A space is
    copied with all its attributes, as an ordinary object.

    :param known: id of an object -> its node, for objects that the caller makes and puts into
        ``restore.memo``.
    :param n_known: how many nodes those are, the first ones.
    """

    def __init__(self, known: dict[int, Ref], n_known: int) -> None:
        simulators = _SimulatorHandler(self)
        handlers: dict[str, TypeHandler] = {**HANDLERS, "adapter": simulators, "window": _WINDOW}
        #: By the handler that a snapshot uses; what has none stands for itself.
        self._own: dict[TypeHandler | None, TypeHandler | None] = {
            HANDLERS["adapter"]: simulators,
            HANDLERS["window"]: _WINDOW,
            HANDLERS["constant"]: None,
            HANDLERS["space"]: HANDLERS["object"],
        }
        self.capture = Capture(self._handler_of, known, n_known, simulators)
        self.restore = Restore(self.capture.nodes, handlers, [], "restore", places=simulators)

    def _handler_of(self, obj: Any) -> TypeHandler | None:
        handler = handler_of(obj)
        if handler is HANDLERS["surface"] and is_display(obj):
            return _WINDOW
        return self._own.get(handler, handler)

    def __call__(self, value: Any) -> Any:
        """Return the copy of a value.

        :param value: any value that an environment holds.
        :raises SnapshotUnsupportedError: if part of it cannot be copied.
        """
        made = self.restore(self.capture(value))
        self.restore.commit()
        return made

    def make_simulators(self) -> None:
        """Copy the simulators that were captured: attributes may be views into their memory."""
        for simulator in self.capture.adapted:
            self(simulator)


class _WindowHandler:
    """Windows and render contexts: there are none in a copy."""

    name = "window"

    def capture(self, capture: Capture, obj: Any) -> Any:
        return None

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        return None


class _SimulatorHandler(Places):
    """Simulators, which their adapters copy, and the views into them.

    :param cloner: copies what a simulator refers to.
    """

    name = "adapter"

    def __init__(self, cloner: Cloner) -> None:
        super().__init__()
        self._cloner = cloner
        self._copied: list[tuple[Any, Any]] = []
        self._views: list[Any] = []

    def capture(self, capture: Capture, obj: Any) -> Any:
        adapter = find_adapter(obj)
        assert adapter is not None
        capture.adapted.append(obj)
        return capture_content(capture, obj, adapter.not_state) if adapter.with_attributes else None

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        obj = self._cloner.capture.objects[index]
        adapter = find_adapter(obj)
        assert adapter is not None
        made = restore.memo[index] = adapter.clone(obj, self._cloner)
        self._copied.append((obj, made))
        if payload is not None:
            # Those that it has already may be the original's.
            values = {name: restore(value) for name, value in payload}
            gone = attributes_of(made).keys() - values.keys() - adapter.not_state
            restore.do_then(set_attributes, made, values, gone)
        return made

    def find(self, view: Any) -> Any:
        self._views.append(view)
        return len(self._views) - 1, None

    def view_at(self, place: Any, current: Any) -> Any:
        view = self._views[place[0]]
        for simulator, made in self._copied:
            adapter = find_adapter(simulator)
            found = None if adapter is None else adapter.clone_view(simulator, made, view)
            if found is not None:
                return found
        raise SnapshotUnsupportedError("it is a view into memory that belongs to nothing that is copied")


_WINDOW = _WindowHandler()
