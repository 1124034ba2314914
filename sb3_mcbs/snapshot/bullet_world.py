"""One world of PyBullet: read, put back, and connected to.

PyBullet's own saved states hold positions, velocities and contacts. They leave out what the engine was told
(gravity, time step) and what was changed about bodies (mass, friction), and whatever PyBullet cannot tell
itself: the targets of motors, the caches of its collision detection.
"""

import os
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from sb3_mcbs.snapshot.errors import SnapshotMismatchError, SnapshotUnsupportedError

# Files that live for a millisecond need no disk.
_MEMORY = "/dev/shm"
_GRAVITY = ("gravityAccelerationX", "gravityAccelerationY", "gravityAccelerationZ")
_SETTABLE = ("fixedTimeStep", "numSubSteps", "numSolverIterations")


class World(NamedTuple):
    """What a physics server simulates.

    :param content: what PyBullet saves of it.
    :param engine: parameters of the engine, with their names.
    :param bodies: of each body, its id, its name and what PyBullet tells about each link.
    :param constraints: of each constraint, its id and what PyBullet tells about it.
    """

    content: bytes
    engine: tuple[tuple[str, Any], ...]
    bodies: tuple[Any, ...]
    constraints: tuple[Any, ...]


def pybullet() -> Any:
    """Return PyBullet's module, None if nobody has imported it. It is never imported here."""
    return sys.modules.get("pybullet")


def is_connected(server: int) -> bool:
    """Return whether a number is the handle of a physics server.

    :param server: the number.
    """
    p = pybullet()
    return p is not None and server >= 0 and bool(p.isConnected(int(server)))


def disconnect(server: int) -> None:
    """End a physics server.

    :param server: its handle; nothing happens if it has ended already.
    """
    if is_connected(server):
        pybullet().disconnect(physicsClientId=int(server))


def read_world(server: int) -> World:
    """Capture what a physics server simulates. It does not notice.

    :param server: its handle.
    :raises SnapshotUnsupportedError: if it runs by itself, in real time.
    """
    p = pybullet()
    engine = p.getPhysicsEngineParameters(physicsClientId=server)
    if engine.get("useRealTimeSimulation"):
        raise SnapshotUnsupportedError(
            "PyBullet's simulation runs in real time, so that no two runs are alike. "
            "Call setRealTimeSimulation(0) and stepSimulation()."
        )
    with _file() as path:
        p.saveBullet(path, physicsClientId=server)
        with open(path, "rb") as file:
            content = file.read()
    return World(content, tuple(engine.items()), *_described(server))


