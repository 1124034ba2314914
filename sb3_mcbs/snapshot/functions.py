"""Functions and methods that environments hold: what they close over is state."""

import functools
import importlib
import types
from typing import Any

from sb3_mcbs.snapshot.errors import SnapshotMismatchError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.graph import MISSING, Copier, Freezer, Thawer

_EMPTY = ("empty",)


@functools.lru_cache(maxsize=1024)
def _fingerprint(code: types.CodeType) -> tuple[Any, ...]:
    """Say what a function does, in a form that can be pickled."""
    constants = tuple(_fingerprint(c) if isinstance(c, types.CodeType) else repr(c) for c in code.co_consts)
    return code.co_name, code.co_firstlineno, code.co_code, code.co_names, constants


class FunctionName:
    """Names a function without carrying its code.

    In the process where it was made it also knows the function itself, which a pickle cannot carry
    if the function is a lambda or was made inside another function.

    :param function: the function.
    """

    def __init__(self, function: types.FunctionType) -> None:
        code = function.__code__
        self.module = function.__module__
        self.qualname = function.__qualname__
        self.code = _fingerprint(code)
        self.function: types.FunctionType | None = function

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "function": None}

    def is_name_of(self, other: Any) -> bool:
        """Return whether a function has the same code.

        :param other: any object.
        """
        if not isinstance(other, types.FunctionType):
            return False
        return (other.__module__, other.__qualname__) == (self.module, self.qualname) and (
            _fingerprint(other.__code__) == self.code
        )

    def find(self) -> types.FunctionType:
        """Return the function.

        :raises SnapshotMismatchError: if it cannot be imported by its name.
        """
        if self.function is None:
            found: Any = importlib.import_module(self.module)
            for part in self.qualname.split("."):
                found = getattr(found, part, None)
            if not isinstance(found, types.FunctionType):
                raise SnapshotMismatchError(
                    f"The snapshot is of an environment that uses {self.module}.{self.qualname}; "
                    "this one uses another at its place, and a function that cannot be imported by its name "
                    "cannot be sent to another process."
                )
            self.function = found
        return self.function


class FunctionKind:
    """Python functions: their code is fixed, what they close over is state."""

    name = "function"

    def freeze(self, freezer: Freezer, obj: types.FunctionType) -> Any:
        cells = []
        for name, cell in zip(obj.__code__.co_freevars, obj.__closure__ or (), strict=True):
            try:
                cells.append(freezer.freeze(cell))
            except SnapshotUnsupportedError as error:
                error.path.insert(0, f" (variable {name} of {obj.__qualname__})")
                raise
        return FunctionName(obj), tuple(cells)

    def thaw(self, thawer: Thawer, index: int, payload: Any, current: Any) -> Any:
        name, cells = payload
        if name.is_name_of(current):
            thawer.memo[index] = current
            for value, cell in zip(cells, current.__closure__ or (), strict=True):
                thawer.thaw(value, cell)
            return current
        function = name.find()
        if not cells:
            return function
        # The function that was found closes over another instance's variables, which are not to be touched.
        return _with_cells(function, tuple(thawer.thaw(value) for value in cells))

    def copy(self, copier: Copier, obj: types.FunctionType) -> Any:
        cells = obj.__closure__ or ()
        copies = tuple(copier.copy(cell) for cell in cells)
        if all(new is old for new, old in zip(copies, cells, strict=True)):
            return obj
        return _with_cells(obj, copies)


def _with_cells(function: types.FunctionType, cells: tuple[types.CellType, ...]) -> types.FunctionType:
    made = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, cells
    )
    made.__kwdefaults__ = function.__kwdefaults__
    made.__qualname__, made.__module__, made.__doc__ = (
        function.__qualname__,
        function.__module__,
        function.__doc__,
    )
    made.__dict__.update(function.__dict__)
    return made


class CellKind:
    """The variables that functions close over."""

    name = "cell"

    def freeze(self, freezer: Freezer, obj: types.CellType) -> Any:
        try:
            content = obj.cell_contents
        except ValueError:
            return _EMPTY
        return ("full", freezer.freeze(content))

    def thaw(self, thawer: Thawer, index: int, payload: Any, current: Any) -> Any:
        cell = thawer.memo[index] = types.CellType() if current is MISSING else current
        if payload == _EMPTY:
            return cell
        have = _content(cell)
        value = thawer.thaw(payload[1], have)
        if value is not have and value is not MISSING:
            thawer.do_then(setattr, cell, "cell_contents", value)
        return cell

    def copy(self, copier: Copier, obj: types.CellType) -> Any:
        content = _content(obj)
        if content is MISSING:
            return obj
        made = copier.enter(obj, types.CellType())
        made.cell_contents = copier.copy(content)
        return made


def _content(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except (AttributeError, ValueError):
        return MISSING


class MethodKind:
    """Methods bound to an object."""

    name = "method"

    def freeze(self, freezer: Freezer, obj: types.MethodType) -> Any:
        return freezer.freeze(obj.__func__), freezer.freeze(obj.__self__)

    def thaw(self, thawer: Thawer, index: int, payload: Any, current: Any) -> Any:
        is_method = isinstance(current, types.MethodType)
        function = thawer.thaw(payload[0], current.__func__ if is_method else MISSING)
        owner = thawer.thaw(payload[1], current.__self__ if is_method else MISSING)
        if is_method and current.__func__ is function and current.__self__ is owner:
            return current
        return types.MethodType(function, owner)

    def copy(self, copier: Copier, obj: types.MethodType) -> Any:
        return types.MethodType(copier.copy(obj.__func__), copier.copy(obj.__self__))


class BuiltinMethodKind:
    """Compiled functions, and methods of compiled classes such as ``Generator.normal``."""

    name = "builtin"

    def freeze(self, freezer: Freezer, obj: types.BuiltinMethodType) -> Any:
        owner = obj.__self__
        if owner is None or isinstance(owner, types.ModuleType):
            return obj, None
        return obj.__name__, freezer.freeze(owner)

    def thaw(self, thawer: Thawer, index: int, payload: Any, current: Any) -> Any:
        name, owner = payload
        if owner is None:
            return name
        return getattr(thawer.thaw(owner, getattr(current, "__self__", MISSING)), name)

    def copy(self, copier: Copier, obj: types.BuiltinMethodType) -> Any:
        owner = obj.__self__
        if owner is None or isinstance(owner, types.ModuleType):
            return obj
        return getattr(copier.copy(owner), obj.__name__)
