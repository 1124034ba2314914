"""Random numbers of one seed that have nothing to do with one another."""

from typing import Literal, get_args

import numpy as np

Purpose = Literal["schedule", "value expansion", "learned model"]


def spawn_rng(seed: int | None, purpose: Purpose) -> np.random.Generator:
    """Make a generator that has nothing in common with an environment of this seed, or with another purpose.

    ``np.random.default_rng(seed)`` is the generator of an environment that was reset with that seed: a
    schedule that drew from a second one could search exactly where the environment is about to be kind.

    :param seed: ``None``: not reproducible.
    :param purpose: what it is for.
    """
    return np.random.default_rng(None if seed is None else [seed, 1 + get_args(Purpose).index(purpose)])
