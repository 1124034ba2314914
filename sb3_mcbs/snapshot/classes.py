"""Classes that are made inside a function, once per instance: what their methods close over is state."""

import abc
import contextlib
import dis
import enum
import functools
import types
from collections.abc import Callable, Iterator
from typing import Any

from sb3_mcbs.snapshot.errors import SnapshotMismatchError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.functions import fingerprint
from sb3_mcbs.snapshot.object_graph import MISSING, Capture, Restore, class_name

#: Members that Python makes itself, and those that only say what a class is.
_NOT_STATE = frozenset(
    {"__dict__", "__weakref__", "__module__", "__qualname__", "__doc__", "__slots__", "__slotnames__"}
    | {"__annotations__", "__annotate__", "__abstractmethods__", "_abc_impl", "__parameters__"}
    | {"__orig_bases__"}
    | {"__static_attributes__", "__firstlineno__", "__classcell__", "__match_args__", "__dataclass_fields__"}
    | {"__dataclass_params__", "metadata", "spec", "render_mode"}
)
_MADE_BY_PYTHON = (types.MemberDescriptorType, types.GetSetDescriptorType, types.WrapperDescriptorType)
_SHARED_KINDS = ("constant", "window", "space")


class ClassName:
    """Names a class that no module names. In the process where it was made it also knows the class.

    :param cls: the class.
    """

    def __init__(self, cls: type) -> None:
        self.module = cls.__module__
        self.qualname = cls.__qualname__
        self.code = _code_of(cls)
        self.cls: type | None = cls

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "cls": None}

    def is_name_of(self, other: Any) -> bool:
        """Return whether a class was made by the same lines.

        :param other: any object.
        """
        if other is self.cls:
            return True
        return (
            isinstance(other, type)
            and (other.__module__, other.__qualname__) == (self.module, self.qualname)
            and _code_of(other) == self.code
        )

    def find(self) -> type:
        """Return the class.

        :raises SnapshotMismatchError: in another process, where nobody can find it.
        """
        if self.cls is None:
            raise SnapshotMismatchError(
                f"The snapshot is of an environment that uses the class {self.module}.{self.qualname}, which "
                "is made inside a function; this one has another at its place."
            )
        return self.cls


def _code_of(cls: type) -> tuple[Any, ...]:
    return tuple(
        (name, fingerprint(function.__code__))
        for name, member in vars(cls).items()
        for function in _parts(member)
        if isinstance(function, types.FunctionType)
    )


def _parts(member: Any) -> tuple[Any, ...]:
    """Return what a member of a class consists of: a property of its functions, others of themselves."""
    if isinstance(member, property):
        return member.fget, member.fset, member.fdel
    if isinstance(member, staticmethod | classmethod):
        return (member.__func__,)
    if isinstance(member, functools.cached_property):
        return (member.func,)
    return (member,)


def _put_together(member: Any, parts: tuple[Any, ...]) -> Any:
    """Return a member like another one, of other parts."""
    if all(mine is its for mine, its in zip(parts, _parts(member), strict=True)):
        return member
    if isinstance(member, property):
        return property(parts[0], parts[1], parts[2], member.__doc__)
    if isinstance(member, staticmethod | classmethod):
        return type(member)(*parts)
    if isinstance(member, functools.cached_property):
        made = functools.cached_property(*parts)
        made.attrname = member.attrname
        return made
    return parts[0]


def _members(cls: type) -> Iterator[tuple[str, Any]]:
    for name, member in vars(cls).items():
        if name not in _NOT_STATE and not isinstance(member, _MADE_BY_PYTHON):
            yield name, member


def is_local(cls: type) -> bool:
    """Return whether a class was made inside a function.

    :param cls: the class.
    """
    return "<" in cls.__qualname__ and not issubclass(cls, enum.Enum)


def is_made_per_instance(cls: type, handler_of: Callable[[Any], Any]) -> bool:
    """Return whether a class has state: it was made inside a function, and holds or closes over some.

    :param cls: the class.
    :param handler_of: the kind of an object; None if it never changes.
    """
    return _StateSearch(handler_of).is_state(cls)


