"""The state of a stack of layers: captured, checked, put back, cloned."""

import contextlib
import itertools
import operator
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import gymnasium as gym

from sb3_mcbs.snapshot.attributes import freeze_attributes, thaw_attributes
from sb3_mcbs.snapshot.errors import SnapshotMismatchError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.global_generators import globals_kept
from sb3_mcbs.snapshot.graph import Copier, Freezer, Node, Ref, RngMode, Thawer
from sb3_mcbs.snapshot.kinds import KINDS, kind_of, plan_adapter
from sb3_mcbs.snapshot.layers import Layer, layers_of
from sb3_mcbs.snapshot.objects import attributes_of, blank, set_attributes
from sb3_mcbs.snapshot.places import Places
from sb3_mcbs.snapshot.registry import SnapshotAdapter, find_adapter
from sb3_mcbs.snapshot.tensors import check_memory

_NEEDS_RENDERING = "gymnasium.wrappers.transform_observation.AddRenderObservation"


class FrozenLayer(NamedTuple):
    """The captured state of one layer.

    :param name: its class.
    :param monitor: whether it is SB3's ``Monitor``, which may be missing where the state is put back.
    :param adapted: what the layer's adapter captured, in a tuple; None if it has no adapter.
    :param attributes: the frozen value of each captured attribute; None if none are captured, as of a
        ``Monitor`` that was left out.
    :param cls: the layer's frozen class, which has state of its own if it was made for this layer.
    """

    name: str
    monitor: bool
    adapted: tuple[Any] | None
    attributes: dict[str, Any] | None
    cls: Any


class Kept(NamedTuple):
    """A captured state, and the very objects that it was captured of.

    :param layers: the captured layers.
    :param nodes: the nodes that their values refer to.
    :param objects: what each node was made of.
    """

    layers: tuple[FrozenLayer, ...]
    nodes: tuple[Node, ...]
    objects: list[Any]


