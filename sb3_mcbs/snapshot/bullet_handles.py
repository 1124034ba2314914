"""Where an environment holds the handles of PyBullet's physics servers, and whether it uses PyBullet at all.

A handle is an integer, which nothing tells from any other integer but the name it is kept under.
"""

import functools
import inspect
import re
import types
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import gymnasium as gym
import numpy as np

from sb3_mcbs.snapshot.bullet_world import is_connected
from sb3_mcbs.snapshot.layers import NOT_STATE, RECORDER
from sb3_mcbs.snapshot.object_graph import ATOMIC_CLASSES
from sb3_mcbs.snapshot.objects import attributes_of, is_ordinary, set_attributes

# client, physicsClientId, _physics_client, CLIENT, sim_id, physics_server, but not ownsPhysicsClient: a flag
# that is 0 would be taken for the first server's handle.
_SIMULATOR = "physics|pybullet|bullet|pb|sim|simulation"
_HANDLE = re.compile(rf"_*(({_SIMULATOR})?_?(client|server)|{_SIMULATOR})(_?u?id|_?handle)?", re.IGNORECASE)
_LEFT_OUT = NOT_STATE | {RECORDER, "reset", "step", "close", "_np_random", "np_random"}
_LEAVES = (np.ndarray, np.generic, np.random.Generator, gym.Space, types.ModuleType, type)
_CONTAINERS = (
    dict, list, tuple, set, frozenset, deque,
    functools.partial, types.MethodType, types.FunctionType,
)  # fmt: skip
# Packages whose classes do not use PyBullet.
_STANDARD = ("builtins", "gymnasium", "collections", "functools", "types")
# How deep functions that methods call are looked into.
_DEPTH = 2


class Handle(int):
    """The handle of a physics server, told from other integers.

    Snapshots do not hold its value: each instance of an environment keeps its own.

    :ivar recorder: what records the episodes of the environment that holds it.
    """

    recorder: Any

    def __reduce__(self) -> tuple[type, tuple[int]]:
        return int, (int(self),)

    def __copy__(self) -> int:
        return int(self)

    def __deepcopy__(self, memo: Any) -> int:
        return int(self)


class Place(NamedTuple):
    """Where a handle is kept.

    :param holder: the object, dictionary or cell that holds it.
    :param name: under which name.
    :param value: the integer.
    """

    holder: Any
    name: str
    value: int

    def put(self, value: int) -> None:
        """Exchange the integer.

        :param value: the new one.
        """
        if isinstance(self.holder, dict):
            self.holder[self.name] = value
        elif isinstance(self.holder, types.CellType):
            self.holder.cell_contents = value
        else:
            set_attributes(self.holder, {self.name: value})


class _Class(NamedTuple):
    """What a class is, as far as handles are concerned.

    :param client: whether it is a ``BulletClient``.
    :param looked_into: whether its objects may hold handles.
    """

    client: bool
    looked_into: bool


_by_class: WeakKeyDictionary[type, _Class] = WeakKeyDictionary()


def _class_of(obj: Any) -> _Class:
    cls = type(obj)
    known = _by_class.get(cls)
    if known is None:
        client = _is_client_class(cls)
        holds = issubclass(cls, _CONTAINERS) or is_ordinary(cls)
        known = _by_class[cls] = _Class(client, holds and not issubclass(cls, _LEAVES))
    return known


def is_client(obj: Any) -> bool:
    """Return whether an object is a ``BulletClient``: PyBullet's functions, bound to one server.

    :param obj: any object.
    """
    return _is_client_class(type(obj)) and "_client" in vars(obj)


def _is_client_class(cls: type) -> bool:
    return any(base.__name__ == "BulletClient" for base in cls.__mro__)


def find(env: Any, names: frozenset[str] | None) -> tuple[list[Place], list[Any]]:
    """Find the handles that an environment holds.

    :param env: the environment.
    :param names: the names that integers are kept under; None if that is not known. Integers then count if
        their name says that they are handles, and objects of class ``BulletClient``, if there are any, agree.
    :return: the places of integers, and the objects of class ``BulletClient``.
    """
    places: list[Place] = []
    clients: list[Any] = []
    for obj, inside in _objects_of(env):
        if _class_of(obj).client:
            clients.append(obj)
        for name, value, holder in inside:
            cls = type(value)
            if (cls is int or cls is Handle) and _is_handle(name, names) and is_connected(value):
                assert name is not None
                places.append(Place(holder, name, value))
    bound = {client._client for client in clients if is_connected(client._client)}
    if bound and names is None:
        places = [place for place in places if place.value in bound]
    return places, clients


