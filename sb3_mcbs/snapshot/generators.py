"""Random generators and the sequences that they spawn from: reading, setting and seeding their states."""

import functools
import random
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

_U64 = 2**64
_CLASSES = (np.random.Generator, np.random.RandomState, np.random.BitGenerator, random.Random)

#: What a seed sequence consists of: entropy, spawn key, pool size, and how many children it has spawned.
Seeds = tuple[Any, tuple[int, ...], int, int]

_NO_SEEDS: Seeds = (0, (), 4, 0)
# Far from where any environment's own counter is, and below the end of its 32 bits.
_FIRST_OTHER_CHILD = 2**30


def is_generator(obj: Any) -> bool:
    """Return whether an object is a random generator whose state can be captured.

    :param obj: any object.
    """
    if isinstance(obj, _CLASSES):
        return not isinstance(obj, random.SystemRandom)
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(obj, torch.Generator)


def global_name(generator: Any) -> str | None:
    """Name a generator that belongs to the process, as that of ``np.random.normal``; None for others.

    :param generator: the generator.
    """
    return next((name for name, find in _GLOBALS.items() if find() is generator), None)


def global_generator(name: str) -> Any:
    """Return a generator that belongs to the process.

    :param name: what :func:`global_name` returned.
    """
    return _GLOBALS[name]()


_GLOBALS: dict[str, Callable[[], Any]] = {
    "numpy": lambda: np.random.mtrand._rand,
    "python": lambda: random._inst,
    "torch": lambda: getattr(sys.modules.get("torch"), "default_generator", None),
}


def bits_of(generator: Any) -> Any:
    """Return what the state of a generator lives in: NumPy's bit generator, or the generator itself.

    :param generator: the generator.
    """
    if isinstance(generator, np.random.Generator):
        return generator.bit_generator
    return generator


@functools.lru_cache(maxsize=64)
def pair_name(classes: tuple[type, type]) -> str:
    """Name the kind; states can be exchanged between generators of one kind.

    :param classes: what :func:`classes_of` returned for a generator.
    """
    generator_class, bits_class = classes
    outer = "" if bits_class is generator_class else f"{generator_class.__name__}:"
    return f"{outer}{bits_class.__module__}.{bits_class.__qualname__}"


def is_of_kind(obj: Any, kind: str) -> bool:
    """Return whether an object is a generator of a kind.

    :param obj: any object.
    :param kind: what :func:`pair_name` returned.
    """
    return is_generator(obj) and pair_name(classes_of(obj)) == kind


def sequence_of(generator: Any) -> np.random.SeedSequence | None:
    """Return the sequence that a generator spawns from, if it has one whose state can be captured.

    :param generator: the generator, or a sequence itself.
    """
    sequence = getattr(bits_of(generator), "seed_seq", generator)
    return sequence if type(sequence) is np.random.SeedSequence else None


def read_seeds(sequence: np.random.SeedSequence) -> Seeds:
    """Read the state of a sequence.

    :param sequence: the sequence.
    """
    entropy: Any = sequence.entropy
    if isinstance(entropy, np.ndarray):
        entropy = entropy.tolist()
    return entropy, sequence.spawn_key, sequence.pool_size, sequence.n_children_spawned


def set_seeds(sequence: np.random.SeedSequence, seeds: Seeds) -> None:
    """Put a sequence into a state, in place: whoever else holds it goes on with it.

    :param sequence: the sequence.
    :param seeds: what :func:`read_seeds` returned.
    """
    have = read_seeds(sequence)
    if have == seeds:
        return
    # NumPy lets nobody write the counter, but pickles of a sequence have it.
    if have[:3] == seeds[:3]:
        pickled = [*_pickled(sequence)]
        pickled[_counter_place()] = seeds[3]
    else:
        pickled = [*_pickled(make_sequence(seeds))]
    sequence.__setstate__(tuple(pickled))  # type: ignore[attr-defined]


