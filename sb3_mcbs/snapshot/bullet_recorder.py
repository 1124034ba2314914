"""The episodes of an environment that uses PyBullet, and the physics servers that it has."""

import os
import weakref
from collections.abc import Callable
from typing import Any, TypedDict
from weakref import WeakKeyDictionary

from sb3_mcbs.snapshot.bullet_handles import Handle, find
from sb3_mcbs.snapshot.bullet_world import connections, disconnect, is_connected, read_world
from sb3_mcbs.snapshot.errors import SnapshotUnsupportedError
from sb3_mcbs.snapshot.replay import RecordedEpisode, Recorder, find_recorder


class BulletState(TypedDict):
    """What is captured besides the environment's attributes.

    :ivar worlds: a :class:`World` as a plain tuple for each physics server.
    :ivar episode: the episode so far, None before the first reset.
    :ivar before: how many servers there were before its reset, and how many objects for one.
    :ivar first: the first episode of the environment's life, without actions, and what was before it; None if
        this is the first. What later episodes start from depends on it.
    :ivar names: the attributes that it had before the first reset; None after.
    """

    worlds: tuple[tuple[Any, ...], ...]
    episode: RecordedEpisode | None
    before: tuple[int, int]
    first: tuple[RecordedEpisode, tuple[int, int]] | None
    names: tuple[str, ...] | None


class BulletRecorder(Recorder):
    """Records the episodes of one environment, and keeps track of its physics servers.

    :param env: the environment.
    :param prepare: as in :class:`ReplayAdapter`.
    :param not_state: as in :class:`ReplayAdapter`.
    :param names: the names that handles are kept under, None if they are not known.
    """

    def __init__(
        self,
        env: Any,
        prepare: Callable[[Any], None] | None,
        not_state: frozenset[str],
        names: frozenset[str] | None,
    ) -> None:
        self._names = names
        #: The handles of the environment's servers, and its objects that are bound to one.
        self.servers: tuple[Handle, ...] = ()
        self.clients: list[Any] = []
        #: The servers that it had last, still connected or not.
        self.known: tuple[Handle, ...] = ()
        #: The servers that came up while the environment was made or reset.
        self.made: set[int] = set()
        #: Whether it is a clone, whose servers have no window and end with it.
        self.is_clone = False
        #: Whether all that it holds after a reset is known to be capturable.
        self.is_looked_through = False
        #: Whether it has never been reset.
        self.unused = True
        self.before = (0, 0)
        self.first: tuple[RecordedEpisode, tuple[int, int]] | None = None
        self.latest_clone: Callable[[], Any] = lambda: None
        super().__init__(env, prepare, not_state)

    def look(self) -> tuple[Handle, ...]:
        """Find the servers that the environment has now, and mark their handles.

        :return: the handles.
        """
        places, clients = find(self.env, self._names)
        bound = [client._client for client in clients if is_connected(client._client)]
        known = {int(handle): handle for handle in self.servers}
        handles: dict[int, Handle] = {}
        for number in (*(place.value for place in places), *bound):
            handles[int(number)] = known.get(int(number)) or _marked(number, self)
        for place in places:
            if place.value is not handles[int(place.value)]:
                place.put(handles[int(place.value)])
        self.servers, self.clients = tuple(handles.values()), clients
        self.known = self.servers or self.known
        for client in clients:
            _recorders[client] = weakref.ref(self)
        return self.servers

    def begin(self, arguments: dict[str, Any]) -> None:
        self.look()
        super().begin(arguments)
        self.before = (len(self.servers), len(self.clients))
        if self.first is None or not self.servers:
            assert self.episode is not None
            self.first = (self.episode, self.before)

    def _begin_episode(self, arguments: dict[str, Any]) -> Any:
        with connections(self.servers, self.made, self.is_clone):
            result = super()._begin_episode(arguments)
        self.unused = False
        # A number that is free again may soon be somebody else's.
        self.made.intersection_update([server for server in self.made if is_connected(server)])
        self.look()
        return result

    def read(self) -> BulletState:
        """Capture the worlds and the episode.

        :raises SnapshotUnsupportedError: if there is no server, or none any more.
        """
        servers, name = self.look(), type(self.env).__name__
        if self.episode is not None and not servers:
            raise SnapshotUnsupportedError(
                not_connected(name, self.known) if self.known else _no_handle(name)
            )
        episode, first = self.episode, self.first
        if episode is not None and first is not None and episode.attributes is first[0].attributes:
            first = None
        return {
            "worlds": tuple(tuple(read_world(server)) for server in servers),
            "episode": None if episode is None else episode._replace(actions=tuple(self.actions)),
            "before": self.before,
            "first": first,
            "names": tuple(vars(self.env)) if episode is None else None,
        }

    def take_over(self, state: BulletState) -> None:
        """Go on with the record of a captured episode.

        :param state: from :meth:`read`.
        """
        episode = state["episode"]
        self.episode = None if episode is None else episode._replace(actions=())
        self.actions = [] if episode is None else list(episode.actions)
        self.before = state["before"]
        self.first = state["first"]
        if self.first is None and self.episode is not None:
            self.first = (self.episode, self.before)

    def repeat(self, state: BulletState, with_actions: bool) -> None:
        """Repeat the reset of a captured episode, and its steps.

        :param state: from :meth:`read`; not one from before the first reset.
        :param with_actions: whether the steps are repeated, too.
        """
        episode = state["episode"]
        assert episode is not None
        if self.unused and state["first"] is not None:
            self._repeat_one(*state["first"])
        self._repeat_one(episode if with_actions else episode._replace(actions=()), state["before"])

    def _repeat_one(self, episode: RecordedEpisode, needed: tuple[int, int]) -> None:
        if len(self.look()) < needed[0] or len(self.clients) < needed[1]:
            # The original had been used when it was wrapped, and its attributes say so.
            self._begin_episode({"seed": 0})
        before, bound = self.servers, [(client, client._client) for client in self.clients]
        if not needed[0]:
            for server in before:  # the reset connects anew
                disconnect(server)
        self.replay(episode)
        after = self.look()
        if before and after != before:
            raise SnapshotUnsupportedError(
                f"{type(self.env).__name__} has other physics servers after its reset: {_numbers(after)} "
                f"instead of {_numbers(before)}."
            )
        # The objects that were there are put back, and what they leave must not end their server.
        if bound:
            for client in self.clients:
                if not any(client is other for other, _ in bound):
                    client._client = -1
            for client, server in bound:
                client._client = server

    def release(self) -> None:
        """End the servers that the environment made."""
        self.look()
        for client in self.clients:
            if client._client in self.made:
                client._client = -1
        end_servers(os.getpid(), self.made)


