"""Random generators, and the spaces that hold some."""

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_mcbs.snapshot import generators
from sb3_mcbs.snapshot.object_graph import MISSING, Capture, Ref, Restore
from sb3_mcbs.snapshot.spaces import definition_of, is_defined_as, made_of, parts_of

_GLOBAL = "global"


class GeneratorHandler:
    """Random generators, with the sequences that they spawn from. Those of the process are no state."""

    name = "generator"

    def capture(self, capture: Capture, obj: Any) -> Any:
        global_name = generators.global_name(obj)
        if global_name is not None:
            return _GLOBAL, global_name, None, None
        bits = generators.bits_of(obj)
        classes = type(obj), type(bits)
        kind = generators.pair_name(classes)
        shared = capture.owner_of(bits, obj)
        if shared is not None:
            return kind, classes, shared, None
        return kind, classes, generators.get_state(bits), _capture_seeds(capture, bits, obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        kind, classes, state, seeds = payload
        if kind == _GLOBAL:
            return generators.global_generator(classes)
        if not generators.is_of_kind(current, kind):
            current = MISSING
        if type(state) is Ref:
            return _over(generators.bits_of(restore(state)), classes, current)
        reused = _claim(restore, current, seeds)
        generator = current if reused else generators.make_like(*classes)
        sequence = None if seeds is None else generators.sequence_of(generator)
        if type(seeds) is Ref:
            shared = generators.sequence_of(restore(seeds))
            if shared is not None and shared is not sequence:
                restore.do_then(generators.use_sequence, generator, shared)
            seeds = None
        if isinstance(restore.rng, np.random.Generator):
            restore.do_then(generators.reseed, generator, restore.rng, seeds)
            return generator
        if restore.rng == "keep":
            if not reused:
                return generator
            # An adapter may draw from it on the way, so that keeping it means to put it back.
            state = generators.get_state(generator)
            seeds = None if seeds is None or sequence is None else generators.read_seeds(sequence)
        restore.do_then(generators.set_state, generator, state)
        if seeds is not None and sequence is not None:
            restore.do_then(generators.set_seeds, sequence, seeds)
        return generator


def _capture_seeds(capture: Capture, bits: Any, owner: Any) -> Any:
    """Capture the sequence of a generator, or name the node that it is captured with."""
    sequence = generators.sequence_of(bits)
    if sequence is None:
        return None
    shared = capture.owner_of(sequence, owner)
    return generators.read_seeds(sequence) if shared is None else shared


def _claim(restore: Restore, generator: Any, seeds: Any) -> bool:
    """Return whether a generator is there that can be used, with all that it consists of."""
    if generator is MISSING:
        return False
    bits = generators.bits_of(generator)
    if not restore.claim(bits):
        return False
    if type(seeds) is not tuple:
        return True
    sequence = generators.sequence_of(bits)
    return sequence is not None and restore.claim(sequence)


def _over(bits: Any, classes: tuple[type, type], current: Any) -> Any:
    """Return a generator that draws from the bit generator of another one."""
    if classes[0] is classes[1]:
        return bits
    if current is not MISSING and generators.bits_of(current) is bits:
        return current
    return classes[0](bits)


class SeedsHandler:
    """Sequences that random generators are spawned from."""

    name = "seeds"

    def capture(self, capture: Capture, obj: np.random.SeedSequence) -> Any:
        return _capture_seeds(capture, obj, obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        if type(payload) is Ref:
            return generators.sequence_of(restore(payload))
        reused = type(current) is np.random.SeedSequence and restore.claim(current)
        sequence = current if reused else generators.make_sequence(payload)
        if isinstance(restore.rng, np.random.Generator):
            restore.do_then(_reseed_sequence, sequence, payload, restore.rng)
        elif restore.rng == "restore":
            restore.do_then(generators.set_seeds, sequence, payload)
        elif reused:
            restore.do_then(generators.set_seeds, sequence, generators.read_seeds(sequence))
        return sequence


def _reseed_sequence(
    sequence: np.random.SeedSequence, seeds: generators.Seeds, rng: np.random.Generator
) -> None:
    generators.reseed_sequence(sequence, seeds, int(rng.integers(2**63)))


class SpaceHandler:
    """Spaces: what they contain is state, as environments may exchange them, and so are their generators.

    A space that is still the same stays where it is: others hold it, too.
    """

    name = "space"

    def capture(self, capture: Capture, obj: spaces.Space) -> Any:
        parts = parts_of(obj)
        return definition_of(obj), tuple(capture(part._np_random) for part in parts)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        definition, generators_of_parts = payload
        if not isinstance(current, spaces.Space) or not is_defined_as(current, definition):
            current = made_of(definition)
        parts = parts_of(current)
        for part, value in zip(parts, generators_of_parts, strict=True):
            restore_np_random(restore, value, vars(part))
        return current


def restore_np_random(restore: Restore, value: Any, attributes: dict[str, Any]) -> None:
    """Plan what becomes of the ``_np_random`` of an environment or a space.

    :param restore: carries the choice between restoring, keeping and seeding afresh.
    :param value: the captured value: None if no generator was there.
    :param attributes: the attributes of the environment or space.
    """
    current = attributes.get("_np_random")
    if value is not None:
        generator = restore(value, current if current is not None else MISSING)
        if restore.rng == "keep" and current is None:
            generator = None
    elif isinstance(restore.rng, np.random.Generator):
        # Gymnasium would make it from the system's entropy when it is first drawn from.
        usable = generators.is_generator(current) and restore.claim(current)
        generator = current if usable else np.random.Generator(np.random.PCG64(0))
        restore.do_then(generators.reseed, generator, restore.rng)
    else:
        generator = current if restore.rng == "keep" else None
    if generator is not current:
        restore.do_then(attributes.__setitem__, "_np_random", generator)
