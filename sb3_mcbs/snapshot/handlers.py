"""The types of objects that environments hold, and how each is captured and restored."""

import ctypes
import enum
import logging
import pathlib
import types
import weakref
from collections import deque
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec, WrapperSpec

from sb3_mcbs.snapshot.arrays import ArrayHandler, BytearrayHandler
from sb3_mcbs.snapshot.classes import ClassHandler, LocalClassHandler, is_local, is_made_per_instance
from sb3_mcbs.snapshot.containers import DictHandler, SequenceHandler, TupleHandler
from sb3_mcbs.snapshot.drawing import DrawnHandler, kind_name
from sb3_mcbs.snapshot.errors import SnapshotMismatchError
from sb3_mcbs.snapshot.functions import BuiltinMethodHandler, CellHandler, FunctionHandler, MethodHandler
from sb3_mcbs.snapshot.generators import GeneratorHandler, SeedsHandler, is_generator
from sb3_mcbs.snapshot.object_graph import (
    ATOMIC_CLASSES,
    MISSING,
    Capture,
    Restore,
    TypeHandler,
    class_name,
)
from sb3_mcbs.snapshot.objects import (
    ObjectHandler,
    ReducedHandler,
    capture_content,
    is_global,
    is_ordinary,
    restore_content,
)
from sb3_mcbs.snapshot.pygame_values import PygameHandler, SurfaceHandler, is_display
from sb3_mcbs.snapshot.registry import SnapshotAdapter, call_on_change, find_adapter
from sb3_mcbs.snapshot.spaces import SpaceHandler
from sb3_mcbs.snapshot.tensors import TensorHandler, is_tensor
from sb3_mcbs.snapshot.weak import PROXIES, ProxyHandler, WeakrefHandler

#: Classes whose objects hold caches besides what they say themselves that they are made of.
_SAY_THEMSELVES = ("pandas.", "PIL.")

_SIMULATOR_PARTS = (
    "mujoco._structs.",
    "dm_control.mujoco.engine.NamedIndexStructs",
    "dm_control.mujoco.index.FieldIndexer",
    "dm_control.mujoco.index.make_struct_indexer.",
)
_MUJOCO_DRAWING = ("mujoco._structs.Mjv", "mujoco._structs.Mjr")

_ATOMIC_BASES = (np.generic, np.dtype, enum.Enum, pathlib.PurePath)
_EXACT: dict[type, str] = {
    np.ndarray: "array",
    list: "sequence",
    tuple: "tuple",
    set: "sequence",
    frozenset: "tuple",
    deque: "sequence",
    dict: "dict",
    types.FunctionType: "function",
    types.CellType: "cell",
    types.MethodType: "method",
    types.BuiltinMethodType: "builtin",
    np.random.SeedSequence: "seeds",
    bytearray: "bytearray",
    weakref.ref: "weakref",
}
_CONSTANT_BASES = (types.ModuleType, EnvSpec, WrapperSpec, logging.Logger, logging.LoggerAdapter)


class ConstantHandler:
    """Objects that are not state: whatever is there stays."""

    name = "constant"

    def capture(self, capture: Capture, obj: Any) -> Any:
        return None

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        return current


class WindowHandler(ConstantHandler):
    """Windows and render contexts: whatever is there stays."""

    name = "window"