def _described(server: int) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Read what saved states leave out of the bodies, and the constraints."""
    p = pybullet()
    bodies = []
    for place in range(p.getNumBodies(physicsClientId=server)):
        body = p.getBodyUniqueId(place, physicsClientId=server)
        joints = range(p.getNumJoints(body, physicsClientId=server))
        told = [p.getJointInfo(body, joint, physicsClientId=server) for joint in joints]
        bodies.append(
            (
                body,
                p.getBodyInfo(body, physicsClientId=server)[1],
                tuple(p.getDynamicsInfo(body, link, physicsClientId=server) for link in (-1, *joints)),
                # Without the names: PyBullet makes some up, and numbers those of all worlds.
                tuple((*info[2:12], *info[13:]) for info in told),
            )
        )
    numbers = [
        p.getConstraintUniqueId(place, physicsClientId=server)
        for place in range(p.getNumConstraints(physicsClientId=server))
    ]
    constraints = [(number, p.getConstraintInfo(number, physicsClientId=server)) for number in numbers]
    return tuple(bodies), tuple(constraints)


def difference(server: int, world: World) -> str | None:
    """Say why a world cannot be put back into a physics server as it is; None if it can.

    :param server: the handle.
    :param world: a captured world.
    """
    bodies, constraints = _described(server)
    if bodies == world.bodies and constraints == world.constraints:
        return None
    theirs, ours = [body[:2] for body in world.bodies], [body[:2] for body in bodies]
    if theirs != ours:
        return f"its bodies are {_names(theirs)} in the snapshot and {_names(ours)} here"
    if constraints != world.constraints:
        counts = len(world.constraints), len(constraints)
        return f"it has other constraints ({counts[0]} in the snapshot, {counts[1]} here)"
    changed = [its[1] for mine, its in zip(bodies, world.bodies, strict=True) if mine != its]
    name = changed[0].decode(errors="replace")
    return f"what changeDynamics sets of the body {name!r} (mass, friction, ...) is not what it was"


def _names(bodies: Sequence[Any]) -> list[str]:
    return [f"{number}: {name.decode(errors='replace')}" for number, name in bodies[:8]]


def write_world(server: int, world: World) -> None:
    """Put a captured world back.

    :param server: the handle of a physics server with the same bodies.
    :param world: the captured world.
    :raises SnapshotMismatchError: if PyBullet refuses it.
    """
    p = pybullet()
    _set_engine(server, world)
    with _file() as path:
        with open(path, "wb") as file:
            file.write(world.content)
        # PyBullet keeps the content of every file by its name, for good.
        p.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=server)
        try:
            p.restoreState(fileName=path, physicsClientId=server)
        except p.error as error:
            raise SnapshotMismatchError(f"PyBullet cannot put the captured state back: {error}") from error
        finally:
            p.setPhysicsEngineParameter(enableFileCaching=1, physicsClientId=server)


def _set_engine(server: int, world: World) -> None:
    p = pybullet()
    have, wanted = p.getPhysicsEngineParameters(physicsClientId=server), dict(world.engine)
    changed = {name: value for name, value in wanted.items() if have.get(name) != value}
    if not changed:
        return
    if changed.keys() & set(_GRAVITY):
        p.setGravity(*(wanted[name] for name in _GRAVITY), physicsClientId=server)
    settable = {name: value for name, value in changed.items() if name in _SETTABLE}
    if settable:
        p.setPhysicsEngineParameter(**settable, physicsClientId=server)


def strip_world(server: int, world: World) -> None:
    """Remove what a world has got since it was captured, before its environment was ever reset.

    :param server: the handle.
    :param world: the captured world.
    """
    p = pybullet()
    if not world.bodies:
        p.resetSimulation(physicsClientId=server)
        return
    bodies, constraints = _described(server)
    for number in {item[0] for item in constraints} - {item[0] for item in world.constraints}:
        p.removeConstraint(number, physicsClientId=server)
    for number in {item[0] for item in bodies} - {item[0] for item in world.bodies}:
        p.removeBody(number, physicsClientId=server)


@contextmanager
def _file() -> Iterator[str]:
    """Give the path of an empty file that is removed in the end."""
    there = _MEMORY if os.path.isdir(_MEMORY) and os.access(_MEMORY, os.W_OK) else None
    number, path = tempfile.mkstemp(suffix=".bullet", dir=there)
    os.close(number)
    try:
        yield path
    finally:
        os.remove(path)


@contextmanager
def connections(numbers: Sequence[int], made: set[int], direct: bool) -> Iterator[None]:
    """Watch what this thread connects to.

    An environment that ends its server and connects anew is given the number that the old one had, so that
    whoever has noted the number need not be told.

    :param numbers: the handles that the environment has.
    :param made: where the handles of new servers are put.
    :param direct: whether every server is one without a window, whatever is asked for.
    """
    p = pybullet()
    if p is None:
        yield
        return
    connect, thread = p.connect, threading.get_ident()

    def connect_watched(*args: Any, **kwargs: Any) -> int:
        if threading.get_ident() != thread:
            return connect(*args, **kwargs)
        free = [number for number in numbers if not is_connected(number)]
        fillers: list[int] = []
        if free:  # PyBullet gives the lowest number that it can
            lower = sum(not is_connected(number) for number in range(free[0]))
            fillers = [connect(p.DIRECT) for _ in range(lower)]
        try:
            server = connect(p.DIRECT) if direct else connect(*args, **kwargs)
        finally:
            for filler in fillers:
                disconnect(filler)
        if server >= 0:
            made.add(server)
        return server

    p.connect = connect_watched
    try:
        yield
    finally:
        p.connect = connect
