"""How environment classes compute observation, reward and termination, as functions of one row.

A family is what :class:`~sb3_mcbs.models.mujoco_batch.MujocoBatchModel` needs to know about one environment
class: plain Python functions of one simulation, which numba compiles. ``docs/fast_path.md`` shows step by
step how to add one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.envs.mujoco import MujocoEnv

#: Numbers, booleans and arrays by name.
Constants = dict[str, Any]


def keep_nothing(env: Any, data: Any, kept: np.ndarray) -> None:
    """The ``keep`` of families whose transitions depend on nothing but the state after the step."""


@dataclass(frozen=True)
class Family:
    """One environment class.

    ``transition`` and ``keep`` are compiled, so they use what numba supports. In them ``env.dt`` is a
    constant, and ``data.qpos`` a field of the row's ``MjData``.

    :param constants: ``constants(env) -> dict``, in plain Python: the numbers, booleans and arrays that a
        step reads, by name. ``env`` is the environment.
    :param fields: the ``MjData`` fields that a step reads.
    :param transition: ``transition(env, kept, data, action, observation) -> (reward, terminated)``, after
        MuJoCo's steps. It writes into ``observation`` ``[obs_dim]``. The action has the dtype that the
        environment gets. Its numbers are the environment's own, bit for bit.
    :param keep: ``keep(env, data, kept)``, after a step: writes into ``kept`` ``[n_kept]`` what the next
        transition must know of the time before its step.
    :param n_kept: how many numbers that are.
    """

    constants: Callable[[Any], Constants]
    fields: tuple[str, ...]
    transition: Callable[[Any, np.ndarray, Any, np.ndarray, np.ndarray], tuple[float, bool]]
    keep: Callable[[Any, Any, np.ndarray], None] = keep_nothing
    n_kept: int = 0


_FAMILIES: dict[type, Family] = {}


def register_family(env_class: type[MujocoEnv], family: Family) -> None:
    """Let the batch model simulate environments of a class.

    :param env_class: the environment class. Its subclasses are not included: they may override
        anything.
    :param family: its functions. It replaces the one that the class had.
    :raises TypeError: if ``env_class`` is not a ``MujocoEnv`` or ``family`` not a ``Family``.
    """
    if not (isinstance(env_class, type) and issubclass(env_class, MujocoEnv)):
        raise TypeError(f"register_family wants a subclass of gymnasium's MujocoEnv, got {env_class!r}")
    if not isinstance(family, Family):
        raise TypeError(f"register_family wants a Family for {env_class.__name__}, got {family!r}")
    _FAMILIES[env_class] = family


def family_of(env_class: type) -> Family | None:
    """The family of exactly this class, or None."""
    return _FAMILIES.get(env_class)


def known_families() -> tuple[type, ...]:
    """Every class that has a family."""
    return tuple(_FAMILIES)
