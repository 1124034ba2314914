"""dm_control: its physics are ordinary objects around MuJoCo's model and data, but for a few attributes."""

import sys
import threading
from collections.abc import Callable
from typing import Any

from sb3_mcbs.snapshot.object_graph import class_name
from sb3_mcbs.snapshot.objects import blank
from sb3_mcbs.snapshot.registry import SnapshotAdapter

_PHYSICS = "dm_control.mujoco.engine.Physics"
_INDEX = "dm_control.mujoco.index"


def is_physics(obj: Any) -> bool:
    """Return whether an object is a ``dm_control.mujoco.Physics``. Does not import dm_control.

    :param obj: any object.
    """
    return any(class_name(cls) == _PHYSICS for cls in type(obj).__mro__)


class PhysicsAdapter(SnapshotAdapter):
    """Captures the attributes of a ``dm_control.mujoco.Physics``, among them MuJoCo's model and data.

    Not state are its lock and its render contexts. ``physics.named``, hundreds of views into model and data,
    stays where it is and belongs to those that are there.
    """

    with_attributes = True
    what = "dm_control's physics"
    not_state = frozenset({"_contexts_lock", "_contexts"})

    def capture(self, obj: Any) -> None:
        return None

    def restore(self, obj: Any, state: None) -> None:
        pass

    def clone(self, obj: Any, copy: Callable[[Any], Any]) -> Any:
        made = blank(copy(type(obj)))
        made._contexts_lock = threading.Lock()
        if "_data" in vars(obj):  # not any more after free()
            data = copy(obj._data)
            made._named = type(obj._named)(
                _named(obj._named.model, data.model), _named(obj._named.data, data)
            )
        return made

    def place_of(self, obj: Any, view: Any) -> Any:
        """Say where in ``physics.named`` a part of it lies, which something else may hold."""
        if view is obj._named:
            return ()
        for number, part in enumerate(obj._named):
            if view is part:
                return (number,)
            name = getattr(view, "_field_name", None) if type(view).__module__ == _INDEX else None
            if name is not None and getattr(part, name, None) is view:
                return number, name
        return None

    def view_at(self, obj: Any, place: Any) -> Any:
        found = obj._named
        for step in place:
            found = getattr(found, step) if isinstance(step, str) else found[step]
        return found


def _named(fields: Any, struct: Any) -> Any:
    """Make named views like others, of another model or other data.

    :param fields: the others.
    :param struct: dm_control's wrapper around the model or the data.
    """
    index: Any = sys.modules[_INDEX]
    return index.make_struct_indexer(
        {
            name: index.FieldIndexer(struct, name, [axis for axis in field.axes if axis is not None])
            for name, field in fields._asdict().items()
        }
    )
