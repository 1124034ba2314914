"""Settings that check themselves, and name the one that is wrong."""

import math
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any, Self


@dataclass(frozen=True)
class CheckedSettings:
    """What groups of settings share: checks of one value, and reading from an agent that carries them."""

    def _check_name(self, setting: str, known: tuple[str, ...], *others: str) -> None:
        value = getattr(self, setting)
        # Names are compared as strings only: an array, say, has no answer to whether it is in a tuple.
        if not isinstance(value, str) or value not in known:
            allowed = " or ".join([str(known), *others])
            raise ValueError(f"{setting} must be one of {allowed}, got {value!r}.")

    def _set_integer(self, name: str, low: int, high: int) -> None:
        value = getattr(self, name)
        if isinstance(value, bool) or not isinstance(value, Integral):
            raise TypeError(f"{name} must be an integer, got {value!r}.")
        if not low <= int(value) <= high:
            raise ValueError(f"{name} must be between {low} and {high}, got {value}.")
        # NumPy's integers have few bits, and products of settings overflow.
        object.__setattr__(self, name, int(value))

    def _set_number(self, name: str, high: float) -> None:
        value = getattr(self, name)
        if isinstance(value, bool) or not isinstance(value, Real):
            raise TypeError(f"{name} must be a number, got {value!r}.")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        # NaN is not between anything.
        if not 0 <= number <= high:
            raise ValueError(f"{name} must be finite, not negative and at most {high:g}, got {value}.")
        object.__setattr__(self, name, number)

    def _check_flag(self, setting: str) -> None:
        value = getattr(self, setting)
        if not isinstance(value, bool):
            raise TypeError(f"{setting} must be True or False, got {value!r}.")

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names of all settings, in the order of the constructor."""
        return tuple(field.name for field in fields(cls))

    @classmethod
    def of(cls, agent: Any) -> Self:
        """Read the settings that an agent carries as attributes.

        :param agent: an object that has settings as attributes, such as ``MCBSTD3``; those that it lacks have
            their defaults.
        :return: the checked settings.
        """
        # An agent that was saved before a setting existed searches as if it had its default.
        values: dict[str, Any] = {
            field.name: getattr(agent, field.name, field.default) for field in fields(cls)
        }
        return cls(**values)
