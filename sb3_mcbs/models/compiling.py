"""Compiling functions with numba: no GIL, NumPy's arithmetic to the bit, kept on disk.

With ``NUMBA_DISABLE_JIT=1`` everything here runs as plain Python, slowly and with the same results.
"""

import hashlib
import logging
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import CodeType, FunctionType
from typing import Any

import numba
import numba.core.config
import numpy as np
from numba.core import event

logger = logging.getLogger("sb3_mcbs")

#: Divisions by zero give infinity or NaN, as with NumPy. Without ``fastmath`` nothing is reordered or fused.
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}

JIT_IS_OFF = bool(getattr(numba.core.config, "DISABLE_JIT"))  # noqa: B009

#: Compiles a small function that other compiled functions call.
compiled = numba.njit(**OPTIONS)

_said: set[str] = set()


def _say_once(message: str) -> None:
    if message not in _said:
        _said.add(message)
        logger.info(message)


def specialize(function: Callable[..., Any], name: str, **inserted: Any) -> Callable[..., Any]:
    """Compile a copy of a function, with other values for some of its global names.

    This is how a loop over rows calls the functions of one family. numba's own ways of passing a function to
    a compiled one are not cached on disk.

    The code is kept where numba keeps it: in ``NUMBA_CACHE_DIR``, beside the source file, or in the user's
    cache folder, whichever can be written.

    :param function: a plain function of this package.
    :param name: distinguishes the copies in the cache's file names.
    :param inserted: the values of global names.
    :return: the compiled copy.
    """
    copy = with_names(function, inserted)
    # numba notices changes in the file of the function only. The name makes it notice all others.
    copy.__qualname__ = f"{function.__name__}-{name}-{fingerprint(copy)}"
    try:
        result: Callable[..., Any] = numba.njit(cache=True, **OPTIONS)(copy)
    except RuntimeError:
        _say_once(
            "Compiled code is not kept, and is compiled again in every process: no cache folder can be "
            "written. NUMBA_CACHE_DIR can name one."
        )
        result = numba.njit(**OPTIONS)(copy)
    return result


def with_names(function: Callable[..., Any], inserted: dict[str, Any]) -> FunctionType:
    """A copy of a function that finds other values under some of its global names.

    :param function: a plain function.
    :param inserted: the values by name.
    """
    assert isinstance(function, FunctionType)
    names = {**function.__globals__, **inserted}
    return FunctionType(function.__code__, names, function.__name__, function.__defaults__)


def announced() -> AbstractContextManager[Any]:
    """A context in which the first compilation is logged; loading from the cache is not."""
    return event.install_listener("numba:compile", _Announcement())


class _Announcement(event.Listener):
    def on_start(self, event: Any) -> None:
        _say_once("compiling the look-ahead for this environment; the next process finds it on disk")

    def on_end(self, event: Any) -> None:
        pass


def fingerprint(function: Callable[..., Any]) -> str:
    """A hash of a function's code and of all that it calls or reads under global names.

    :param function: a plain or compiled function.
    :return: hexadecimal digits.
    """
    digest = hashlib.sha256()
    _add(digest, function, set())
    return digest.hexdigest()[:16]


def _add(digest: Any, value: Any, seen: set[int]) -> None:
    value = getattr(value, "py_func", value)
    if id(value) in seen:
        return
    if isinstance(value, FunctionType):
        seen.add(id(value))
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        read = [value.__globals__[name] for name in _names(value.__code__) if name in value.__globals__]
        for part in (value.__code__, value.__defaults__, cells, read):
            _add(digest, part, seen)
    elif isinstance(value, CodeType):
        digest.update(value.co_code)
        _add(digest, value.co_names + value.co_consts, seen)
    elif isinstance(value, list | tuple):
        for item in value:
            _add(digest, item, seen)
    elif isinstance(value, np.ndarray):
        digest.update(value.tobytes())
    elif isinstance(value, int | float | str | bytes | None):
        digest.update(repr(value).encode())
    else:  # modules, classes, functions of libraries: their versions are in numba's own key, or do not change
        digest.update(getattr(value, "__name__", type(value).__name__).encode())
        _add(digest, getattr(value, "_fields", None), seen)


def _names(code: CodeType) -> list[str]:
    nested = [name for item in code.co_consts if isinstance(item, CodeType) for name in _names(item)]
    return [*code.co_names, *nested]
