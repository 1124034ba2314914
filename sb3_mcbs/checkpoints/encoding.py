"""Captured state as data: JSON and plain arrays, and back, without ever importing or unpickling.

A captured value (:mod:`sb3_mcbs.snapshot.object_graph`) consists of plain values, arrays, and names of
classes and functions. Only their names are written. They are resolved among the classes and functions that
the reader hands in, because its own agent and environments use them.
"""

import enum
import functools
import hashlib
import math
import pathlib
import re
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
import torch as th

from sb3_mcbs.checkpoints.errors import CheckpointError
from sb3_mcbs.snapshot.classes import ClassName
from sb3_mcbs.snapshot.functions import FunctionName
from sb3_mcbs.snapshot.object_graph import Ref, class_name

#: Compiled containers that are made by calling their class; nothing else is ever called. Making a partial
#: calls nothing, and what it will call is among the functions that may be named.
CALLED = (OrderedDict, defaultdict, functools.partial)
_PLAIN_DTYPES = "biufc"


class Encoded(NamedTuple):
    """A captured value as data.

    :param json: what ``json.dumps`` takes.
    :param arrays: the content of all arrays, joined, by the name of their dtype.
    """

    json: Any
    arrays: dict[str, np.ndarray]


#: Name of a class -> the functions that turn its objects into plain data and back.
_registered: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {}


def register_state(cls: type, to_data: Callable[[Any], Any], from_data: Callable[[Any], Any]) -> None:
    """Say how the objects of a class are written into checkpoints.

    :param cls: the class; not those derived from it.
    :param to_data: given an object, returns what it consists of: numbers, text, bytes, arrays, tensors,
        lists, tuples and dictionaries of those, or objects of other classes that can be written.
    :param from_data: given that, returns an equal object.
    """
    if not isinstance(cls, type) or not callable(to_data) or not callable(from_data):
        raise TypeError("register_state takes a class and two functions.")
    _registered[class_name(cls)] = to_data, from_data


def is_registered(cls: type) -> bool:
    """Whether :func:`register_state` was called for a class.

    :param cls: the class.
    """
    return class_name(cls) in _registered


def in_section(section: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Name arrays as one of several sections of a file.

    :param section: its name.
    :param arrays: by name.
    """
    return {f"{section}|{name}": array for name, array in arrays.items()}


def of_section(section: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays that :func:`in_section` named.

    :param section: its name.
    :param arrays: of all sections.
    """
    start = f"{section}|"
    return {name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)}


