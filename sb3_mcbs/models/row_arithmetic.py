"""What NumPy computes for one environment, to the bit, as functions for families.

Other formulas that are as good mathematically round differently. Without compilation these functions give
the same results.
"""

import math
from fractions import Fraction

import numba
import numpy as np

from sb3_mcbs.models.compiling import JIT_IS_OFF, OPTIONS, compiled


@compiled
def numpy_sum(values: np.ndarray) -> float:
    """``np.sum(values)`` for ``[n]``: from eight entries on, NumPy adds in eight accumulators."""
    n = len(values)
    if n > 128:
        half = n // 2 - n // 2 % 8
        return numpy_sum(values[:half]) + numpy_sum(values[half:])
    if n < 8:
        total = values[0]
        for i in range(1, n):
            total += values[i]
        return total
    sums = values[:8].copy()
    whole = n - n % 8
    for i in range(8, whole):
        sums[i % 8] += values[i]
    total = ((sums[0] + sums[1]) + (sums[2] + sums[3])) + ((sums[4] + sums[5]) + (sums[6] + sums[7]))
    for i in range(whole, n):
        total += values[i]
    return total


@compiled
def sum_of_squares(values: np.ndarray) -> float:
    """``np.sum(np.square(values))`` of an array of any shape, in its dtype."""
    return numpy_sum(np.square(values).ravel())


@compiled
def weighted_squares(weight: float, widens: bool, values: np.ndarray) -> float:
    """``weight * np.sum(np.square(values))`` as a float64.

    :param weight: the factor.
    :param widens: from :func:`widens`. False: the product has the dtype of ``values``.
    :param values: array of any shape.
    """
    total = sum_of_squares(values)
    if widens:
        return weight * np.float64(total)
    return np.float64(values.dtype.type(weight) * total)


def widens(weight: object) -> bool:
    """Whether a float32 times this weight is a float64: NumPy's own numbers are stronger than Python's."""
    return bool(np.asarray(weight * np.float32(1)).dtype == np.float64)  # type: ignore[operator]


@compiled
def scalar_power(value: float, exponent: float) -> float:
    """``value ** exponent`` of a NumPy scalar, by the C library's ``pow``."""
    # The compiler would turn pow(x, 2) into x * x, whose last bit may differ; this it cannot foresee.
    return math.pow(value, exponent + 0.0 * value)


@numba.njit(**OPTIONS, fastmath={"contract"})
def _fused_norm(vector: np.ndarray) -> float:
    total = 0.0
    for value in vector:
        total += value * value
    return math.sqrt(total)


@compiled
def _rounded_norm(vector: np.ndarray) -> float:
    total = vector[0] * vector[0]
    for i in range(1, len(vector)):
        total += vector[i] * vector[i]
    return math.sqrt(total)


def blas_fuses() -> bool:
    """Whether NumPy's BLAS does not round products before it adds them, which depends on the processor."""
    for vector in np.random.default_rng(0).normal(size=(100, 3)):
        fused = rounded = 0.0
        for value in vector.tolist():
            fused = float(Fraction(value) ** 2 + Fraction(fused))
            rounded += value * value
        if fused != rounded:
            return bool(vector.dot(vector) == fused)
    return False


#: ``np.linalg.norm(vector)`` for short vectors.
norm = np.linalg.norm if JIT_IS_OFF else _fused_norm if blas_fuses() else _rounded_norm


@compiled
def put(target: np.ndarray, start: int, values: np.ndarray) -> int:
    """Write an array of any shape into ``target``, flat.

    :param target: ``[n]``.
    :param start: where to begin.
    :param values: the values.
    :return: the position after the last written one.
    """
    flat = values.ravel()
    end = start + flat.size
    target[start:end] = flat
    return end


@compiled
def put_clipped(target: np.ndarray, start: int, values: np.ndarray, low: float, high: float) -> int:
    """As :func:`put`, for ``np.clip(values, low, high)``.

    :param target: ``[n]``.
    :param start: where to begin.
    :param values: the values.
    :param low: lower bound.
    :param high: upper bound.
    :return: the position after the last written one.
    """
    end = put(target, start, values)
    for i in range(start, end):
        if target[i] < low:
            target[i] = low
        elif target[i] > high:
            target[i] = high
    return end


@compiled
def all_finite(values: np.ndarray) -> bool:
    """``np.isfinite(values).all()`` for ``[n]``."""
    for value in values:  # noqa: SIM110
        if not np.isfinite(value):
            return False
    return True