class Stack:
    """The layers of one environment.

    :param owner: the ``SnapshotEnvWrapper`` around them.
    :raises SnapshotUnsupportedError: if a layer cannot be captured.
    """

    def __init__(self, owner: gym.Wrapper[Any, Any, Any, Any]) -> None:
        self.layers = [_with_adapter(layer) for layer in layers_of(owner.env)]
        self._stateful = [layer for layer in self.layers if not layer.recorder]
        self._names = [layer.name for layer in self._stateful]
        self._adapters: dict[int, SnapshotAdapter] = {}
        self._owner = owner
        self.monitors = [layer.env for layer in self.layers if layer.monitor]
        #: Each says whether a simulator gave up its state since it was called last.
        self.watches: list[Callable[[], bool]] = []
        self._watched: list[Any] | None = None
        for layer in self.layers:
            if layer.name == _NEEDS_RENDERING:
                raise SnapshotUnsupportedError(
                    f"{layer.name} draws its observations, and copies of an environment cannot draw. "
                    "Remove the wrapper."
                )
            adapter = find_adapter(layer.env)
            if adapter is not None:
                adapter.attach(layer.env)
                self._adapters[id(layer.env)] = adapter
        # A recorder is named as the layer below it: where the state is put back there may be none.
        self._refs = {id(owner): Ref(0)}
        place = 0
        for layer in self.layers:
            self._refs[id(layer.env)] = Ref(place)
            place += not layer.recorder

    @property
    def is_whole(self) -> bool:
        """Whether the owner still wraps these layers, and no others."""
        env: Any = self._owner
        for layer in self.layers:
            env = env.env
            if env is not layer.env:
                return False
        return True

    @contextlib.contextmanager
    def bare(self) -> Iterator[gym.Env[Any, Any]]:
        """Take out monitors and recorders, and draw nothing, while it is entered.

        :return: the outermost of the other layers.
        """
        kept = [layer.env for layer in self.layers if not layer.recorder and not layer.monitor]
        below = [env.env for env in kept[:-1]]
        draws = vars(kept[-1]).get("render_mode")
        try:
            for env, its in itertools.pairwise(kept):
                env.env = its
            if draws is not None:
                kept[-1].render_mode = None
            yield kept[0]
        finally:
            for env, its in zip(kept, below, strict=False):
                env.env = its
            if draws is not None:
                kept[-1].render_mode = draws

    @property
    def incomplete_clones(self) -> bool:
        """Whether a clone is not yet in the state of the original."""
        return any(adapter.with_attributes for adapter in self._adapters.values())

    @property
    def simulators(self) -> list[Any]:
        """The objects and layers that adapters capture."""
        adapted = [layer.env for layer in self.layers if id(layer.env) in self._adapters]
        return [*(self._watched or ()), *adapted]

    def freeze(self, monitor: bool = True) -> tuple[tuple[FrozenLayer, ...], tuple[Node, ...]]:
        """Capture the state.

        :param monitor: whether what a ``Monitor`` holds is captured.
        :return: the captured layers, outermost first, and the nodes that their values refer to.
        :raises SnapshotUnsupportedError: if a layer holds something that cannot be captured.
        """
        kept = self.keep(monitor)
        return kept.layers, kept.nodes

    def keep(self, monitor: bool) -> Kept:
        """Capture the state, for :meth:`put_back`.

        :param monitor: whether what a ``Monitor`` holds is captured.
        :raises SnapshotUnsupportedError: if a layer holds something that cannot be captured.
        """
        while True:
            freezer = Freezer(kind_of, self._refs, len(self._stateful), Places(self._watched or ()))
            frozen = tuple([self._freeze_layer(freezer, layer, monitor) for layer in self._stateful])
            self._watch(freezer.adapted)
            if freezer.places.are_of(freezer.adapted):
                break
        check_memory(freezer)
        return Kept(frozen, tuple(freezer.nodes), freezer.objects)

    def put_back(self, kept: Kept) -> None:
        """Put the layers into a captured state, with the objects that they held then.

        Somebody else may hold those, too: settings that several environments share, a model.

        :param kept: of :meth:`keep`.
        """
        self._thaw(kept.layers, kept.nodes, "restore", kept.objects)
        self.find_simulators()

    def find_simulators(self) -> None:
        """Watch the simulators that are there now: a reset of the environment may exchange its own."""
        if not self.watches:
            return
        present = {id(value) for layer in self.layers for value in attributes_of(layer.env).values()}
        if not all(id(obj) in present for obj in self._watched or ()):
            # Whoever takes a snapshot is told what cannot be captured.
            with contextlib.suppress(SnapshotUnsupportedError):
                self.freeze()

    def _watch(self, held: list[Any]) -> None:
        """Watch simulators.

        :param held: the objects with an adapter that the layers hold.
        """
        known = self._watched
        if known is not None and len(held) == len(known) and all(map(operator.is_, held, known)):
            return
        self._watched = held
        self.watches = []
        for obj in (*held, *(layer.env for layer in self.layers)):
            adapter = find_adapter(obj)
            watch = None if adapter is None else adapter.watch(obj)
            if watch is not None:
                self.watches.append(watch)

    def _freeze_layer(self, freezer: Freezer, layer: Layer, monitor: bool) -> FrozenLayer:
        if layer.monitor and not monitor:  # it keeps its place, which nodes refer to
            return FrozenLayer(layer.name, True, None, None, None)
        adapter = self._adapters.get(id(layer.env))
        adapted = None if adapter is None else (adapter.capture(layer.env),)
        attributes = None
        if adapter is None or adapter.with_attributes:
            attributes = freeze_attributes(freezer, layer.env, layer.not_state, adapter is not None)
        cls = freezer.freeze(type(layer.env)) if adapter is None else None
        return FrozenLayer(layer.name, layer.monitor, adapted, attributes, cls if type(cls) is Ref else None)

    def check(self, frozen: tuple[FrozenLayer, ...]) -> None:
        """Refuse the state of other layers.

        :param frozen: captured layers.
        :raises SnapshotMismatchError: names the difference.
        """
        captured_monitors = sum(layer.monitor and layer.attributes is not None for layer in frozen)
        lacks_monitor = len(self.monitors) > captured_monitors
        if not lacks_monitor and self._names == [layer.name for layer in frozen]:
            return
        ours = [layer.name for layer in self._stateful if not layer.monitor]
        theirs = [layer.name for layer in frozen if not layer.monitor]
        if ours[-1] != theirs[-1]:
            raise SnapshotMismatchError(
                f"The snapshot is of a {theirs[-1]}, this environment is a {ours[-1]}."
            )
        if ours != theirs:
            raise SnapshotMismatchError(
                "The wrappers differ, outermost first: "
                f"{_short(theirs)} in the snapshot, {_short(ours)} around this environment."
            )
        if lacks_monitor:
            raise SnapshotMismatchError(
                "This environment has a Monitor, and the snapshot is of one without: the episode in progress "
                "that the Monitor should continue is not in it. Restore it into a clone() instead."
            )

    def thaw(self, frozen: tuple[FrozenLayer, ...], nodes: tuple[Node, ...], rng: RngMode) -> None:
        """Put the layers into a captured state.

        :param frozen: captured layers; :meth:`check` has passed.
        :param nodes: the nodes that their values refer to.
        :param rng: what becomes of random generators.
        :raises SnapshotMismatchError: if the state does not fit; nothing has been changed then.
        """
        self._thaw(frozen, nodes, rng, None)

    def _thaw(
        self,
        frozen: tuple[FrozenLayer, ...],
        nodes: tuple[Node, ...],
        rng: RngMode,
        originals: list[Any] | None,
    ) -> None:
        layers = self._pair(frozen)
        known = [layer.env if layer is not None else None for layer in layers]
        for place in reversed(range(len(known) - 1)):
            if known[place] is None:
                known[place] = known[place + 1]
        places = Places(self._watched or ())
        while True:
            thawer = Thawer(nodes, KINDS, known, rng, originals, places)
            self._plan(thawer, layers, frozen)
            simulators = [thawer.adapted[index] for index in sorted(thawer.adapted)]
            if places.are_of(simulators):
                break
            places = Places(simulators)
        thawer.commit()

    def _plan(self, thawer: Thawer, layers: list[Layer | None], frozen: tuple[FrozenLayer, ...]) -> None:
        for layer, captured in zip(layers, frozen, strict=True):
            if layer is None:
                continue
            adapter = self._adapters.get(id(layer.env))
            if captured.adapted is not None:
                plan_adapter(thawer, adapter, layer.env, captured.adapted[0])
            thawer.thaw(captured.cls, type(layer.env))
            if captured.attributes is not None:
                thaw_attributes(thawer, layer.env, layer.not_state, captured.attributes, adapter is None)

    def _pair(self, frozen: tuple[FrozenLayer, ...]) -> list[Layer | None]:
        """Find for each captured layer the one to restore; None for a Monitor that is not there."""
        if len(frozen) == len(self._stateful):
            return list(self._stateful)
        monitors = iter([layer for layer in self._stateful if layer.monitor])
        others = iter([layer for layer in self._stateful if not layer.monitor])
        return [next(monitors, None) if captured.monitor else next(others) for captured in frozen]

    def clone(self) -> gym.Env[Any, Any]:
        """Copy the layers, without recorders and monitors.

        :return: the outermost layer of the copy.
        """
        copies: dict[int, Any] = {}
        copier = Copier(kind_of, copies)
        ordinary: list[Layer] = []
        below: Any = None
        for layer in reversed(self.layers):
            if not layer.recorder and not layer.monitor:
                adapter = self._adapters.get(id(layer.env))
                if adapter is None:
                    below = blank(copier.copy(type(layer.env)))
                    ordinary.append(layer)
                else:
                    with globals_kept():
                        below = adapter.clone(layer.env, copier.copy)
            copies[id(layer.env)] = below
        copies[id(self._owner)] = below
        # Simulators first, wherever they hang: attributes may be views into their memory.
        freezer = Freezer(kind_of, self._refs, len(self._stateful))
        for layer in ordinary:
            self._freeze_layer(freezer, layer, monitor=False)
        for simulator in freezer.adapted:
            copier.copy(simulator)
        for layer in ordinary:
            _copy_attributes(copier, layer)
        for layer in self.layers[:-1]:
            if copies[id(layer.env)] is not copies[id(layer.env.env)]:
                copies[id(layer.env)].env = copies[id(layer.env.env)]
        return below


def _with_adapter(layer: Layer) -> Layer:
    adapter = find_adapter(layer.env)
    return layer if adapter is None else layer._replace(not_state=layer.not_state | adapter.not_state)


def _short(names: list[str]) -> str:
    return " > ".join(name.rpartition(".")[2] for name in names)


def _copy_attributes(copier: Copier, layer: Layer) -> None:
    attributes: dict[str, Any] = {}
    for name, value in attributes_of(layer.env).items():
        if name == "render_mode":
            attributes[name] = None
        elif name == "_ezpickle_kwargs" and "render_mode" in value:
            attributes[name] = {**value, "render_mode": None}
        elif name in layer.not_state:
            attributes[name] = value
        else:
            try:
                attributes[name] = copier.copy(value)
            except SnapshotUnsupportedError as error:
                error.path.insert(0, f"{type(layer.env).__name__}.{name}")
                raise
    set_attributes(copier.memo[id(layer.env)], attributes)