class Encoder:
    """Turns captured values into data.

    :ivar names: the classes and functions that were met, by the names that stand for them.
    """

    def __init__(self) -> None:
        self.names: dict[str, Any] = {}
        self._arrays: dict[str, list[np.ndarray]] = {}
        self._sizes: dict[str, int] = {}

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The content of all arrays that were encoded so far, joined, by the name of their dtype."""
        return {name: np.concatenate(parts) for name, parts in self._arrays.items()}

    def encode(self, value: Any) -> Any:
        """Encode a value.

        :param value: a captured value.
        :raises CheckpointError: if part of it is neither plain nor registered.
        """
        cls = type(value)
        if value is None or cls in (bool, int, str):
            return value
        if cls is float:
            return value if math.isfinite(value) else {"float": str(value)}
        if cls is Ref:
            return {"ref": value.index}
        if cls is list:
            return [self.encode(item) for item in value]
        if cls is tuple:
            return {"tuple": [self.encode(item) for item in value]}
        if cls is dict:
            return {"dict": [[self.encode(key), self.encode(item)] for key, item in value.items()]}
        if cls is np.ndarray:
            return {"array": self._array(value)}
        if cls is bytes:
            return {"bytes": self._array(np.frombuffer(value, np.uint8))}
        return self._encode_rare(value, cls)

    def _encode_rare(self, value: Any, cls: type) -> Any:
        if is_registered(cls):
            to_data, _ = _registered[class_name(cls)]
            return {"registered": [class_name(cls), self.encode(to_data(value))]}
        if isinstance(value, np.generic) and value.dtype.kind in _PLAIN_DTYPES:
            return {"scalar": self._array(np.asarray(value))}
        if isinstance(value, np.dtype):
            return {"dtype": _plain_dtype(value)}
        if isinstance(value, enum.Enum):
            return {"enum": [self._name(cls), value.name]}
        if isinstance(value, pathlib.PurePath):
            return {"path": str(value)}
        if cls is complex:
            return {"complex": [self.encode(value.real), self.encode(value.imag)]}
        return {"name": self._name(value)}

    def encode_nodes(self, nodes: tuple[tuple[str, Any], ...]) -> Any:
        """Encode the nodes that captured values refer to.

        :param nodes: kind and payload of each.
        :raises CheckpointError: if one can only be made by calling something.
        """
        for kind, payload in nodes:
            if kind == "reduced" and payload[0] not in CALLED:
                name = self._name(payload[0]) if not isinstance(payload[0], Ref) else "a function"
                raise CheckpointError(
                    f"An object that is made by calling {name} cannot be written as data. Register a pair of "
                    "functions for its class with sb3_mcbs.checkpoints.register_state."
                )
            if kind == "builtin" and payload[1] is not None:
                self.names[_method_name(payload[0])] = payload[0]
        return [[kind, self.encode(payload)] for kind, payload in nodes]

    def _array(self, array: np.ndarray) -> list[Any]:
        dtype = _plain_dtype(array.dtype)
        order: Literal["C", "F"] = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
        start = self._sizes.get(dtype, 0)
        self._arrays.setdefault(dtype, []).append(array.ravel(order=order))
        self._sizes[dtype] = start + array.size
        return [dtype, start, list(array.shape), order]

    def _name(self, value: Any) -> str:
        name = name_of(value)
        if isinstance(value, FunctionName | ClassName):
            value = value.function if isinstance(value, FunctionName) else value.cls
        self.names[name] = value
        return name


class Decoder:
    """Turns data back into captured values.

    :param arrays: of :class:`Encoded`.
    :param names: the classes and functions that may be meant, by name.
    """

    def __init__(self, arrays: Mapping[str, np.ndarray], names: Mapping[str, Any]) -> None:
        self._arrays = arrays
        self._names = names

    def decode(self, data: Any) -> Any:
        """Decode a value.

        :param data: from :meth:`Encoder.encode`.
        :raises CheckpointError: if it is not, or names a class or function that is not known here.
        """
        if type(data) is list:
            return [self.decode(item) for item in data]
        if type(data) is not dict:
            return data
        if len(data) != 1:
            raise CheckpointError(f"The checkpoint has a value with the keys {sorted(data)}.")
        ((tag, content),) = data.items()
        decode_tag = _TAGS.get(tag)
        if decode_tag is None:
            raise CheckpointError(f"The checkpoint has a value of unknown kind {tag!r}.")
        return decode_tag(self, content)

    def decode_nodes(self, data: Any) -> tuple[tuple[str, Any], ...]:
        """Decode nodes.

        :param data: from :meth:`Encoder.encode_nodes`.
        """
        nodes = tuple((kind, self.decode(payload)) for kind, payload in data)
        for kind, payload in nodes:
            if kind == "reduced" and payload[0] not in CALLED:
                raise CheckpointError("The checkpoint asks for a call that no checkpoint needs.")
            if kind == "builtin" and payload[1] is not None and _method_name(payload[0]) not in self._names:
                raise CheckpointError(f"The checkpoint names a method {payload[0]!r} that is not used here.")
        return nodes

    def _array(self, place: Any) -> np.ndarray:
        dtype, start, shape, order = place
        size = math.prod(shape)
        joined = self._arrays.get(dtype, np.empty(0, _checked_dtype(dtype)))
        if start < 0 or size < 0 or start + size > len(joined):
            raise CheckpointError("The checkpoint refers to numbers beyond those that it holds.")
        return joined[start : start + size].reshape(shape, order=order).copy(order=order)

    def _registered(self, content: Any) -> Any:
        name, data = content
        if name not in _registered:
            raise CheckpointError(
                f"The checkpoint holds a {name}, which is not registered here. Import what calls "
                "register_state for it before you resume."
            )
        _, from_data = _registered[name]
        return from_data(self.decode(data))

    def _named(self, name: str) -> Any:
        if name not in self._names:
            raise CheckpointError(
                f"The checkpoint refers to {name}, which neither this agent nor its environments use. If you "
                "trust it, pass it: resume(path, classes=[...])."
            )
        value = self._names[name]
        wrap = _WRAPPED.get(name.partition(" ")[0])
        return value if wrap is None else wrap(value)


_TAGS: dict[str, Callable[[Decoder, Any], Any]] = {
    "float": lambda decoder, content: float(content),
    "complex": lambda decoder, content: complex(*decoder.decode(content)),
    "ref": lambda decoder, content: Ref(int(content)),
    "tuple": lambda decoder, content: tuple([decoder.decode(item) for item in content]),
    "dict": lambda decoder, content: {decoder.decode(key): decoder.decode(item) for key, item in content},
    "array": lambda decoder, content: decoder._array(content),
    "bytes": lambda decoder, content: decoder._array(content).tobytes(),
    "scalar": lambda decoder, content: decoder._array(content)[()],
    "dtype": lambda decoder, content: _checked_dtype(content),
    "enum": lambda decoder, content: decoder._named(content[0]).__members__[content[1]],
    "path": lambda decoder, content: pathlib.Path(content),
    "registered": lambda decoder, content: decoder._registered(content),
    "name": lambda decoder, content: decoder._named(content),
}


#: What stands for a function, or for a class that was made inside one: by the first word of its name.
_WRAPPED: dict[str, Any] = {"function": FunctionName, "local": ClassName}


def name_of(value: Any) -> str:
    """Return the name that stands for a class or function, or for a constant of another kind.

    :param value: a class, a function (as captured), a compiled function, a pattern or the like.
    :raises CheckpointError: if it is an object that has no name.
    """
    if isinstance(value, type):
        return f"class {class_name(value)}"
    for word, cls in _WRAPPED.items():
        if isinstance(value, cls):
            digest = hashlib.sha256(repr(value.code).encode()).hexdigest()[:16]
            return f"{word} {value.module}.{value.qualname} {digest}"
    if isinstance(value, re.Pattern | np.ufunc):
        return f"constant {value!r}"
    qualname = getattr(value, "__qualname__", None)
    if isinstance(qualname, str):
        return f"compiled {getattr(value, '__module__', None)}.{qualname}"
    raise CheckpointError(
        f"A {class_name(type(value))} cannot be written as data. Register a pair of functions for its "
        "class with sb3_mcbs.checkpoints.register_state."
    )


def _method_name(name: str) -> str:
    return f"method {name}"


def _plain_dtype(dtype: np.dtype) -> str:
    if dtype.kind not in _PLAIN_DTYPES + "US" or dtype.hasobject:
        raise CheckpointError(f"An array of {dtype} cannot be written as data.")
    return dtype.str


def _checked_dtype(name: str) -> np.dtype:
    dtype = np.dtype(str(name))
    _plain_dtype(dtype)
    return dtype


register_state(th.device, str, lambda data: th.device(str(data)))
