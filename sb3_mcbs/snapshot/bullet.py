"""PyBullet: environments that hold the handle of a physics server, an integer.

The world behind the handle is saved to bytes and put back from them. PyBullet tells no more than its saved
states hold (see :mod:`sb3_mcbs.snapshot.bullet_world`), which is enough for some environments and not for
others. So none is known to be exact, and the check before the first snapshot is longer than usual. Where
saved states are not exact, the episode is replayed; where that is not exact either, it is refused.
"""

import functools
import os
import time
import weakref
from collections.abc import Callable
from typing import Any
from weakref import WeakSet, finalize

from sb3_mcbs.snapshot.bullet_handles import Handle, is_client
from sb3_mcbs.snapshot.bullet_recorder import (
    BulletRecorder,
    BulletState,
    end_servers,
    holder_of,
    not_connected,
    recorder_of,
)
from sb3_mcbs.snapshot.bullet_world import (
    World,
    connections,
    difference,
    strip_world,
    write_world,
)
from sb3_mcbs.snapshot.errors import SnapshotError, SnapshotMismatchError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.handlers import handler_of
from sb3_mcbs.snapshot.layers import NOT_STATE, RECORDER, capture_attributes
from sb3_mcbs.snapshot.object_graph import Capture, Ref
from sb3_mcbs.snapshot.registry import SnapshotAdapter
from sb3_mcbs.snapshot.replay import ReplayAdapter, constructor_arguments, find_recorder

_OURS = {RECORDER, "reset", "step", "close"}
_METHODS = ("auto", "state", "replay")


class BulletAdapter(ReplayAdapter):
    """Captures environments that simulate with PyBullet.

    An environment is recognised by its code, which refers to PyBullet, and its physics server by objects of a
    class ``BulletClient`` and by integers under names such as ``client`` or ``physicsClientId``, in the
    environment and in the objects that it holds. Say it where that is not enough::

        register_adapter(lambda env: isinstance(env, MyEnv), BulletAdapter(client="world"))

    Clones are made by the constructor and the resets of the original, and have a server without a window of
    their own, which ends when they are closed or collected.

    :param client: the name that the handle is kept under, or several, wherever in the environment.
    :param method: ``"state"`` puts back what PyBullet saves, ``"replay"`` repeats the episode from its reset
        on, as a :class:`ReplayAdapter` does, and ``"auto"`` does that only where the check finds that what
        PyBullet saves is not enough.
    :param prepare: as in :class:`ReplayAdapter`.
    """

    what = "PyBullet's saved state"
    not_state = frozenset({"close"})
    n_later_checks = 20
    advice = (
        "PyBullet saves neither the caches of its collision detection nor the targets of motors, and its "
        "world remembers earlier episodes. A reset() that calls resetSimulation() and loads all bodies again "
        "makes episodes repeat themselves exactly."
    )

    def __init__(
        self,
        client: str | tuple[str, ...] | None = None,
        method: str = "auto",
        prepare: Callable[[Any], None] | None = None,
    ) -> None:
        super().__init__(prepare)
        names = (client,) if isinstance(client, str) else client
        if names is not None and not (
            isinstance(names, tuple) and names and all(isinstance(name, str) for name in names)
        ):
            raise TypeError(f"client must be the name of an attribute, or several, got {client!r}")
        if method not in _METHODS:
            raise ValueError(f"method must be one of {', '.join(_METHODS)}, got {method!r}")
        self._names = None if names is None else frozenset(names)
        self._method = method
        self._replayed: WeakSet[type] = WeakSet()

    def attach(self, env: Any) -> None:
        if find_recorder(env) is None:
            constructor_arguments(env, "simulates with PyBullet")
            BulletRecorder(env, self._prepare, self.not_state, self._names).look()
        _refuse_uncapturable(env, self.not_state)

    def fall_back(self, env: Any) -> bool:
        if self._method != "auto" or type(env) in self._replayed or not recorder_of(env).servers:
            return False
        self._replayed.add(type(env))
        return True

    def capture(self, obj: Any) -> Any:
        recorder = recorder_of(obj)
        if recorder.episode is not None and not recorder.is_looked_through:
            _refuse_uncapturable(obj, self.not_state)
            recorder.is_looked_through = True
        return recorder.read()

    def validate(self, obj: Any, state: Any) -> None:
        """Make the servers that a state needs, if the environment has none yet."""
        recorder = recorder_of(obj)
        if len(recorder.look()) >= len(state["worlds"]):
            return
        name = type(obj).__name__
        if state["episode"] is None:
            raise SnapshotMismatchError(not_connected(name, recorder.known))
        try:
            recorder.repeat(state, with_actions=False)
        except SnapshotError:
            raise
        except Exception as error:
            raise SnapshotMismatchError(
                f"{not_connected(name, recorder.known)} Its reset raised {type(error).__name__}: {error}"
            ) from error

    def restore(self, obj: Any, state: Any) -> None:
        recorder = recorder_of(obj)
        worlds = [World(*world) for world in state["worlds"]]
        if state["episode"] is None:
            _restore_unused(recorder, worlds, state["names"] or ())
        elif self._method == "replay" or type(obj) in self._replayed:
            self._replay(recorder, state)
        else:
            if _difference(recorder.servers, worlds) is not None:
                recorder.repeat(state, with_actions=False)
                reason = _difference(recorder.servers, worlds)
                if reason is not None:
                    raise SnapshotMismatchError(
                        f"The world of {type(obj).__name__} cannot be put back: {reason}, and a reset does "
                        "not make it so. What is done to it during an episode takes a "
                        'BulletAdapter(method="replay").'
                    )
            for server, world in zip(recorder.servers, worlds, strict=True):
                write_world(server, world)
        recorder.take_over(state)

    def _replay(self, recorder: BulletRecorder, state: BulletState) -> None:
        assert state["episode"] is not None
        start = time.perf_counter()
        recorder.repeat(state, with_actions=True)
        self._tell(recorder.env, len(state["episode"].actions), time.perf_counter() - start)

    def clone(self, obj: Any, copy: Callable[[Any], Any]) -> Any:
        recorder = recorder_of(obj)
        state = recorder.read()  # before another server takes the number of one that is gone
        new = self._make(obj, recorder)
        its = recorder_of(new)
        try:
            if state["episode"] is not None:
                its.repeat(state, with_actions=False)
            if recorder.read()["worlds"] != state["worlds"]:
                raise SnapshotUnsupportedError(
                    f"Making a clone of {type(obj).__name__} changed the world of the original. All calls of "
                    "PyBullet must be given physicsClientId=<the environment's own handle>, and the handle "
                    "must come from a p.connect() in the constructor or in reset()."
                )
        except BaseException:
            its.release()
            raise
        recorder.latest_clone = weakref.ref(new)
        return new

    def _make(self, obj: Any, recorder: BulletRecorder) -> Any:
        """Make another environment with the same constructor."""
        made: set[int] = set()
        arguments = constructor_arguments(obj, "simulates with PyBullet")
        given = [*arguments.args, *arguments.kwargs.values()]
        shared = any(value is client for value in given for client in recorder.clients)
        if not shared:
            with connections((), made, direct=True):
                new = type(obj)(*arguments.args, **arguments.kwargs)
            new.spec, new.render_mode = obj.spec, None
            self.attach(new)
            its = recorder_of(new)
            its.is_clone, its.made = True, made
            shared = bool(set(its.servers) & set(recorder.servers))
        if shared:
            raise SnapshotUnsupportedError(
                f"{type(obj).__name__} is given its physics server by whoever makes it, so that a clone "
                "would have the same one. Connect in the constructor or in reset()."
            )
        close = new.close

        def close_with_servers() -> None:
            try:
                close()
            finally:
                its.release()

        new.close = functools.wraps(close)(close_with_servers)
        finalize(new, end_servers, os.getpid(), made).atexit = False
        return new