class _StateSearch:
    """Looks for state among what a class holds and closes over.

    :param handler_of: the kind of an object; None if it never changes.
    """

    def __init__(self, handler_of: Callable[[Any], Any]) -> None:
        self._handler_of = handler_of
        self._seen: list[Any] = []  # classes and functions, which may refer to each other

    def is_state(self, value: Any) -> bool:
        if isinstance(value, tuple | frozenset):
            return any(map(self.is_state, value))
        if not isinstance(value, type | types.FunctionType):
            kind = self._handler_of(value)
            return kind is not None and kind.name not in _SHARED_KINDS
        if any(value is one for one in self._seen):
            return False
        self._seen.append(value)
        if isinstance(value, types.FunctionType):
            return "<" in value.__qualname__ and self._has_state([value])
        if issubclass(value, enum.Enum):
            return False
        return any(self._has_state(_parts_of(base)) for base in value.__mro__ if "<" in base.__qualname__)

    def _has_state(self, parts: list[Any]) -> bool:
        """Return whether some of the parts of a class, or a function alone, are state or hold some."""
        functions = [part for part in parts if isinstance(part, types.FunctionType)]
        rebound = {name for function in functions for name in _rebound(function.__code__)}
        variables = [variable for function in functions for variable in _variables(function)]
        held = [value for function in functions for value in _held(function)]
        contents = [content for name, content in variables if name != "__class__"]
        return any(name in rebound for name, _ in variables) or any(
            map(self.is_state, (*parts, *held, *contents))
        )


def _parts_of(cls: type) -> list[Any]:
    return [part for _, member in _members(cls) for part in _parts(member)]


def _held(function: types.FunctionType) -> list[Any]:
    """The defaults and the attributes of a function."""
    attributes = [value for name, value in vars(function).items() if name != "__wrapped__"]
    return [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values(), *attributes]


def _variables(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """The variables that a function closes over, and what they hold."""
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # empty
            yield name, cell.cell_contents


def _rebound(code: types.CodeType) -> Iterator[str]:
    """The variables that a function declares ``nonlocal`` and assigns to."""
    for instruction in dis.get_instructions(code):
        if instruction.opname == "STORE_DEREF" and instruction.argval in code.co_freevars:
            yield instruction.argval
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _rebound(constant)


class LocalClassHandler:
    """Other classes that are made inside functions: another instance of the environment may have its own."""

    name = "local class"

    def capture(self, capture: Capture, obj: type) -> Any:
        return ClassName(obj)

    def restore(self, restore: Restore, index: int, payload: ClassName, current: Any) -> Any:
        return current if payload.is_name_of(current) else payload.find()


class ClassHandler:
    """Classes that are made per instance: their attributes, and what their methods close over, are state."""

    name = "class"

    def capture(self, capture: Capture, obj: type) -> Any:
        path = " ({} of the class {})"
        members = tuple(
            (name, tuple(capture.part(part, path, name, obj.__qualname__) for part in _parts(member)))
            for name, member in _members(obj)
        )
        return ClassName(obj), tuple(capture(base) for base in obj.__bases__), members

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        name, bases, members = payload
        if name.is_name_of(current) and id(current) not in restore.foreign:
            restore.memo[index] = current
            for base, its in zip(bases, current.__bases__, strict=True):
                restore(base, its)
            for key, parts in members:
                member = vars(current).get(key)
                restored = _put_together(member, _restore_parts(restore, parts, _parts(member)))
                if restored is not member:
                    restore.do_then(type.__setattr__, current, key, restored)
            return current
        template = name.find()
        # What the class at hand closes over may be another instance's.
        made = restore.memo[index] = _blank(template, tuple(restore(base) for base in bases))
        for key, parts in members:
            member = vars(template)[key]
            type.__setattr__(made, key, _put_together(member, _restore_parts(restore, parts, (MISSING,) * 3)))
        return made


def _restore_parts(restore: Restore, parts: tuple[Any, ...], have: tuple[Any, ...]) -> tuple[Any, ...]:
    return tuple(restore(part, its) for part, its in zip(parts, have, strict=False))


def _blank(cls: type, bases: tuple[type, ...]) -> Any:
    """Make a class like another one, without its members."""
    namespace = {name: vars(cls)[name] for name in _NOT_STATE & vars(cls).keys()}
    namespace["__qualname__"] = cls.__qualname__
    for name in ("__dict__", "__weakref__", "_abc_impl", "__slotnames__"):
        namespace.pop(name, None)
    # Whose subclasses are abstract keeps a cache in each of its own.
    is_abstract = isinstance(cls, abc.ABCMeta)
    try:
        made: Any = (abc.ABCMeta if is_abstract else type).__new__(type(cls), cls.__name__, bases, namespace)
    except Exception as error:
        raise SnapshotUnsupportedError(
            f"the class {class_name(cls)} is made inside a function and cannot be made again: {error}"
        ) from error
    if is_abstract:  # what its methods implement is to follow
        made.__abstractmethods__ = cls.__abstractmethods__  # type: ignore[attr-defined]
    return made
