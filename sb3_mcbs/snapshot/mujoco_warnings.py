"""MuJoCo's warnings, each shown once in a process."""

import re
import sys

import mujoco

_NUMBER = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
_shown: set[str] = set()


def show_warnings_once() -> None:
    """Show each of MuJoCo's warnings once, and not for each environment that is made.

    Warnings that differ in numbers only are the same. A handler that somebody else has set stays.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_show)


def _show(message: str) -> None:
    """Show a warning as MuJoCo does by itself, once. MuJoCo ends the process if this raises."""
    kind = _NUMBER.sub("", message)
    if kind not in _shown:
        _shown.add(kind)
        print(f"WARNING: {message}\n(sb3-mcbs shows each of MuJoCo's warnings once.)\n", file=sys.stderr)
        mujoco.mju_writeLog("WARNING", message)
