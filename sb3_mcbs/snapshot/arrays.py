"""NumPy arrays: owned, views of each other, and views into a simulator's memory."""

import array
import ctypes
from typing import Any, Literal

import numpy as np

from sb3_mcbs.snapshot.errors import SnapshotMismatchError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.object_graph import Capture, Restore
from sb3_mcbs.snapshot.tensors import bytes_of, is_tensor


class ArrayHandler:
    """NumPy arrays. A view stays a view of the same array, or of the same object of plain memory."""

    name = "array"

    def capture(self, capture: Capture, obj: np.ndarray) -> Any:
        base, layout = (None, None) if obj.base is None else _base_and_layout(obj)
        if layout is not None:
            return "view", capture(base), layout
        if obj.dtype.hasobject:
            items = [capture(item) for item in obj.ravel().tolist()]
            return "objects", obj.shape, obj.dtype, _order(obj), items
        content = obj.copy(order="K")
        content.setflags(write=False)
        if obj.base is not None and _is_borrowed(obj):
            if type(_owner(obj)).__module__.startswith("pygame."):
                raise SnapshotUnsupportedError("it shows the memory of a pygame surface")
            return "borrowed", content, capture.places.find(obj)
        owner = None if obj.base is None else _owner(obj)
        if _is_of_cython(owner) and capture.owner_of(owner, obj) is not None:
            raise SnapshotUnsupportedError("it shares its memory with another array, and both are Cython's")
        return "own", content, obj.flags.writeable

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        form = payload[0]
        if form == "own":
            if restore.is_original(index, current) and _is_alike(current, *payload[1:]):
                restore.do_then(_write, current, payload[1])
                return current
            return _with_flag(payload[1].copy(order="K"), payload[2])
        if form == "view":
            base, layout = restore(payload[1]), payload[2]
            stays = restore.is_original(index, current) and _lies_in(current, base, layout)
            return current if stays else _view_of(base, layout)
        if form == "objects":
            _, shape, dtype, order, items = payload
            made = np.empty(shape, dtype, order)
            stays = restore.is_original(index, current) and current.shape == shape
            restore.memo[index] = current if stays else made
            for place, item in zip(np.ndindex(shape), items, strict=True):
                made[place] = restore(item)
            if stays:
                restore.do_then(_write, current, made)
            return restore.memo[index]
        content, place = payload[1:]
        stays = restore.is_original(index, current)
        view = current if stays else restore.places.view_at(place, current)
        if view is not current:
            return view
        if not isinstance(current, np.ndarray) or current.shape != content.shape or not _is_borrowed(current):
            raise SnapshotMismatchError(
                f"The snapshot holds a view of shape {content.shape} into memory that is not an array's, "
                "and this environment has none at its place."
            )
        restore.do_then(_write, current, content)
        return current


class BytearrayHandler:
    """Bytes that can be changed."""

    name = "bytearray"

    def capture(self, capture: Capture, obj: bytearray) -> Any:
        return bytes(obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        if restore.is_original(index, current) and len(current) == len(payload):
            restore.do_then(current.__setitem__, slice(None), payload)
            return current
        return bytearray(payload)


def _owner(view: np.ndarray) -> Any:
    """Return what an array's memory belongs to, if that is not an array."""
    base: Any = view.base
    while isinstance(base, np.ndarray):
        base = base.base
    base = base.obj if isinstance(base, memoryview) else base
    while getattr(base, "_b_base_", None) is not None:  # a part of a ctypes object
        base = base._b_base_
    return base.base if type(base).__name__ == "_memoryviewslice" else base


def _is_of_cython(owner: Any) -> bool:
    """Return whether an object is memory that Cython made for an array, as of SciPy's rotations."""
    cls = type(owner)
    return cls.__name__ == "array" and cls.__module__ in ("_cyutility", "View.MemoryView")


def _is_plain_memory(owner: Any) -> bool:
    """Return whether an object is bytes that can be changed, and nothing but them."""
    if is_tensor(owner):
        return True
    if isinstance(owner, ctypes.Array | ctypes.Structure | ctypes.Union):
        return bool(owner._b_needsfree_)  # others lie in the memory of something else
    return isinstance(owner, bytearray | array.array)


def _is_borrowed(view: np.ndarray) -> bool:
    """Return whether the memory belongs to a simulator, a file or another process."""
    owner = _owner(view)
    return not (owner is None or isinstance(owner, bytes) or _is_plain_memory(owner) or _is_of_cython(owner))


def _order(values: np.ndarray) -> Literal["C", "F"]:
    return "F" if values.flags.f_contiguous and not values.flags.c_contiguous else "C"


def _base_and_layout(view: np.ndarray) -> tuple[Any, tuple[Any, ...] | None]:
    """Return what an array is a view of and where; no layout if it is captured by itself."""
    base = view.base
    if type(base) is np.ndarray:
        return base, None if _is_borrowed(base) else _layout_in(view, base)
    owner = _owner(view)
    if isinstance(base, np.ndarray) or not _is_plain_memory(owner) or not _memory(owner).nbytes:
        return None, None
    return owner, _layout_in(view, _memory(owner))


def _memory(owner: Any) -> np.ndarray:
    """Return the bytes of an object of plain memory."""
    if is_tensor(owner):
        return bytes_of(owner)
    return np.frombuffer(owner, np.uint8) if memoryview(owner).nbytes else np.empty(0, np.uint8)


def _layout_in(view: np.ndarray, base: np.ndarray) -> tuple[Any, ...] | None:
    """Describe where a view lies in its base, or return None if it must be captured by itself."""
    if not (base.flags.c_contiguous or base.flags.f_contiguous):
        return None
    if base.dtype.hasobject and base.dtype != view.dtype:
        return None
    offset = view.__array_interface__["data"][0] - base.__array_interface__["data"][0]
    return offset, view.shape, view.dtype, view.strides, view.flags.writeable


def _view_of(base: Any, layout: tuple[Any, ...]) -> np.ndarray:
    offset, shape, dtype, strides, writeable = layout
    memory = bytes_of(base) if is_tensor(base) else base
    if isinstance(base, np.ndarray):
        memory = base.ravel(order="K")
        # Objects cannot be looked at as bytes.
        memory = memory if base.dtype.hasobject else memory.view(np.uint8)
    return _with_flag(np.ndarray(shape, dtype, memory, offset, strides), writeable)


def _lies_in(view: np.ndarray, base: Any, layout: tuple[Any, ...]) -> bool:
    """Return whether an array is a view that lies somewhere."""
    its_base, its_layout = (None, None) if view.base is None else _base_and_layout(view)
    return its_base is base and its_layout == layout


def _is_alike(values: np.ndarray, others: np.ndarray, writeable: bool) -> bool:
    return (values.shape, values.dtype, values.flags.writeable) == (others.shape, others.dtype, writeable)


def _write(values: np.ndarray, content: np.ndarray) -> None:
    if values.flags.writeable:
        np.copyto(values, content)


def _with_flag(values: np.ndarray, writeable: bool) -> np.ndarray:
    if not writeable:
        values.setflags(write=False)
    return values
