"""NumPy arrays: owned, views of each other, and views into a simulator's memory."""

from typing import Any

import numpy as np

from sb3_mcbs.snapshot.errors import SnapshotMismatchError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.graph import Copier, Freezer, Thawer


class ArrayKind:
    """NumPy arrays. A view stays a view of the same array."""

    name = "array"

    def freeze(self, freezer: Freezer, obj: np.ndarray) -> Any:
        if obj.dtype.hasobject:
            return "objects", obj.shape, obj.dtype, [freezer.freeze(item) for item in obj.ravel().tolist()]
        base = obj.base
        if isinstance(base, np.ndarray) and type(base) is np.ndarray and not _is_borrowed(base):
            layout = _layout_in(obj, base)
            if layout is not None:
                return "view", freezer.freeze(base), layout
        content = obj.copy(order="K")
        content.setflags(write=False)
        return "borrowed" if _is_borrowed(obj) else "own", content, obj.flags.writeable

    def thaw(self, thawer: Thawer, index: int, payload: Any, current: Any) -> Any:
        form = payload[0]
        if form == "own":
            return _with_flag(payload[1].copy(order="K"), payload[2])
        if form == "view":
            return _view_of(thawer.thaw(payload[1]), payload[2])
        if form == "objects":
            _, shape, dtype, items = payload
            array = thawer.memo[index] = np.empty(shape, dtype)
            array.ravel()[:] = [thawer.thaw(item) for item in items]
            return array
        content = payload[1]
        if not isinstance(current, np.ndarray) or current.shape != content.shape or not _is_borrowed(current):
            raise SnapshotMismatchError(
                f"The snapshot holds a view of shape {content.shape} into memory that is not an array's, "
                "and this environment has none at its place."
            )
        if current.flags.writeable:
            thawer.do_then(np.copyto, current, content)
        return current

    def copy(self, copier: Copier, obj: np.ndarray) -> Any:
        if obj.dtype.hasobject:
            array = copier.enter(obj, np.empty(obj.shape, obj.dtype))
            for place, item in enumerate(obj.ravel().tolist()):
                array.reshape(-1)[place] = copier.copy(item)
            return array
        if _is_borrowed(obj):
            for adapter, old, new in copier.adapted:
                view = adapter.clone_view(old, new, obj)
                if view is not None:
                    return view
            raise SnapshotUnsupportedError("it is a view into memory that belongs to nothing that is copied")
        base = obj.base
        if type(base) is np.ndarray:
            layout = _layout_in(obj, base)
            if layout is not None:
                return _view_of(copier.copy(base), layout)
        return _with_flag(obj.copy(order="K"), obj.flags.writeable)


def _is_borrowed(array: np.ndarray) -> bool:
    """Return whether the memory belongs to a simulator, a file or another process."""
    root: Any = array
    while isinstance(root.base, np.ndarray):
        root = root.base
    return root.base is not None and not isinstance(root.base, bytes | bytearray)


def _layout_in(view: np.ndarray, base: np.ndarray) -> tuple[Any, ...] | None:
    """Describe where a view lies in its base, or return None if it must be captured by itself."""
    if not (base.flags.c_contiguous or base.flags.f_contiguous) or base.dtype.hasobject:
        return None
    offset = view.__array_interface__["data"][0] - base.__array_interface__["data"][0]
    return offset, view.shape, view.dtype, view.strides, view.flags.writeable


def _view_of(base: np.ndarray, layout: tuple[Any, ...]) -> np.ndarray:
    offset, shape, dtype, strides, writeable = layout
    memory = base.ravel(order="K").view(np.uint8)
    return _with_flag(np.ndarray(shape, dtype, memory, offset, strides), writeable)


def _with_flag(array: np.ndarray, writeable: bool) -> np.ndarray:
    if not writeable:
        array.setflags(write=False)
    return array
