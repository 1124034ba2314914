"""Settings that check themselves, and name the one that is wrong."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any, ClassVar, Self


@dataclass(frozen=True)
class CheckedSettings:
    """What groups of settings share: checks of one value, and the form in which agents have them.

    Some fields are keywords of an agent's constructor and attributes of the agent (``beam_width``), the
    others are keys of a dictionary that is one (``search_kwargs``).
    """

    #: The name of that dictionary, and of the fields that are keywords themselves.
    group: ClassVar[str] = ""
    flat: ClassVar[tuple[str, ...]] = ()

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
    def in_group(cls) -> tuple[str, ...]:
        """What :attr:`group` may contain."""
        return tuple(name for name in cls.names() if name not in cls.flat)

    @classmethod
    def of(cls, agent: Any) -> Self:
        """Read the settings that an agent carries as attributes.

        :param agent: an object that has settings as attributes, such as ``MCBSTD3``.
        :return: the checked settings.
        :raises TypeError: if a value has the wrong type, or a key is not known.
        """
        values = {name: getattr(agent, name) for name in cls.flat}
        if cls.group:
            chosen = f"{cls.flat[0]}={values[cls.flat[0]]!r}"
            values |= known_keys(cls.group, getattr(agent, cls.group), cls.in_group(), chosen)
        return cls(**values)

    def grouped(self) -> dict[str, Any]:
        """The settings as an agent has them: by name, and in a dictionary what is not at its default."""
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
    :param known: what it may contain.
    :param chosen: the choice that it goes with, such as ``strategy='beam'``.
    :param others: what to say of other keys.
    :return: a copy.
    :raises TypeError: if it is no dictionary, or names a key that is not known.
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
    :raises TypeError: if it is neither.
    """
    if given is not None and not isinstance(given, Mapping):
        raise TypeError(f"{group} must be a dictionary or None, got {given!r}.")
    return dict(given or {})
