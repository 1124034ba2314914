"""Independent random generators from one seed."""

from typing import Literal, get_args

import numpy as np

Purpose = Literal["schedule", "value expansion", "learned model"]


def spawn_rng(seed: int | None, purpose: Purpose) -> np.random.Generator:
    """Make a generator that is independent of an environment with this seed, and of other purposes.

    An environment that is reset with a seed uses ``np.random.default_rng(seed)``. A schedule with the same
    generator would be correlated with the environment.

    :param seed: ``None``: not reproducible.
    :param purpose: selects the generator.
    """
    return np.random.default_rng(None if seed is None else [seed, 1 + get_args(Purpose).index(purpose)])
