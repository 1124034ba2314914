"""Threads that run a family's compiled code, each on an ``MjData`` of its own."""

import copy
import importlib.util
from collections import namedtuple
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import numba
import numpy as np

from sb3_mcbs.models import compiled_rows
from sb3_mcbs.models.compiling import OPTIONS, announced, compiled, specialize, with_names
from sb3_mcbs.models.families import Constants, Family
from sb3_mcbs.models.libmujoco import OwnedSimulation


class Simulator:
    """A family's compiled code, and the threads that run it.

    :param family: the family.
    :param name: of the environment class.
    :param constants: what the family read from the environment.
    :param model: copied; later edits of it are not seen.
    :param frame_skip: MuJoCo steps in an environment step.
    :param n_threads: including the caller's.
    :raises ValueError: if the family names something that is not an array of ``MjData``, or its constants
        are not numbers or arrays.
    """

    def __init__(
        self,
        family: Family,
        name: str,
        constants: Constants,
        model: mujoco.MjModel,
        frame_skip: int,
        n_threads: int,
    ) -> None:
        self.model = copy.copy(model)
        template = mujoco.MjData(self.model)
        for field in family.fields:
            if not isinstance(getattr(template, field, None), np.ndarray):
                raise ValueError(f"{field!r} is not an array of MjData; a family's fields must be")
        for key, value in constants.items():
            if not isinstance(value, bool | int | float | np.generic | np.ndarray):
                raise ValueError(
                    f"the constant {key!r} is a {type(value).__name__}, not a number or an array"
                )
        self.family, self.name = family, name
        self._constants = tuple(constants.values())
        self._simulations = [OwnedSimulation(self.model, frame_skip, family.fields) for _ in range(n_threads)]
        self._inserted: dict[str, Any] = {
            "Constants": namedtuple("Constants", constants),
            "Data": namedtuple("Data", family.fields),
        }
        self._compiled: dict[str, Callable[..., None]] = {}
        self._threads = ThreadPoolExecutor(n_threads - 1) if n_threads > 1 else None

    def run(self, loop: Callable[..., None], n_rows: int, *arguments: Any) -> None:
        """Run a loop over rows on all threads, a share of the rows on each.

        :param loop: a function of this package with the arguments simulation, constants, fields,
            ``*arguments``, first row and row after the last.
        :param n_rows: number of rows.
        :param arguments: see ``loop``.
        """
        name = loop.__name__
        if name not in self._compiled:
            self._compiled[name] = self._specialize(loop)
            with announced():
                self._compiled[name](*self._share(0), *arguments, 0, 0)
        function, n_shares = self._compiled[name], max(1, min(len(self._simulations), n_rows))
        ends = [n_rows * (number + 1) // n_shares for number in range(n_shares)]
        others = []
        for number in range(1, n_shares):
            assert self._threads is not None
            share = (*self._share(number), *arguments, ends[number - 1], ends[number])
            others.append(self._threads.submit(function, *share))
        function(*self._share(0), *arguments, 0, ends[0])
        for other in others:
            other.result()

    def close(self) -> None:
        """Release the threads."""
        if self._threads is not None:
            self._threads.shutdown()

    def _share(self, number: int) -> tuple[Any, ...]:
        simulation = self._simulations[number]
        return simulation.handle, self._constants, simulation.fields

    def _specialize(self, loop: Callable[..., None]) -> Callable[..., None]:
        # A mistake in them must not write beyond the end of an array.
        checked = numba.njit(boundscheck=True, **OPTIONS)
        self._inserted.setdefault("transition", checked(self.family.transition))
        self._inserted.setdefault("keep", checked(self.family.keep))
        env_step = compiled(with_names(compiled_rows.env_step, self._inserted))
        module = self.family.transition.__module__
        inserted = {**self._inserted, "env_step": env_step}
        if not _can_be_imported(module):  # code on disk refers to it
            return compiled(with_names(loop, inserted))
        return specialize(loop, f"{module}.{self.name}", **inserted)


def _can_be_imported(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):  # a notebook or script
        return False
