"""Settings that check their values and name the invalid one."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any, ClassVar, Self


@dataclass(frozen=True)
class CheckedSettings:
    """Base of groups of settings: checks of single values, and conversion to an agent's attributes.

    Some fields are keywords of an agent's constructor and attributes of the agent (``beam_width``), the
    others are keys of a dictionary (``search_kwargs``).
    """

    #: The name of that dictionary, and of the fields that are keywords.
    group: ClassVar[str] = ""
    flat: ClassVar[tuple[str, ...]] = ()

    def _check_name(self, setting: str, known: tuple[str, ...], *others: str) -> None:
        value = getattr(self, setting)
        # Only strings are compared: arrays, for example, cannot be searched for in a tuple.
        if not isinstance(value, str) or value not in known:
            allowed = " or ".join([str(known), *others])
            raise ValueError(f"{setting} must be one of {allowed}, got {value!r}.")

    def _set_integer(self, name: str, low: int, high: int) -> None:
        value = getattr(self, name)
        if isinstance(value, bool) or not isinstance(value, Integral):
            raise TypeError(f"{name} must be an integer, got {value!r}.")
        if not low <= int(value) <= high:
            raise ValueError(f"{name} must be between {low} and {high}, got {value}.")
        # Products of NumPy integers could overflow.
        object.__setattr__(self, name, int(value))

    def _set_number(self, name: str, high: float) -> None:
        value = getattr(self, name)
        if isinstance(value, bool) or not isinstance(value, Real):
            raise TypeError(f"{name} must be a number, got {value!r}.")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        # Also refuses NaN.
        if not 0 <= number <= high:
            raise ValueError(f"{name} must be finite, not negative and at most {high:g}, got {value}.")
        object.__setattr__(self, name, number)

    def _check_flag(self, setting: str) -> None:
        value = getattr(self, setting)
        if not isinstance(value, bool):
            raise TypeError(f"{setting} must be True or False, got {value!r}.")

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names of all settings, in the constructor's order."""
        return tuple(field.name for field in fields(cls))

    @classmethod
    def in_group(cls) -> tuple[str, ...]:
        """The keys of :attr:`group`."""
        return tuple(name for name in cls.names() if name not in cls.flat)

    @classmethod
    def of(cls, agent: Any) -> Self:
        """Read the settings from an agent's attributes.

        :param agent: an object with settings as attributes, such as ``MCBSTD3``.
        :return: the checked settings.
        :raises TypeError: if a value has the wrong type, or a key is unknown.
        """
        values = {name: getattr(agent, name) for name in cls.flat}
        if cls.group:
            chosen = f"{cls.flat[0]}={values[cls.flat[0]]!r}"
            values |= known_keys(cls.group, getattr(agent, cls.group), cls.in_group(), chosen)
        return cls(**values)

    def grouped(self) -> dict[str, Any]:
        """The settings as attributes of an agent; the dictionary lists what differs from the defaults."""
        values: dict[str, Any] = {name: getattr(self, name) for name in self.flat}
        if self.group:
            changed = {f.name for f in fields(self) if getattr(self, f.name) != f.default}
            own = {name: getattr(self, name) for name in self.in_group() if name in changed}
            values[self.group] = own or None
        return values


def known_keys(
    group: str, given: Any, known: Collection[str], chosen: str, others: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Check the keys of a dictionary of settings.

    :param group: its name, such as ``search_kwargs``.
    :param given: the dictionary; ``None`` is an empty one.
    :param known: the valid keys.
    :param chosen: the choice that it belongs to, such as ``strategy='beam'``.
    :param others: explanations of other keys for the error.
    :return: a copy.
    :raises TypeError: if it is not a dictionary, or contains an unknown key.
    """
    given = as_dict(group, given)
    for key in given:
        if key not in known:
            where = f" {key} {others[key]}." if others and key in others else ""
            raise TypeError(f"{group} with {chosen} has no {key!r}; known are {', '.join(known)}.{where}")
    return given


def as_dict(group: str, given: Any) -> dict[str, Any]:
    """Copy a dictionary of settings.

    :param group: its name, such as ``search_kwargs``.
    :param given: the dictionary; ``None`` is an empty one.
    :raises TypeError: for anything else.
    """
    if given is not None and not isinstance(given, Mapping):
        raise TypeError(f"{group} must be a dictionary or None, got {given!r}.")
    return dict(given or {})
