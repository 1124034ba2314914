"""Which layer of an environment a captured one belongs to."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from sb3_mcbs.snapshot.errors import SnapshotMismatchError
from sb3_mcbs.snapshot.layers import Layer
from sb3_mcbs.snapshot.objects import attributes_of


class CapturedLayer(NamedTuple):
    """The captured state of one layer.

    :param name: its class.
    :param left_out: whether it may be missing where the state is put back, with nothing in its place.
    :param adapted: what the layer's adapter captured, in a tuple; None if it has no adapter.
    :param attributes: the captured value of each captured attribute; None if none are captured.
    :param own: the same of what only a ``Monitor`` itself sets; None if that was left out.
    :param cls: the layer's captured class, which has state of its own if it was made for this layer.
    """

    name: str
    left_out: bool
    adapted: tuple[Any] | None
    attributes: dict[str, Any] | None
    own: dict[str, Any] | None
    cls: Any


def pair(layers: Sequence[Layer], captured: Sequence[CapturedLayer]) -> list[Layer | None]:
    """Find for each captured layer the one to restore; None for one that may be missing, and is.

    :param layers: of an environment.
    :param captured: captured layers; :func:`check` has passed.
    """
    if len(layers) == len(captured) and all(map(_is_alike, layers, captured)):
        return list(layers)
    kept = iter([layer for layer in layers if not layer.left_out])
    left_out = [layer for layer in layers if layer.left_out]
    found: list[Layer | None] = []
    for theirs in captured:
        if not theirs.left_out:
            found.append(next(kept))
            continue
        layer = next((layer for layer in left_out if layer.name == theirs.name), None)
        left_out = [other for other in left_out if other is not layer]
        found.append(layer)
    return found


def check(layers: Sequence[Layer], captured: Sequence[CapturedLayer]) -> None:
    """Refuse the state of other layers.

    :param layers: of an environment.
    :param captured: captured layers.
    :raises SnapshotMismatchError: names the difference.
    """
    if len(layers) == len(captured) and all(map(_is_counterpart, layers, captured)):
        return
    ours = [layer.name for layer in layers if not layer.left_out]
    theirs = [layer.name for layer in captured if not layer.left_out]
    if ours[-1] != theirs[-1]:
        raise SnapshotMismatchError(f"The snapshot is of a {theirs[-1]}, this environment is a {ours[-1]}.")
    if ours != theirs:
        raise SnapshotMismatchError(
            "The wrappers differ, outermost first: "
            f"{_short(theirs)} in the snapshot, {_short(ours)} around this environment."
        )
    _check_left_out(layers, captured)


def _is_alike(layer: Layer, captured: CapturedLayer) -> bool:
    return layer.name == captured.name


def _is_counterpart(layer: Layer, captured: CapturedLayer) -> bool:
    return _is_alike(layer, captured) and (not layer.monitor or captured.own is not None)


def _check_left_out(layers: Sequence[Layer], captured: Sequence[CapturedLayer]) -> None:
    """Refuse a state without what a ``Monitor`` remembers, or where what was set on a layer would be lost."""
    pairs = list(zip(pair(layers, captured), captured, strict=True))
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
