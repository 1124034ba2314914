"""The layers of one environment as a whole: captured, checked, put back, cloned."""

import contextlib
import operator
import types
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import gymnasium as gym

from sb3_mcbs.snapshot.cloning import Cloner
from sb3_mcbs.snapshot.errors import SnapshotMismatchError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.functions import is_own
from sb3_mcbs.snapshot.generators import globals_kept
from sb3_mcbs.snapshot.handlers import HANDLERS, handler_of
from sb3_mcbs.snapshot.layers import (
    CapturedLayer,
    Layer,
    capture_for_clone,
    capture_layer,
    layers_of,
    restore_into_clone,
    restore_layer,
)
from sb3_mcbs.snapshot.object_graph import Capture, Node, Ref, Restore, RngMode
from sb3_mcbs.snapshot.objects import attributes_of, blank
from sb3_mcbs.snapshot.places import Places
from sb3_mcbs.snapshot.registry import find_adapter
from sb3_mcbs.snapshot.stand_ins import stand_in
from sb3_mcbs.snapshot.tensors import check_memory
from sb3_mcbs.snapshot.weak import check_held

_NEEDS_RENDERING = "gymnasium.wrappers.transform_observation.AddRenderObservation"


class State(NamedTuple):
    """The captured state of a stack of layers.

    :param layers: the captured layers, outermost first.
    :param nodes: the nodes that their values refer to.
    :param objects: what each node was made of.
    """

    layers: tuple[CapturedLayer, ...]
    nodes: tuple[Node, ...]
    objects: list[Any]


class Stack:
    """The layers of one environment.

    :param owner: the ``SnapshotEnvWrapper`` around them.
    :raises SnapshotUnsupportedError: if a layer cannot be captured.
    """

    def __init__(self, owner: gym.Wrapper[Any, Any, Any, Any]) -> None:
        self.layers = layers_of(owner.env)
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
            if layer.adapter is not None:
                layer.adapter.attach(layer.env)
        self._refs = {id(layer.env): Ref(place) for place, layer in enumerate(self.layers)}
        self._refs[id(owner)] = Ref(0)

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
    def bare(self) -> Iterator[None]:
        """Neither monitor, record nor draw inside, and put everything back afterwards."""
        state = self.capture(monitor=False)
        left_out = [layer for layer in self.layers if layer.left_out]
        classes = [type(layer.env) for layer in left_out]
        base = self.layers[-1].env
        draws = vars(base).get("render_mode")
        try:
            for layer in left_out:
                layer.env.__class__ = stand_in(layer.cls)
            if draws is not None:
                base.render_mode = None
            if any(_is_method_of(left_out, obj) for obj in state.objects):
                # Whoever holds such a method gets that of the stand-in.
                self.restore(state.layers, state.nodes)
            yield
        finally:
            for layer, cls in zip(left_out, classes, strict=True):
                layer.env.__class__ = cls
            if draws is not None:
                base.render_mode = draws
            self.put_back(state)

    @property
    def incomplete_clones(self) -> bool:
        """Whether a clone is not yet in the state of the original."""
        return any(layer.adapter is not None and layer.adapter.with_attributes for layer in self.layers)

    @property
    def simulators(self) -> list[Any]:
        """The objects and layers that adapters capture."""
        adapted = [layer.env for layer in self.layers if layer.adapter is not None]
        return [*(self._watched or ()), *adapted]

    def capture(self, monitor: bool = True) -> State:
        """Capture the state.

        :param monitor: whether what a ``Monitor`` holds is captured.
        :raises SnapshotUnsupportedError: if a layer holds something that cannot be captured.
        """
        while True:
            capture = Capture(handler_of, self._refs, len(self.layers), Places(self._watched or ()))
            captured = tuple([capture_layer(capture, layer, monitor) for layer in self.layers])
            self._watch(capture.adapted)
            if capture.places.are_of(capture.adapted):
                break
        check_memory(capture)
        check_held(capture, captured)
        return State(captured, tuple(capture.nodes), capture.objects)

    def put_back(self, state: State) -> None:
        """Put the layers into a captured state, with the objects that they held then.

        Somebody else may hold those, too: settings that several environments share, a model.

        :param state: of :meth:`capture`.
        """
        self.restore(state.layers, state.nodes, originals=state.objects)
        self.find_simulators()

    def become(self, state: State, shares: bool) -> None:
        """Put the layers of a copy that was made otherwise into the state of the original.

        :param state: of the original.
        :param shares: whether the copy may have functions and classes of the original, as deep copies have.
        """
        own = [obj for obj in state.objects if shares and issubclass(type(obj), type | types.FunctionType)]
        foreign = frozenset(id(obj) for obj in own if isinstance(obj, type) or is_own(obj))
        self.capture()  # finds the simulators
        self.restore(state.layers, state.nodes, foreign=foreign)

    def find_simulators(self) -> None:
        """Watch the simulators that are there now: a reset of the environment may exchange its own."""
        if not self.watches:
            return
        present = {id(value) for layer in self.layers for value in attributes_of(layer.env).values()}
        if not all(id(obj) in present for obj in self._watched or ()):
            # Whoever takes a snapshot is told what cannot be captured.
            with contextlib.suppress(SnapshotUnsupportedError):
                self.capture()

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

    def check(self, captured: Sequence[CapturedLayer]) -> None:
        """Refuse the state of other layers.

        :param captured: captured layers.
        :raises SnapshotMismatchError: names the difference.
        """
        if len(self.layers) == len(captured) and all(map(_is_counterpart, self.layers, captured)):
            return
        ours = [layer.name for layer in self.layers if not layer.left_out]
        theirs = [layer.name for layer in captured if not layer.left_out]
        if ours[-1] != theirs[-1]:
            raise SnapshotMismatchError(
                f"The snapshot is of a {theirs[-1]}, this environment is a {ours[-1]}."
            )
        if ours != theirs:
            raise SnapshotMismatchError(
                "The wrappers differ, outermost first: "
                f"{_short(theirs)} in the snapshot, {_short(ours)} around this environment."
            )
        _check_left_out(self.layers, self._pair(captured), captured)

    def _pair(self, captured: Sequence[CapturedLayer]) -> list[Layer | None]:
        """Find for each captured layer the one to restore; None for one that may be missing, and is."""
        if len(self.layers) == len(captured) and all(map(_is_alike, self.layers, captured)):
            return list(self.layers)
        kept = iter([layer for layer in self.layers if not layer.left_out])
        left_out = [layer for layer in self.layers if layer.left_out]
        found: list[Layer | None] = []
        for theirs in captured:
            if not theirs.left_out:
                found.append(next(kept))
                continue
            layer = next((layer for layer in left_out if layer.name == theirs.name), None)
            left_out = [other for other in left_out if other is not layer]
            found.append(layer)
        return found

    def restore(
        self,
        captured: Sequence[CapturedLayer],
        nodes: tuple[Node, ...],
        rng: RngMode = "restore",
        originals: list[Any] | None = None,
        foreign: frozenset[int] = frozenset(),
    ) -> None:
        """Put the layers into a captured state.

        :param captured: captured layers; :meth:`check` has passed.
        :param nodes: the nodes that their values refer to.
        :param rng: what becomes of random generators.
        :param originals: the objects that the nodes were made of, if those are to be put back themselves.
        :param foreign: ids of functions and classes that are there and belong to another environment.
        :raises SnapshotMismatchError: if the state does not fit; nothing has been changed then.
        """
        layers = self._pair(captured)
        known = [layer.env if layer is not None else None for layer in layers]
        for place in reversed(range(len(known) - 1)):
            if known[place] is None:
                known[place] = known[place + 1]
        places = Places(self._watched or ())
        while True:
            restore = Restore(nodes, HANDLERS, known, rng, originals, places, foreign)
            for layer, saved in zip(layers, captured, strict=True):
                if layer is not None:
                    restore_layer(restore, layer, saved)
            simulators = [restore.adapted[index] for index in sorted(restore.adapted)]
            if places.are_of(simulators):
                break
            places = Places(simulators)
        restore.commit()

    def clone(self) -> gym.Env[Any, Any]:
        """Copy the layers, with stand-ins for those that only monitor, draw or record.

        :return: the outermost layer of the copy.
        """
        cloner = Cloner(self._refs, len(self.layers))
        made = cloner.restore.memo
        classes = []
        for place, layer in reversed([*enumerate(self.layers)]):
            if layer.adapter is None:
                classes.append(cloner.capture(layer.cls))
                cls = cloner.restore(classes[-1])
                made[place] = blank(stand_in(cls) if layer.left_out else cls)
            else:
                with globals_kept():
                    made[place] = layer.adapter.clone(layer.env, cloner)
        captured = {
            place: capture_for_clone(cloner.capture, layer)
            for place, layer in reversed([*enumerate(self.layers)])
            if layer.adapter is None
        }
        if not self.incomplete_clones:  # those are completed by what capture() has checked
            check_held(cloner.capture, [*classes, *captured.values()])
        cloner.make_simulators()
        for place, attributes in captured.items():
            restore_into_clone(cloner.restore, made[place], attributes)
        cloner.restore.commit()
        for place in range(len(self.layers) - 1):
            made[place].env = made[place + 1]
        return made[0]


