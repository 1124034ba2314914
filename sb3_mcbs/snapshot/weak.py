"""Weak references and proxies: what they stand for is held by something else, and captured with that."""

import weakref
from collections.abc import Iterable
from typing import Any

from sb3_mcbs.snapshot.errors import SnapshotUnsupportedError
from sb3_mcbs.snapshot.object_graph import MISSING, Capture, Ref, Restore, class_name

PROXIES = (weakref.ProxyType, weakref.CallableProxyType)


class ProxyHandler:
    """Weak proxies."""

    name = "proxy"

    def capture(self, capture: Capture, obj: Any) -> Any:
        referent = _referent(obj)
        return None if referent is MISSING else capture(referent)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        if payload is None:  # it stood for nothing any more
            return weakref.proxy(_Gone()) if current is MISSING else current
        have = _referent(current) if type(current) in PROXIES else MISSING
        referent = restore(payload, have)
        return current if referent is have or referent is MISSING else weakref.proxy(referent)


def _referent(proxy: Any) -> Any:
    """Return what a proxy stands for; ``MISSING`` if that is gone."""
    try:
        return proxy.__reduce_ex__.__self__  # a proxy passes on what it is asked for
    except ReferenceError:
        return MISSING


class _Gone:
    """What a dead reference referred to: its objects are gone at once."""


class WeakrefHandler:
    """Weak references. What they stand for must be held by the environment: see :func:`check_held`."""

    name = "weakref"

    def capture(self, capture: Capture, obj: Any) -> Any:
        referent = _held_by(obj)
        if referent is None:
            return None
        capture.weak = True
        return capture(referent)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        have = current() if type(current) is weakref.ref else MISSING
        if payload is None:
            return current if have is None else weakref.ref(_Gone())
        referent = restore(payload, MISSING if have is None else have)
        return current if referent is have or referent is MISSING else weakref.ref(referent)


def _held_by(reference: Any) -> Any:
    """Return what a weak reference stands for; None if that is gone."""
    if reference.__callback__ is not None:
        raise SnapshotUnsupportedError(
            f"a {class_name(type(reference))} with a callback is more than a reference"
        )
    return reference()


def check_held(capture: Capture, roots: Iterable[Any]) -> None:
    """Refuse weak references to what nothing else holds: in a copy that would be gone at once.

    :param capture: has captured all that belongs together.
    :param roots: the captured values that the environment consists of.
    :raises SnapshotUnsupportedError: if there is one.
    """
    if not capture.weak:
        return
    seen: set[int] = set()
    waiting = list(roots)
    while waiting:
        value = waiting.pop()
        if isinstance(value, tuple | list):
            waiting.extend(value)
        elif isinstance(value, dict):
            waiting.extend(value.values())
        elif type(value) is Ref and value.index not in seen:
            seen.add(value.index)
            kind, payload = capture.nodes[value.index]
            if kind != "weakref":
                waiting.append(payload)
    for kind, payload in capture.nodes:
        if kind == "weakref" and type(payload) is Ref and payload.index not in seen:
            if capture.nodes[payload.index][0] == "known":
                continue
            raise SnapshotUnsupportedError(
                "A weak reference of the environment is to a "
                f"{class_name(type(capture.objects[payload.index]))} that nothing else in it holds, so that "
                "it cannot be captured. Keep the object itself in an attribute."
            )