class ServerAdapter(SnapshotAdapter):
    """Leaves handles, and objects that are bound to one, as they are in each environment."""

    def capture(self, obj: Any) -> None:
        if holder_of(obj) is None:
            raise SnapshotUnsupportedError(
                f"a {type(obj).__name__} belongs to a physics server of PyBullet, and the environment itself "
                "is not known to use one: register a BulletAdapter for it"
            )

    def restore(self, obj: Any, state: None) -> None:
        pass

    def clone(self, obj: Any, copy: Callable[[Any], Any]) -> Any:
        """Find what corresponds to it in the clone that was just made."""
        recorder = holder_of(obj)
        new = None if recorder is None else recorder.latest_clone()
        if recorder is not None and new is not None:
            its = recorder_of(new)
            pairs = [*zip(recorder.clients, its.clients, strict=False)]
            pairs += zip(recorder.servers, its.servers, strict=False)
            for mine, others in pairs:
                if mine is obj:
                    return others
        raise SnapshotUnsupportedError(
            f"a {type(obj).__name__} belongs to a physics server of PyBullet that a clone does not have"
        )


def is_server(obj: Any) -> bool:
    """Return whether an object is the marked handle of a physics server, or is bound to one.

    :param obj: any object.
    """
    return isinstance(obj, Handle) or is_client(obj)


def _refuse_uncapturable(env: Any, not_state: frozenset[str]) -> None:
    capture = Capture(handler_of, {id(env): Ref(0)}, 1)
    capture_attributes(capture, env, NOT_STATE | not_state, skip_unsupported=False)


def _difference(servers: tuple[Handle, ...], worlds: list[World]) -> str | None:
    if len(servers) != len(worlds):
        return f"it has {len(worlds)} physics servers in the snapshot and {len(servers)} here"
    reasons = (difference(server, world) for server, world in zip(servers, worlds, strict=True))
    return next((reason for reason in reasons if reason is not None), None)


def _restore_unused(recorder: BulletRecorder, worlds: list[World], names: tuple[str, ...]) -> None:
    """Put an environment back to before its first reset."""
    servers = recorder.look()
    if not worlds:
        recorder.made.intersection_update(servers)
        recorder.release()
    for name in vars(recorder.env).keys() - set(names) - _OURS:
        delattr(recorder.env, name)
    for server, world in zip(servers, worlds, strict=False):
        if difference(server, world) is not None:
            strip_world(server, world)
        write_world(server, world)
    recorder.unused = True
