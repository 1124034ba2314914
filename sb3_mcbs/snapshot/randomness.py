"""Random generators, and the spaces that hold some."""

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_mcbs.snapshot import generators
from sb3_mcbs.snapshot.errors import SnapshotMismatchError
from sb3_mcbs.snapshot.graph import MISSING, Copier, Freezer, Thawer


class GeneratorKind:
    """Random generators."""

    name = "generator"

    def freeze(self, freezer: Freezer, obj: Any) -> Any:
        return generators.kind_of_generator(obj), generators.classes_of(obj), generators.get_state(obj)

    def thaw(self, thawer: Thawer, index: int, payload: Any, current: Any) -> Any:
        kind, classes, state = payload
        same = generators.is_generator(current) and generators.kind_of_generator(current) == kind
        reused = same and thawer.claim(current)
        generator = current if reused else generators.make_like(*classes)
        if isinstance(thawer.rng, np.random.Generator):
            thawer.do_then(generators.reseed, generator, thawer.rng)
        elif thawer.rng == "restore":
            thawer.do_then(generators.set_state, generator, state)
        elif reused:
            # An adapter may draw from it on the way, so that keeping it means to put it back.
            thawer.do_then(generators.set_state, generator, generators.get_state(generator))
        return generator

    def copy(self, copier: Copier, obj: Any) -> Any:
        generator = generators.make_like(*generators.classes_of(obj))
        generators.set_state(generator, generators.get_state(obj))
        return generator


class SpaceKind:
    """Spaces do not change; the generators that they sample with do."""

    name = "space"

    def freeze(self, freezer: Freezer, obj: spaces.Space) -> Any:
        return tuple(freezer.freeze(part._np_random) for part in _parts(obj))

    def thaw(self, thawer: Thawer, index: int, payload: Any, current: Any) -> Any:
        if not isinstance(current, spaces.Space):
            raise SnapshotMismatchError("The snapshot holds a space where this environment has none.")
        parts = _parts(current)
        if len(parts) != len(payload):
            raise SnapshotMismatchError(
                f"A space of the snapshot has {len(payload)} parts, here it has {len(parts)} ({current})."
            )
        for part, value in zip(parts, payload, strict=True):
            thaw_np_random(thawer, value, vars(part))
        return current

    def copy(self, copier: Copier, obj: spaces.Space) -> Any:
        made = copier.enter(obj, object.__new__(type(obj)))
        vars(made).update({name: copier.copy(value) for name, value in vars(obj).items()})
        return made


def _parts(space: spaces.Space) -> list[spaces.Space]:
    """Return a space and the spaces in it."""
    if isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiBinary):
        return [space]
    parts = [space]
    for value in vars(space).values():
        inner = (
            value.values()
            if isinstance(value, dict)
            else value
            if isinstance(value, list | tuple)
            else [value]
        )
        for item in inner:
            if isinstance(item, spaces.Space):
                parts.extend(_parts(item))
    return parts


def thaw_np_random(thawer: Thawer, value: Any, attributes: dict[str, Any]) -> None:
    """Plan what becomes of the ``_np_random`` of an environment or a space.

    :param thawer: carries the choice between restoring, keeping and seeding afresh.
    :param value: the frozen value: None if no generator was there.
    :param attributes: the attributes of the environment or space.
    """
    current = attributes.get("_np_random")
    if value is not None:
        generator = thawer.thaw(value, current if current is not None else MISSING)
        if thawer.rng == "keep" and current is None:
            generator = None
    elif isinstance(thawer.rng, np.random.Generator):
        # Gymnasium would make it from the system's entropy when it is first drawn from.
        usable = generators.is_generator(current) and thawer.claim(current)
        generator = current if usable else np.random.Generator(np.random.PCG64(0))
        thawer.do_then(generators.reseed, generator, thawer.rng)
    else:
        generator = current if thawer.rng == "keep" else None
    if generator is not current:
        thawer.do_then(attributes.__setitem__, "_np_random", generator)
