"""Functions and methods that environments hold: what they close over, defaults and attributes are state."""

import functools
import importlib
import sys
import types
from typing import Any

from sb3_mcbs.snapshot.errors import SnapshotMismatchError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.object_graph import ATOMIC_CLASSES, MISSING, Capture, Ref, Restore
from sb3_mcbs.snapshot.stand_ins import bound, function_of

_EMPTY = ("empty",)
# Names what a function was made from, which is not state.
_WRAPPED = "__wrapped__"


@functools.lru_cache(maxsize=1024)
def fingerprint(code: types.CodeType) -> tuple[Any, ...]:
    """Say what a function does, in a form that can be pickled.

    :param code: of the function.
    """
    constants = tuple(_constant(constant) for constant in code.co_consts)
    return code.co_name, code.co_firstlineno, code.co_code, code.co_names, constants


def _constant(value: Any) -> Any:
    if isinstance(value, types.CodeType):
        return fingerprint(value)
    # The order of a set of strings is another in every process.
    return tuple(sorted(map(repr, value))) if isinstance(value, frozenset) else repr(value)


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
        self.code = fingerprint(code)
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
            fingerprint(other.__code__) == self.code
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


class FunctionHandler:
    """Python functions: their code is fixed; what they close over, their defaults and attributes are state.

    Of a function that its module names, defaults and attributes are global, and so is what it closes over if
    that cannot be captured.
    """

    name = "function"

    def capture(self, capture: Capture, obj: types.FunctionType) -> Any:
        if not is_own(obj):
            return FunctionName(obj), capture.attempt(*(obj.__closure__ or ())) or (), None
        variables = zip(obj.__code__.co_freevars, obj.__closure__ or (), strict=True)
        path = " (variable {} of {})"
        cells = [capture.part(cell, path, name, obj.__qualname__) for name, cell in variables]
        return FunctionName(obj), tuple(cells), _capture_extras(capture, obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        name, cells, extras = payload
        if name.is_name_of(current) and id(current) not in restore.foreign:
            restore.memo[index] = current
            if cells:
                for value, cell in zip(cells, current.__closure__ or (), strict=True):
                    restore(value, cell)
            _restore_extras(restore, extras, current, live=True)
            return current
        function = name.find()
        if not cells and extras in (None, _NO_EXTRAS):
            return function
        try:
            return _make_another(restore, index, function, cells, extras)
        except SnapshotUnsupportedError:
            if extras is not None:
                raise
            return function


Extras = tuple[Any, Any, Any]

_NO_EXTRAS: Extras = (None, None, ())


def is_own(function: types.FunctionType) -> bool:
    """Return whether a function belongs to one environment: no module names it.

    :param function: the function.
    """
    if "<" in function.__qualname__:
        return True
    found: Any = sys.modules.get(function.__module__)
    for part in function.__qualname__.split("."):
        found = getattr(found, part, None)
    return found is not function


def _extras(function: types.FunctionType) -> Extras:
    """Return the defaults and keyword defaults of a function, if they can change, and its attributes."""
    defaults, keywords = function.__defaults__, function.__kwdefaults__
    return (
        None if defaults is None or ATOMIC_CLASSES.issuperset(map(type, defaults)) else defaults,
        None if keywords is None or ATOMIC_CLASSES.issuperset(map(type, keywords.values())) else keywords,
        tuple((name, value) for name, value in vars(function).items() if name != _WRAPPED),
    )


def _capture_extras(capture: Capture, function: types.FunctionType) -> Extras:
    defaults, keywords, attributes = _extras(function)
    where = " (default or attribute of {})", function.__qualname__
    return (
        capture.part(defaults, *where),
        capture.part(keywords, *where),
        tuple((name, capture.part(value, *where)) for name, value in attributes),
    )


def _restore_extras(
    restore: Restore, extras: Extras | None, function: types.FunctionType, live: bool
) -> None:
    """Plan to give a function its defaults and attributes; only a live one's own may be used again."""
    if extras is None:
        return
    for name, value in zip(("__defaults__", "__kwdefaults__"), extras, strict=False):
        if value is not None:
            there = getattr(function, name) if live else None
            restore.do_then(setattr, function, name, restore(value, MISSING if there is None else there))
    have = vars(function) if live else {}
    for name, value in extras[2]:
        restored = restore(value, have.get(name, MISSING))
        if restored is not MISSING:
            restore.do_then(setattr, function, name, restored)
    kept = {_WRAPPED, *(name for name, _ in extras[2])}
    for name in vars(function).keys() - kept:
        restore.do_then(delattr, function, name)


def _make_another(
    restore: Restore, index: int, function: types.FunctionType, cells: tuple[Ref, ...], extras: Extras | None
) -> types.FunctionType:
    """Make a function with cells of its own: those of the one at hand belong to another instance."""
    missing = [ref for ref in cells if ref.index not in restore.memo]
    restore.memo.update((ref.index, types.CellType()) for ref in missing)
    made = restore.memo[index] = _with_cells(function, tuple(restore.memo[ref.index] for ref in cells))
    for ref in missing:
        _fill(restore, restore.memo[ref.index], restore.nodes[ref.index][1])
    _restore_extras(restore, extras, made, live=False)
    return made


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


class CellHandler:
    """The variables that functions close over."""

    name = "cell"

    def capture(self, capture: Capture, obj: types.CellType) -> Any:
        try:
            content = obj.cell_contents
        except ValueError:
            return _EMPTY
        return ("full", capture(content))

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        if current is MISSING:
            made = restore.memo[index] = types.CellType()
            _fill(restore, made, payload)
            return made
        restore.memo[index] = current
        have = _content(current)
        value = MISSING if payload == _EMPTY else restore(payload[1], have)
        if value is not have and value is not MISSING:
            restore.do_then(setattr, current, "cell_contents", value)
        return current


def _fill(restore: Restore, cell: types.CellType, payload: Any) -> None:
    """Give a cell that was just made its content."""
    value = MISSING if payload == _EMPTY else restore(payload[1])
    if value is not MISSING:
        cell.cell_contents = value


def _content(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except (AttributeError, ValueError):
        return MISSING


class MethodHandler:
    """Methods bound to an object."""

    name = "method"

    def capture(self, capture: Capture, obj: types.MethodType) -> Any:
        return capture(function_of(obj)), capture(obj.__self__)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        is_method = isinstance(current, types.MethodType)
        function = restore(payload[0], current.__func__ if is_method else MISSING)
        made = bound(function, restore(payload[1], current.__self__ if is_method else MISSING))
        return current if made == current else made


class BuiltinMethodHandler:
    """Compiled functions, and methods of compiled classes such as ``Generator.normal``."""

    name = "builtin"

    def capture(self, capture: Capture, obj: types.BuiltinMethodType) -> Any:
        owner = obj.__self__
        if owner is None or isinstance(owner, types.ModuleType):
            return obj, None
        return obj.__name__, capture(owner)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        name, owner = payload
        if owner is None:
            return name
        return getattr(restore(owner, getattr(current, "__self__", MISSING)), name)