def _is_method_of(layers: list[Layer], obj: Any) -> bool:
    return type(obj) is types.MethodType and any(obj.__self__ is layer.env for layer in layers)


def _is_alike(layer: Layer, captured: CapturedLayer) -> bool:
    return layer.name == captured.name


def _is_counterpart(layer: Layer, captured: CapturedLayer) -> bool:
    return _is_alike(layer, captured) and (not layer.monitor or captured.own is not None)


def _check_left_out(
    layers: Sequence[Layer], paired: Sequence[Layer | None], captured: Sequence[CapturedLayer]
) -> None:
    """Refuse a state without what a ``Monitor`` remembers, or where what was set on a layer would be lost."""
    pairs = list(zip(paired, captured, strict=True))
    own = {id(layer.env): captured.own for layer, captured in pairs if layer is not None}
    for layer in layers:
        if layer.monitor and own.get(id(layer.env)) is None:
            raise SnapshotMismatchError(
                "This environment has a Monitor, and the snapshot is of one without: the episode in progress "
                "that the Monitor should continue is not in it. Restore it into a clone() instead."
            )
        if layer.left_out and id(layer.env) not in own:
            values = attributes_of(layer.env)
            others = {name: values[name] for name in values if name not in layer.not_state}
            _refuse_lost(layer.name, others, "this environment has a {}, and the snapshot is of one without")
    for found, theirs in pairs:
        if found is None:
            others = theirs.attributes or {}
            _refuse_lost(theirs.name, others, "the snapshot is of one with a {}, and this has none")


def _refuse_lost(name: str, attributes: dict[str, Any], what: str) -> None:
    lost = sorted(name for name, value in attributes.items() if value is not None)
    if lost:
        raise SnapshotMismatchError(
            f"The wrappers differ: {what.format(_short([name]))}, on which others have set {', '.join(lost)}."
        )


def _short(names: list[str]) -> str:
    return " > ".join(name.rpartition(".")[2] for name in names)