def _is_handle(name: str | None, names: frozenset[str] | None) -> bool:
    if name is None:
        return False
    return name in names if names is not None else _sounds_like_handle(name)


@functools.lru_cache(maxsize=4096)
def _sounds_like_handle(name: str) -> bool:
    return _HANDLE.fullmatch(name) is not None


def _objects_of(env: Any) -> Iterator[tuple[Any, list[tuple[str | None, Any, Any]]]]:
    """Go through the objects that an environment consists of, itself first, each with what is inside it."""
    queue = deque([env])
    met = {id(env)}
    while queue:
        obj = queue.popleft()
        inside = [] if _class_of(obj).client else _inside(obj)
        yield obj, inside
        for _, value, _ in inside:
            if type(value) not in ATOMIC_CLASSES and id(value) not in met:
                met.add(id(value))
                if _class_of(value).looked_into:
                    queue.append(value)


def _inside(obj: Any) -> list[tuple[str | None, Any, Any]]:
    """Return the name of each value inside an object, the value, and what holds it."""
    if isinstance(obj, dict):
        return [(key if isinstance(key, str) else None, value, obj) for key, value in obj.items()]
    if isinstance(obj, list | tuple | set | frozenset | deque):
        return [(None, value, obj) for value in obj if type(value) not in ATOMIC_CLASSES]
    if isinstance(obj, functools.partial):
        return [(None, value, obj) for value in (obj.func, obj.args, obj.keywords)]
    if isinstance(obj, types.MethodType):
        return [(None, value, obj) for value in (obj.__self__, obj.__func__)]
    if isinstance(obj, types.FunctionType):
        cells = zip(obj.__code__.co_freevars, obj.__closure__ or (), strict=True)
        return [(name, cell.cell_contents, cell) for name, cell in cells if not _is_empty(cell)]
    attributes = attributes_of(obj)
    if isinstance(obj, gym.Env):  # in one order in every instance: it numbers the servers
        return [(name, attributes[name], obj) for name in sorted(attributes.keys() - _LEFT_OUT)]
    return [(name, value, obj) for name, value in attributes.items()]


def _is_empty(cell: types.CellType) -> bool:
    try:
        return cell.cell_contents is None
    except ValueError:
        return True


def uses_bullet(env: Any) -> bool:
    """Return whether an object is an environment that uses PyBullet.

    It does if its methods, or those of an object that it holds, refer to PyBullet's module. That can be seen
    before it has connected to anything.

    :param env: an environment, a wrapper, or an object that one holds.
    """
    if not isinstance(env, gym.Env) or isinstance(env, gym.Wrapper):
        return False
    return any(is_client(obj) or _class_uses_bullet(type(obj)) for obj, _ in _objects_of(env))


def _class_uses_bullet(cls: type) -> bool:
    for base in cls.__mro__:
        if base.__module__.partition(".")[0] in _STANDARD:
            continue
        for member in vars(base).values():
            if isinstance(member, property):
                functions = [member.fget, member.fset]
            else:
                functions = [getattr(member, "__func__", member)]
            if any(_function_uses_bullet(function, _DEPTH) for function in functions):
                return True
    return False


def _function_uses_bullet(function: Any, depth: int) -> bool:
    if isinstance(function, types.FunctionType):
        function = inspect.unwrap(function)
    if not isinstance(function, types.FunctionType):
        return False
    names = _names_in(function.__code__)
    if "pybullet" in names:
        return True
    for name in names:
        value = function.__globals__.get(name)
        if _is_bullet(value) or (depth and _function_uses_bullet(value, depth - 1)):
            return True
    return False


def _names_in(code: types.CodeType) -> set[str]:
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            names |= _names_in(constant)
    return names


def _is_bullet(value: Any) -> bool:
    """Return whether a global is PyBullet's module, one of its functions, or what is built around it."""
    if isinstance(value, types.ModuleType):
        return value.__name__.rpartition(".")[2] in ("pybullet", "bullet_client")
    return (
        getattr(value, "__module__", None) == "pybullet" or getattr(value, "__name__", None) == "BulletClient"
    )
