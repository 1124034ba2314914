"""Stand-ins for the wrappers that clones leave out: SB3's ``Monitor``, and those that draw or record."""

import dis
import functools
import types
from collections.abc import Callable
from typing import Any

import gymnasium as gym

from sb3_mcbs.snapshot.object_graph import class_name

MONITOR = "stable_baselines3.common.monitor.Monitor"
_LEFT_OUT = frozenset(
    {
        MONITOR,
        "gymnasium.wrappers.rendering.RecordVideo",
        "gymnasium.wrappers.rendering.RenderCollection",
        "gymnasium.wrappers.rendering.HumanRendering",
        "sb3_mcbs.snapshot.wrapper.SnapshotEnvWrapper",
    }
)


@functools.lru_cache(maxsize=256)
def left_out_class(cls: type) -> type | None:
    """Return the wrapper that clones leave out and that a class is or derives from, None if there is none.

    :param cls: the class of a wrapper.
    """
    return next((base for base in cls.__mro__ if class_name(base) in _LEFT_OUT), None)


@functools.lru_cache(maxsize=64)
def set_by(cls: type) -> frozenset[str]:
    """Name the attributes that the methods of a class set on its objects. All else was set by others.

    :param cls: the class.
    """
    methods = [member for member in vars(cls).values() if isinstance(member, types.FunctionType)]
    return frozenset(
        instruction.argval
        for method in methods
        for instruction in dis.get_instructions(method)
        if instruction.opname == "STORE_ATTR"
    )


class StandIn(gym.Wrapper[Any, Any, Any, Any]):
    """Replaces a wrapper in a clone: holds what others have set on the wrapper, and does nothing itself."""

    stands_for: type

    def __getattr__(self, name: str) -> Any:
        stands_for = type(self).stands_for.__name__
        raise AttributeError(
            f"copies of an environment are made without its {stands_for}, and what stands in its place has "
            f"no attribute {name!r}"
        )

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[type], dict[str, Any]]:
        return _blank, (type(self).stands_for,), vars(self)


def _blank(cls: type) -> Any:
    return object.__new__(stand_in(cls))


@functools.lru_cache(maxsize=64)
def stand_in(cls: type) -> type[StandIn]:
    """Return the class of the stand-in for a wrapper.

    :param cls: the wrapper's class. What a derived class adds to the left-out one goes on working.
    """
    known = left_out_class(cls)
    assert known is not None
    bases: tuple[Any, ...] = (StandIn,)
    if cls is not known:
        passed_on = {name: vars(gym.Wrapper)[name] for name in ("reset", "step", "render", "close")}
        bases = (StandIn, cls, type(known.__name__, (known,), passed_on))
    return type(f"StandIn{cls.__name__}", bases, {"stands_for": cls, "__module__": __name__})


def function_of(method: types.MethodType) -> Any:
    """Return the function of a bound method; of a stand-in's own, that of what it stands for.

    :param method: the method.
    """
    cls = type(method.__self__)
    if issubclass(cls, StandIn):
        return _exchanged(method.__func__, cls, cls.stands_for)
    return method.__func__


def bound(function: Any, owner: Any) -> Any:
    """Bind a function to an object, as a method.

    :param function: of :func:`function_of`.
    :param owner: the object. A stand-in has methods of its own instead of those of what it stands for.
    """
    cls = type(owner)
    if issubclass(cls, StandIn):
        function = _exchanged(function, cls.stands_for, cls)
    return types.MethodType(function, owner)


def _exchanged(function: Any, cls: type, other: type) -> Any:
    """Return the method of ``other`` that replaces a method of ``cls``; any other function stays."""
    name, code = getattr(function, "__name__", ""), getattr(function, "__code__", None)
    if code is None or getattr(getattr(cls, name, None), "__code__", None) is not code:
        return function
    return getattr(other, name, function)
