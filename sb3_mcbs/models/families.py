"""How environment classes compute observation, reward and termination, as array code.

A family is what :class:`~sb3_mcbs.models.mujoco_batch.MujocoBatchModel` needs to know about one environment
class: the attributes and ``MjData`` fields that it reads, and a function that computes the transitions of
many rows. ``docs/forward_models.md`` shows step by step how to add one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv

#: ``rows.qpos`` is ``[rows, nq]``, ``rows.xpos`` is ``[rows, nbody, 3]``, and so on.
Rows = SimpleNamespace
#: Observations ``[rows, *obs_shape]``, rewards ``[rows]``, terminated ``[rows]``.
Outcome = tuple[np.ndarray, np.ndarray, np.ndarray]


class Fields(NamedTuple):
    """Which ``MjData`` fields a transition reads.

    :param before: fields at the beginning of the step. Those that are not part of MuJoCo's state (``xpos``)
        lag behind it, exactly as they do in the environment.
    :param after: fields at the end of the step.
    """

    before: tuple[str, ...]
    after: tuple[str, ...]


class Constants:
    """What does not change from step to step, under the names that the environment uses.

    :param model: the environment's MuJoCo model.
    :param frame_skip: simulation substeps in an environment step.
    :param attributes: the environment's attributes that its family named.
    """

    def __init__(self, model: mujoco.MjModel, frame_skip: int, attributes: dict[str, Any]) -> None:
        self.model = model
        self.frame_skip = frame_skip
        self.dt = model.opt.timestep * frame_skip
        self.attributes = attributes

    def __getattr__(self, name: str) -> Any:
        # Only for names that are not set above; pickle asks before attributes exists.
        attributes = self.__dict__.get("attributes", {})
        if name in attributes:
            return attributes[name]
        raise AttributeError(
            f"{name!r} is not among the attributes that the family names "
            f"({', '.join(attributes) or 'none'}); add it to Family.attributes"
        )

    def body(self, key: int | str) -> int:
        """The id of a body, from its name or its id."""
        return int(self.model.body(key).id)


@dataclass(frozen=True)
class Family:
    """Array code for one environment class.

    :param attributes: names of the environment's attributes that ``fields`` and ``transition`` read.
    :param fields: ``fields(env) -> Fields``, with ``env`` a :class:`Constants`.
    :param transition: ``transition(env, before, after, actions) -> (observations, rewards,
        terminated)``, with the fields as ``[rows, ...]`` arrays (``before.qpos``) and the actions
        ``[rows, act_dim]`` in the dtype that the environment gets. It returns new arrays, and its
        numbers are the environment's own, bit for bit.
    """

    attributes: tuple[str, ...]
    fields: Callable[[Constants], Fields]
    transition: Callable[[Constants, Rows, Rows, np.ndarray], Outcome]


_FAMILIES: dict[type, Family] = {}


def register_family(env_class: type[MujocoEnv], family: Family) -> None:
    """Let the batch model simulate environments of a class.

    :param env_class: the environment class. Its subclasses are not included: they may override
        anything.
    :param family: its array code. It replaces the one that the class had.
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


# The helpers below repeat, for many rows, what NumPy computes for one. Other formulas that are as
# good mathematically round differently.


def row_norms(vectors: np.ndarray) -> np.ndarray:
    """``np.linalg.norm`` of each row of ``[rows, n]``, as for a vector on its own."""
    # norm(x, axis=1) squares and adds; norm(x) asks BLAS for a dot product, as vecdot does.
    if hasattr(np, "vecdot"):
        norms: np.ndarray = np.sqrt(np.vecdot(vectors, vectors))
        return norms
    return np.array([np.linalg.norm(vector) for vector in vectors])


def sum_of_squares(values: np.ndarray) -> np.ndarray:
    """``np.sum(np.square(row))`` of each row of ``[rows, ...]``, in the dtype of the values."""
    squares = np.square(values.reshape(len(values), -1))
    total: np.ndarray = squares.sum(axis=1)
    return total


def scalar_power(values: np.ndarray, exponent: int) -> np.ndarray:
    """``value ** exponent`` of each NumPy scalar in ``[rows]``."""
    # Scalars go through the C library's pow, arrays are squared: the last bit may differ.
    return np.array([value**exponent for value in values.tolist()])


def no_termination(rows: int) -> np.ndarray:
    """``terminated`` of environments that never end: ``[rows]`` False."""
    return np.zeros(rows, dtype=bool)