class PartHandler(ConstantHandler):
    """Parts that a simulator hands out, such as ``data.body("torso")``: their state is the simulator's."""

    name = "part"

    def capture(self, capture: Capture, obj: Any) -> Any:
        return capture.places.find(obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        return current if restore.is_original(index, current) else restore.places.view_at(payload, current)


class AdapterHandler:
    """Objects for which an adapter is registered."""

    name = "adapter"

    def capture(self, capture: Capture, obj: Any) -> Any:
        adapter = find_adapter(obj)
        assert adapter is not None
        capture.adapted.append(obj)
        state = adapter.capture(obj)
        content = capture_content(capture, obj, adapter.not_state) if adapter.with_attributes else None
        return class_name(type(obj)), state, content

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        cls, state, content = payload
        if current is MISSING or class_name(type(current)) != cls:
            here = "nothing" if current is MISSING else f"a {class_name(type(current))}"
            raise SnapshotMismatchError(
                f"The snapshot holds the state of a {cls}, and this environment has {here} there."
            )
        adapter = find_adapter(current)
        restore.adapted[index] = current
        plan_adapter(restore, adapter, current, state)
        if content is not None and adapter is not None:
            restore.memo[index] = current
            restore_content(restore, content, current, adapter.not_state)
        return current


def plan_adapter(restore: Restore, adapter: SnapshotAdapter | None, obj: Any, state: Any) -> None:
    """Check a state that an adapter captured and plan to put it back.

    :param restore: keeps the plan.
    :param adapter: the adapter for ``obj``.
    :param obj: the object to restore.
    :param state: what the adapter captured.
    :raises SnapshotMismatchError: if the state does not belong to the object.
    """
    if adapter is None:
        raise SnapshotMismatchError(
            f"The snapshot needs an adapter for {class_name(type(obj))}, and none is registered here."
        )
    adapter.validate(obj, state)
    restore.do_first(adapter.restore, obj, state)
    if isinstance(restore.rng, np.random.Generator):
        rng = restore.rng
        restore.do_first(lambda: adapter.reseed(obj, int(rng.integers(2**63))))


#: By name, as nodes name them.
HANDLERS: dict[str, TypeHandler] = {}
for _handler_class in (
    ConstantHandler, WindowHandler, DrawnHandler, PygameHandler, SurfaceHandler, PartHandler,
    ArrayHandler, BytearrayHandler, TensorHandler, TupleHandler, SequenceHandler, DictHandler,
    GeneratorHandler, SeedsHandler, SpaceHandler, ObjectHandler, ReducedHandler, ProxyHandler, WeakrefHandler,
    AdapterHandler, ClassHandler, LocalClassHandler, FunctionHandler, CellHandler, MethodHandler,
    BuiltinMethodHandler,
):  # fmt: skip
    HANDLERS[_handler_class.name] = _handler_class()

_handler_by_class: dict[type, TypeHandler | None] = dict.fromkeys(ATOMIC_CLASSES)
# Classes that are made inside functions come and go, such as those of clones.
_handler_by_local_class: weakref.WeakKeyDictionary[type, TypeHandler | None] = weakref.WeakKeyDictionary()
_handler_of_class: weakref.WeakKeyDictionary[type, TypeHandler | None] = weakref.WeakKeyDictionary()
_UNDECIDED: Any = object()


def _forget() -> None:
    _handler_of_class.clear()
    _handler_by_local_class.clear()
    _handler_by_class.clear()
    _handler_by_class.update(dict.fromkeys(ATOMIC_CLASSES))


call_on_change(_forget)


def handler_of(obj: Any) -> TypeHandler | None:
    """Return the handler of an object; None if it never changes.

    :param obj: any object that an environment holds.
    """
    cls = type(obj)
    handler = _handler_by_class.get(cls, _UNDECIDED)
    if handler is not _UNDECIDED:
        return handler
    if issubclass(cls, type):  # classes differ from each other
        handler = _handler_of_class.get(obj, _UNDECIDED)
        if handler is _UNDECIDED:
            handler = _handler_of_class[obj] = _decide_class(obj)
        return handler
    if "<" not in cls.__qualname__:
        handler = _handler_by_class[cls] = _decide(obj, cls)
        return handler
    handler = _handler_by_local_class.get(cls, _UNDECIDED)
    if handler is _UNDECIDED:
        handler = _handler_by_local_class[cls] = _decide(obj, cls)
    return handler


def stays(obj: Any) -> bool:
    """Return whether an object is no state: it stays where it is, whatever was there before.

    :param obj: any object.
    """
    handler = handler_of(obj)
    if handler is None:
        return False
    return handler.name in ("constant", "window") or (handler.name == "surface" and is_display(obj))


def _decide_class(cls: type) -> TypeHandler | None:
    if is_made_per_instance(cls, handler_of):
        return HANDLERS["class"]
    return HANDLERS["local class"] if is_local(cls) else None


def _decide(obj: Any, cls: type) -> TypeHandler | None:
    if cls in PROXIES:  # isinstance() takes them for what they stand for
        return HANDLERS["proxy"]
    if issubclass(cls, _ATOMIC_BASES) and not issubclass(cls, np.void):
        return None
    if find_adapter(obj) is not None:
        return HANDLERS["adapter"]
    if cls in _EXACT:
        return HANDLERS[_EXACT[cls]]
    if issubclass(cls, _CONSTANT_BASES):
        return HANDLERS["constant"]
    # A pointer class is made once, by whoever needs it first; what it points to says whose it is.
    name = class_name(cls._type_ if issubclass(cls, ctypes._Pointer) else cls)
    if name.startswith(_SIMULATOR_PARTS):
        return HANDLERS["constant" if name.startswith(_MUJOCO_DRAWING) else "part"]
    drawing = kind_name(cls, name)
    if drawing is not None:
        return HANDLERS[drawing]
    if is_tensor(obj):
        return HANDLERS["torch"]
    if is_generator(obj):
        return HANDLERS["generator"]
    if issubclass(cls, spaces.Space):
        return HANDLERS["space"]
    if is_ordinary(cls) and not name.startswith(_SAY_THEMSELVES):
        return HANDLERS["object"]
    return None if is_global(obj) else HANDLERS["reduced"]