def _pickled(sequence: Any) -> tuple[Any, ...]:
    return sequence.__reduce__()[2]


@functools.cache
def _counter_place() -> int:
    """Find the counter of children in the pickled state of a sequence."""
    pickled = _pickled(np.random.SeedSequence(0, n_children_spawned=_FIRST_OTHER_CHILD))
    return [type(part) is int and part == _FIRST_OTHER_CHILD for part in pickled].index(True)


def make_sequence(seeds: Seeds) -> np.random.SeedSequence:
    """Make a sequence in a state.

    :param seeds: what :func:`read_seeds` returned.
    """
    entropy, spawn_key, pool_size, n_spawned = seeds
    return np.random.SeedSequence(
        entropy, spawn_key=spawn_key, pool_size=pool_size, n_children_spawned=n_spawned
    )


def use_sequence(generator: Any, sequence: np.random.SeedSequence) -> None:
    """Have a generator spawn from a sequence.

    :param generator: the generator.
    :param sequence: the sequence.
    """
    bits = bits_of(generator)
    bits.__setstate__((bits.state, sequence))


def reseed_sequence(sequence: np.random.SeedSequence, seeds: Seeds, number: int) -> None:
    """Have a sequence spawn others than it would have spawned.

    :param sequence: the sequence.
    :param seeds: the state that the result depends on.
    :param number: a random number that it depends on, too.
    """
    # Another counter gives other children as surely as other entropy does, which would have to be hashed.
    set_seeds(sequence, (*seeds[:3], _FIRST_OTHER_CHILD + number % _FIRST_OTHER_CHILD))


def get_state(generator: Any) -> Any:
    """Read the state of a generator, as an object of its own.

    :param generator: the generator.
    """
    bits = bits_of(generator)
    if isinstance(bits, np.random.BitGenerator):
        return bits.state
    if isinstance(bits, np.random.RandomState):
        return bits.get_state(legacy=False)
    if isinstance(bits, random.Random):
        return bits.getstate()
    return bits.get_state().numpy().tobytes()


def set_state(generator: Any, state: Any) -> None:
    """Put a generator into a state.

    :param generator: the generator.
    :param state: what :func:`get_state` returned for a generator of the same kind.
    """
    bits = bits_of(generator)
    if isinstance(bits, np.random.BitGenerator):
        bits.state = state
    elif isinstance(bits, np.random.RandomState):
        bits.set_state(state)
    elif isinstance(bits, random.Random):
        bits.setstate(state)
    else:
        torch = sys.modules["torch"]
        bits.set_state(torch.frombuffer(bytearray(state), dtype=torch.uint8))


def reseed(generator: Any, rng: np.random.Generator, seeds: Seeds | None = _NO_SEEDS) -> None:
    """Start a generator afresh at a state drawn from another generator.

    :param generator: the generator to seed, of any kind.
    :param rng: where the seed is drawn from.
    :param seeds: for :func:`reseed_sequence` and its own sequence; None to leave that alone.
    """
    number = _reseed_bits(bits_of(generator), rng)
    sequence = None if seeds is None else sequence_of(generator)
    if sequence is not None and seeds is not None:
        reseed_sequence(sequence, seeds, number)


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


def make_like(generator_class: type, bits_class: type, sequence: np.random.SeedSequence | None = None) -> Any:
    """Make a generator whose state is about to be set.

    :param generator_class: the class of the generator.
    :param bits_class: the class of its bit generator; the same class if it has none.
    :param sequence: what it shall spawn from, if anything.
    """
    bits = bits_class() if sequence is None else bits_class(sequence)
    return bits if generator_class is bits_class else generator_class(bits)


def classes_of(generator: Any) -> tuple[type, type]:
    """Return what :func:`make_like` needs to make another generator of this kind.

    :param generator: the generator.
    """
    return type(generator), type(bits_of(generator))
