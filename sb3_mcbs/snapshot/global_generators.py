"""The process's global random generators: Python's, NumPy's, torch's. They belong to no environment."""

import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np


def global_states() -> tuple[Any, ...]:
    """Read the states of all global generators."""
    torch: Any = sys.modules.get("torch")
    torch_state = None if torch is None else torch.get_rng_state()
    return random.getstate(), np.random.get_state(), torch_state


def seed_globals(seed: int) -> None:
    """Seed all global generators.

    :param seed: in [0, 2**32).
    """
    random.seed(seed)
    np.random.seed(seed)
    torch: Any = sys.modules.get("torch")
    if torch is not None:
        torch.default_generator.manual_seed(seed)


@contextmanager
def globals_kept() -> Iterator[None]:
    """Put all global generators back to where they were."""
    python_state, numpy_state, torch_state = global_states()
    try:
        yield
    finally:
        random.setstate(python_state)
        np.random.set_state(numpy_state)
        if torch_state is not None:
            sys.modules["torch"].set_rng_state(torch_state)


@contextmanager
def isolated_globals(seed: int) -> Iterator[None]:
    """Give all global generators other states inside, and their own ones back after.

    An environment that draws from them neither changes nor foresees what the training draws.

    :param seed: for the states inside, in [0, 2**32).
    """
    with globals_kept():
        seed_globals(seed)
        yield
