"""What steps gave, compared bit by bit."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np


class Outcome(NamedTuple):
    """What one step gave; ``raised`` names the class of what it raised instead, ``error`` all of it."""

    observation: Any = None
    reward: Any = None
    terminated: Any = None
    truncated: Any = None
    raised: str | None = None
    error: str = ""

    @property
    def ends(self) -> bool:
        """Whether no step can follow."""
        return bool(self.raised or self.terminated or self.truncated)


def first_difference(expected: list[Outcome], seen: list[Outcome]) -> tuple[int, str] | None:
    """Find the first step in which two runs differ.

    :param expected: what the steps of one run gave.
    :param seen: what those of the other run gave.
    :return: its number, and what differed in words; None if nothing did.
    """
    for step, (one, other) in enumerate(zip(expected, seen, strict=False)):
        if one.raised != other.raised:
            return step, f"raised {other.error}" if other.raised else f"did not raise {one.error}"
        for name in ("observation", "reward", "terminated", "truncated"):
            for path, value, its in _leaves(getattr(one, name), getattr(other, name), name):
                if not _is_same(value, its):
                    return step, f"gave {_in_words(path, value, its)}"
    return None


def _leaves(one: Any, other: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
    """Go through two values of the same structure; where it differs they are leaves themselves."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        for key in one:
            yield from _leaves(one[key], other[key], f"{path}[{key!r}]")
    elif isinstance(one, tuple | list) and isinstance(other, tuple | list) and len(one) == len(other):
        for place in range(len(one)):
            yield from _leaves(one[place], other[place], f"{path}[{place}]")
    else:
        yield path, one, other


def _is_same(one: Any, other: Any) -> bool:
    one, other = np.asarray(one), np.asarray(other)
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    return bool(np.array_equal(one, other)) if one.dtype.hasobject else one.tobytes() == other.tobytes()


def _in_words(path: str, one: Any, other: Any) -> str:
    one, other = np.asarray(one), np.asarray(other)
    if one.shape == other.shape and one.ndim and one.dtype == other.dtype and not one.dtype.hasobject:
        places = np.argwhere([not _is_same(a, b) for a, b in zip(one.ravel(), other.ravel(), strict=True)])
        index = np.unravel_index(int(places[0, 0]), one.shape)
        path += f"[{', '.join(map(str, index))}]"
        one, other = one[index], other[index]
    return f"{path} = {other} instead of {one}"
