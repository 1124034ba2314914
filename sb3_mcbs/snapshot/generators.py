"""Random generators: reading, setting and seeding their states."""

import random
import sys
from typing import Any

import numpy as np

_U64 = 2**64


def is_generator(obj: Any) -> bool:
    """Return whether an object is a random generator whose state can be captured.

    :param obj: any object.
    """
    if isinstance(obj, np.random.Generator | np.random.RandomState | np.random.BitGenerator | random.Random):
        return not isinstance(obj, random.SystemRandom)
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(obj, torch.Generator)


def _bits(generator: Any) -> Any:
    """Return NumPy's bit generator, which is where the state lives."""
    if isinstance(generator, np.random.Generator):
        return generator.bit_generator
    return generator


def kind_of_generator(generator: Any) -> str:
    """Name the kind; states can be exchanged between generators of one kind.

    :param generator: the generator.
    """
    bits = _bits(generator)
    outer = "" if bits is generator else f"{type(generator).__name__}:"
    return f"{outer}{type(bits).__module__}.{type(bits).__qualname__}"


def get_state(generator: Any) -> Any:
    """Read the state of a generator, as an object of its own.

    :param generator: the generator.
    """
    bits = _bits(generator)
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
    bits = _bits(generator)
    if isinstance(bits, np.random.BitGenerator):
        bits.state = state
    elif isinstance(bits, np.random.RandomState):
        bits.set_state(state)
    elif isinstance(bits, random.Random):
        bits.setstate(state)
    else:
        torch = sys.modules["torch"]
        bits.set_state(torch.frombuffer(bytearray(state), dtype=torch.uint8))


def reseed(generator: Any, rng: np.random.Generator) -> None:
    """Start a generator afresh at a state drawn from another generator.

    :param generator: the generator to seed, of any kind.
    :param rng: where the seed is drawn from.
    """
    bits = _bits(generator)
    if type(bits) is np.random.PCG64:
        # Every state and every odd increment is a valid PCG64 stream. Drawing them directly is far cheaper
        # than hashing a seed, and look-ahead does this for every row at every decision.
        high, low, stream_high, stream_low = rng.integers(0, _U64, size=4, dtype=np.uint64).tolist()
        stream = (stream_high * _U64 + stream_low) | 1
        bits.state = {
            "bit_generator": "PCG64",
            "state": {"state": high * _U64 + low, "inc": stream},
            "has_uint32": 0,
            "uinteger": 0,
        }
        return
    seed = int(rng.integers(2**63))
    if isinstance(bits, np.random.BitGenerator):
        bits.state = type(bits)(seed).state
    elif isinstance(bits, np.random.RandomState):
        bits.set_state(np.random.RandomState(np.random.MT19937(seed)).get_state(legacy=False))
    elif isinstance(bits, random.Random):
        bits.seed(seed)
    else:
        bits.manual_seed(seed)


def make_like(generator_class: type, bits_class: type) -> Any:
    """Make a generator whose state is about to be set.

    :param generator_class: the class of the generator.
    :param bits_class: the class of its bit generator; the same class if it has none.
    """
    if generator_class is bits_class:
        return generator_class()
    return generator_class(bits_class())


def classes_of(generator: Any) -> tuple[type, type]:
    """Return what :func:`make_like` needs to make another generator of this kind.

    :param generator: the generator.
    """
    return type(generator), type(_bits(generator))
