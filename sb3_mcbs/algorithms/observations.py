"""Rows of observations, and whether two are the same, for one array or one per key."""

from typing import Any

import numpy as np

from sb3_mcbs.models.base import Observations


def row_of(observations: Observations, index: int) -> Any:
    """One of them.

    :param observations: ``[rows, *obs_shape]``.
    :param index: which row.
    """
    if isinstance(observations, dict):
        return {key: value[index] for key, value in observations.items()}
    return observations[index]


def n_rows(observations: Observations) -> int:
    """How many there are.

    :param observations: ``[rows, *obs_shape]``.
    """
    return len(next(iter(observations.values()))) if isinstance(observations, dict) else len(observations)


def equal(left: Observations, right: Observations) -> bool:
    """Whether two are the same; NaN is not equal to itself.

    :param left: ``[rows, *obs_shape]``.
    :param right: the others.
    """
    if isinstance(left, dict):
        return isinstance(right, dict) and all(np.array_equal(left[key], right[key]) for key in left)
    # What np.array_equal does, without its Python.
    return not isinstance(right, dict) and left.shape == right.shape and bool((left == right).all())


def difference(left: Any, right: Any) -> float:
    """Largest absolute difference; two NaNs are equal, a NaN and a number are infinitely far apart.

    :param left: one observation, or a number.
    :param right: the other.
    """
    if isinstance(left, dict):
        return max(difference(left[key], right[key]) for key in left)
    left, right = np.asarray(left, np.float64), np.asarray(right, np.float64)
    if np.array_equal(left, right, equal_nan=True):
        return 0.0
    distance = np.abs(left - right)
    return float(np.where(np.isnan(distance), np.inf, distance).max())