_recorders: "WeakKeyDictionary[Any, Callable[[], BulletRecorder | None]]" = WeakKeyDictionary()


def _marked(number: int, recorder: BulletRecorder) -> Handle:
    handle = Handle(number)
    handle.recorder = weakref.ref(recorder)
    return handle


def end_servers(process: int, servers: set[int]) -> None:
    """End physics servers.

    :param process: id of the process that they are in; nothing happens in another.
    :param servers: their handles; emptied.
    """
    if process == os.getpid():
        for server in servers:
            disconnect(server)
        servers.clear()


def _numbers(servers: tuple[int, ...]) -> list[int]:
    return [int(server) for server in servers]


def holder_of(obj: Any) -> BulletRecorder | None:
    """Return the recorder of the environment that holds a handle, or an object for a server.

    :param obj: the handle or the object.
    """
    held_by = obj.recorder if isinstance(obj, Handle) else _recorders.get(obj)
    return None if held_by is None else held_by()


def recorder_of(env: Any) -> BulletRecorder:
    """Return what records the episodes of an environment.

    :param env: the environment.
    :raises SnapshotUnsupportedError: if nothing does.
    """
    recorder: BulletRecorder | None = find_recorder(env)
    if recorder is None:
        raise SnapshotUnsupportedError(
            f"a {type(env).__name__} simulates with PyBullet, and can be captured only where it is the "
            "environment itself"
        )
    return recorder


def not_connected(name: str, had: tuple[int, ...]) -> str:
    """Say that an environment has no physics server any more.

    :param name: its class.
    :param had: the servers that it had.
    """
    handle = f" {_numbers(had)[0]}" if had else ""
    return (
        f"The physics server{handle} of {name} is not connected any more: the environment was closed, or the "
        "server was ended by p.disconnect(). Make the environment anew."
    )


def _no_handle(name: str) -> str:
    return (
        f"{name} uses PyBullet, and no handle of a physics server was found in it. Keep what p.connect() "
        "returns in an attribute, such as self.client, give it to all calls as physicsClientId=self.client, "
        f"and if it has another name say so: register_adapter(lambda env: isinstance(env, {name}), "
        'BulletAdapter(client="<name of the attribute>")).'
    )
