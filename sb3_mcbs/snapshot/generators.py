"""Random generators and the sequences that they spawn from. The global ones belong to no environment."""

import functools
import random
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th

from sb3_mcbs.snapshot.object_graph import MISSING, Capture, Node, Ref, Restore

_U64 = 2**64
_CLASSES = (np.random.Generator, np.random.RandomState, np.random.BitGenerator, random.Random)

#: What a seed sequence consists of: entropy, spawn key, pool size, and how many children it has spawned.
_Seeds = tuple[Any, tuple[int, ...], int, int]

_NO_SEEDS: _Seeds = (0, (), 4, 0)
# Far from where any environment's own counter is, and below the end of its 32 bits.
_FIRST_OTHER_CHILD = 2**30

_GLOBALS: dict[str, Callable[[], Any]] = {
    "numpy": lambda: np.random.mtrand._rand,
    "python": lambda: random._inst,
    "torch": lambda: th.default_generator,
}


def is_generator(obj: Any) -> bool:
    """Return whether an object is a random generator whose state can be captured.

    :param obj: any object.
    """
    if isinstance(obj, _CLASSES):
        return not isinstance(obj, random.SystemRandom)
    return isinstance(obj, th.Generator)


class GeneratorHandler:
    """Random generators, with the sequences that they spawn from. Those of the process are no state."""

    name = "generator"

    def capture(self, capture: Capture, obj: Any) -> Any:
        global_name = next((name for name, find in _GLOBALS.items() if find() is obj), None)
        if global_name is not None:
            return global_name, None, None
        bits = _bits_of(obj)
        shared = capture.owner_of(bits, obj)
        if shared is not None:
            return _classes_of(obj), shared, None
        return _classes_of(obj), _get_state(bits), _capture_seeds(capture, bits, obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        classes, state, seeds = payload
        if isinstance(classes, str):
            return _GLOBALS[classes]()
        if not is_generator(current) or _classes_of(current) != classes:
            current = MISSING
        if type(state) is Ref:
            return _over(_bits_of(restore(state)), classes, current)
        reused = _claim(restore, current, seeds)
        generator = current if reused else _make_like(*classes)
        sequence = None if seeds is None else _sequence_of(generator)
        if type(seeds) is Ref:
            shared = _sequence_of(restore(seeds))
            if shared is not None and shared is not sequence:
                restore.do_then(_use_sequence, generator, shared)
            seeds = None
        if isinstance(restore.rng, np.random.Generator):
            restore.do_then(_reseed, generator, restore.rng, seeds)
            return generator
        if restore.rng == "keep":
            if not reused:
                return generator
            # An adapter may draw from it on the way, so that keeping it means to put it back.
            state = _get_state(generator)
            seeds = None if seeds is None or sequence is None else _read_seeds(sequence)
        restore.do_then(_set_state, generator, state)
        if seeds is not None and sequence is not None:
            restore.do_then(_set_seeds, sequence, seeds)
        return generator


class SeedsHandler:
    """Sequences that random generators are spawned from."""

    name = "seeds"

    def capture(self, capture: Capture, obj: np.random.SeedSequence) -> Any:
        return _capture_seeds(capture, obj, obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        if type(payload) is Ref:
            return _sequence_of(restore(payload))
        reused = type(current) is np.random.SeedSequence and restore.claim(current)
        sequence = current if reused else _make_sequence(payload)
        if isinstance(restore.rng, np.random.Generator):
            rng = restore.rng
            restore.do_then(lambda: _reseed_sequence(sequence, payload, int(rng.integers(2**63))))
        elif restore.rng == "restore":
            restore.do_then(_set_seeds, sequence, payload)
        elif reused:
            restore.do_then(_set_seeds, sequence, _read_seeds(sequence))
        return sequence


def states_in(nodes: Iterable[Node]) -> list[Any]:
    """Return the states of the random generators that were captured.

    :param nodes: of a snapshot.
    """
    return [payload[1:] for kind, payload in nodes if kind == GeneratorHandler.name]


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
        usable = is_generator(current) and restore.claim(current)
        generator = current if usable else np.random.Generator(np.random.PCG64(0))
        restore.do_then(_reseed, generator, restore.rng)
    else:
        generator = current if restore.rng == "keep" else None
    if generator is not current:
        restore.do_then(attributes.__setitem__, "_np_random", generator)


def _capture_seeds(capture: Capture, bits: Any, owner: Any) -> Any:
    """Capture the sequence of a generator, or name the node that it is captured with."""
    sequence = _sequence_of(bits)
    if sequence is None:
        return None
    shared = capture.owner_of(sequence, owner)
    return _read_seeds(sequence) if shared is None else shared


def _claim(restore: Restore, generator: Any, seeds: Any) -> bool:
    """Return whether a generator is there that can be used, with all that it consists of."""
    if generator is MISSING:
        return False
    bits = _bits_of(generator)
    if not restore.claim(bits):
        return False
    if type(seeds) is not tuple:
        return True
    sequence = _sequence_of(bits)
    return sequence is not None and restore.claim(sequence)


def _over(bits: Any, classes: tuple[type, type], current: Any) -> Any:
    """Return a generator that draws from the bit generator of another one."""
    if classes[0] is classes[1]:
        return bits
    if current is not MISSING and _bits_of(current) is bits:
        return current
    return classes[0](bits)


def _bits_of(generator: Any) -> Any:
    """Return what the state of a generator lives in: NumPy's bit generator, or the generator itself."""
    if isinstance(generator, np.random.Generator):
        return generator.bit_generator
    return generator


def _classes_of(generator: Any) -> tuple[type, type]:
    """States can be exchanged between generators of the same classes."""
    return type(generator), type(_bits_of(generator))


def _make_like(generator_class: type, bits_class: type) -> Any:
    """Make a generator of some classes, whose state is about to be set."""
    bits = bits_class()
    return bits if generator_class is bits_class else generator_class(bits)


def _sequence_of(generator: Any) -> np.random.SeedSequence | None:
    """Return the sequence that a generator spawns from, if its state can be captured."""
    sequence = getattr(_bits_of(generator), "seed_seq", generator)
    return sequence if type(sequence) is np.random.SeedSequence else None


def _read_seeds(sequence: np.random.SeedSequence) -> _Seeds:
    entropy: Any = sequence.entropy
    if isinstance(entropy, np.ndarray):
        entropy = entropy.tolist()
    return entropy, sequence.spawn_key, sequence.pool_size, sequence.n_children_spawned


def _set_seeds(sequence: np.random.SeedSequence, seeds: _Seeds) -> None:
    """Put a sequence into a state, in place: whoever else holds it goes on with it."""
    have = _read_seeds(sequence)
    if have == seeds:
        return
    # NumPy lets nobody write the counter, but pickles of a sequence have it.
    if have[:3] == seeds[:3]:
        pickled = [*_pickled(sequence)]
        pickled[_counter_place()] = seeds[3]
    else:
        pickled = [*_pickled(_make_sequence(seeds))]
    sequence.__setstate__(tuple(pickled))  # type: ignore[attr-defined]


def _pickled(sequence: Any) -> tuple[Any, ...]:
    return sequence.__reduce__()[2]


@functools.cache
def _counter_place() -> int:
    """Find the counter of children in the pickled state of a sequence."""
    pickled = _pickled(np.random.SeedSequence(0, n_children_spawned=_FIRST_OTHER_CHILD))
    return [type(part) is int and part == _FIRST_OTHER_CHILD for part in pickled].index(True)


def _make_sequence(seeds: _Seeds) -> np.random.SeedSequence:
    entropy, spawn_key, pool_size, n_spawned = seeds
    return np.random.SeedSequence(
        entropy, spawn_key=spawn_key, pool_size=pool_size, n_children_spawned=n_spawned
    )


def _use_sequence(generator: Any, sequence: np.random.SeedSequence) -> None:
    """Have a generator spawn from a sequence."""
    bits = _bits_of(generator)
    bits.__setstate__((bits.state, sequence))


def _reseed_sequence(sequence: np.random.SeedSequence, seeds: _Seeds, number: int) -> None:
    """Have a sequence spawn others than it would have spawned from a state, depending on a random number."""
    # Another counter gives other children as surely as other entropy does, which would have to be hashed.
    _set_seeds(sequence, (*seeds[:3], _FIRST_OTHER_CHILD + number % _FIRST_OTHER_CHILD))


def _get_state(generator: Any) -> Any:
    """Read the state of a generator, as an object of its own."""
    bits = _bits_of(generator)
    if isinstance(bits, np.random.BitGenerator):
        return bits.state
    if isinstance(bits, np.random.RandomState):
        return bits.get_state(legacy=False)
    if isinstance(bits, random.Random):
        return bits.getstate()
    return bits.get_state().numpy().tobytes()


def _set_state(generator: Any, state: Any) -> None:
    """Put a generator into a state of one of the same classes."""
    bits = _bits_of(generator)
    if isinstance(bits, np.random.BitGenerator):
        bits.state = state
    elif isinstance(bits, np.random.RandomState):
        bits.set_state(state)
    elif isinstance(bits, random.Random):
        bits.setstate(state)
    else:
        bits.set_state(th.frombuffer(bytearray(state), dtype=th.uint8))


def _reseed(generator: Any, rng: np.random.Generator, seeds: _Seeds | None = _NO_SEEDS) -> None:
    """Start a generator, and its sequence unless ``seeds`` is None, at a state drawn from another one."""
    number = _reseed_bits(_bits_of(generator), rng)
    sequence = None if seeds is None else _sequence_of(generator)
    if sequence is not None and seeds is not None:
        _reseed_sequence(sequence, seeds, number)


def _reseed_bits(bits: Any, rng: np.random.Generator) -> int:
    if type(bits) is np.random.PCG64:
        # Every state and every odd increment is a valid PCG64 stream. Drawing them directly is far cheaper
        # than hashing a seed, and look-ahead does this for every row at every decision.
        high, low, stream_high, stream_low = _four_numbers(rng)
        stream = (stream_high * _U64 + stream_low) | 1
        bits.state = {
            "bit_generator": "PCG64",
            "state": {"state": high * _U64 + low, "inc": stream},
            "has_uint32": 0,
            "uinteger": 0,
        }
        return high
    seed = int(rng.integers(2**63))
    if isinstance(bits, np.random.BitGenerator):
        bits.state = type(bits)(seed).state
    elif isinstance(bits, np.random.RandomState):
        bits.set_state(np.random.RandomState(np.random.MT19937(seed)).get_state(legacy=False))
    elif isinstance(bits, random.Random):
        bits.seed(seed)
    else:
        bits.manual_seed(seed)
    return seed


def _four_numbers(rng: np.random.Generator) -> list[int]:
    """Draw four numbers below 2**64."""
    if type(rng.bit_generator) is np.random.PCG64:
        # The same numbers, several times as fast.
        return rng.bit_generator.random_raw(4).tolist()
    return rng.integers(0, _U64, size=4, dtype=np.uint64).tolist()


def global_states() -> tuple[Any, ...]:
    """Read the states of the process's generators: Python's, NumPy's, torch's."""
    return random.getstate(), np.random.get_state(), th.get_rng_state()


def seed_globals(seed: int) -> None:
    """Seed all global generators.

    :param seed: in [0, 2**32).
    """
    random.seed(seed)
    np.random.seed(seed)
    th.default_generator.manual_seed(seed)


@contextmanager
def globals_kept() -> Iterator[None]:
    """Put all global generators back to where they were."""
    python_state, numpy_state, torch_state = global_states()
    try:
        yield
    finally:
        random.setstate(python_state)
        np.random.set_state(numpy_state)
        th.set_rng_state(torch_state)


@contextmanager
def isolated_globals(seed: int) -> Iterator[None]:
    """Give all global generators other states inside, and their own ones back after.

    An environment that draws from them neither changes nor foresees what the training draws.

    :param seed: for the states inside, in [0, 2**32).
    """
    with globals_kept():
        seed_globals(seed)
        yield
