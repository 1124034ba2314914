"""MuJoCo's warnings, each shown once in a process."""

import contextlib
import re
import sys

import mujoco

_NUMBER = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
#: About HalfCheetah's XML, which is part of Gymnasium. Every process that makes one would show it.
_OF_GYMNASIUM = "compiler attribute 'settotalmass' is deprecated"
_shown: set[str] = set()


def show_warnings_once() -> None:
    """Show each of MuJoCo's warnings once, and not for each environment that is made.

    Warnings that differ in numbers only are the same. A handler that somebody else has set stays, and one
    that is set later replaces this one. MuJoCo's errors are not affected.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_show)


def _show(message: str) -> None:
    """Show a warning as MuJoCo does by itself, once."""
    kind = _NUMBER.sub("", message)
    if kind in _shown or _OF_GYMNASIUM in message:
        return
    _shown.add(kind)
    # MuJoCo ends the process if this raises: nobody may be reading, or the stream be closed.
    with contextlib.suppress(OSError, ValueError, AttributeError):
        print(f"WARNING: {message}\n(sb3-mcbs shows each of MuJoCo's warnings once.)\n", file=sys.stderr)
    mujoco.mju_writeLog("WARNING", message)
