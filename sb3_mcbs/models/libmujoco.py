"""The functions of libmujoco, to be called from compiled code.

They are called by symbol and not by address, since code that contains addresses cannot be kept on disk.
Models and simulations are passed as their addresses, arrays as those of their first entries.
"""

import ctypes
import functools
import weakref
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding
import mujoco
import numba
import numpy as np
from numba import types

from sb3_mcbs.models.compiling import JIT_IS_OFF, OPTIONS
from sb3_mcbs.snapshot.mujoco import DIVERGENCE_WARNINGS

INTEGRATION = int(mujoco.mjtState.mjSTATE_INTEGRATION)

_PATH = next(
    path
    for pattern in ("libmujoco*", "mujoco.dll")
    for path in sorted(Path(mujoco.__file__).parent.glob(pattern))
)
_library = ctypes.CDLL(str(_PATH))
llvmlite.binding.load_library_permanently(str(_PATH))

_ADDRESS = types.intp


def _function(name: str, result: Any, *arguments: Any) -> Any:
    """A function of libmujoco, for compiled code or, without compilation, for Python."""
    if not JIT_IS_OFF:
        return types.ExternalFunction(name, result(*arguments))
    kinds = {_ADDRESS: ctypes.c_void_p, types.int32: ctypes.c_int, types.void: None}
    function = getattr(_library, name)
    function.argtypes, function.restype = [kinds[argument] for argument in arguments], kinds[result]
    return function


mj_step = _function("mj_step", types.void, _ADDRESS, _ADDRESS)
mj_rne_post_constraint = _function("mj_rnePostConstraint", types.void, _ADDRESS, _ADDRESS)
mj_reset_data = _function("mj_resetData", types.void, _ADDRESS, _ADDRESS)
mj_set_state = _function("mj_setState", types.void, _ADDRESS, _ADDRESS, _ADDRESS, types.int32)
mj_get_state = _function("mj_getState", types.void, _ADDRESS, _ADDRESS, _ADDRESS, types.int32)
mjb_apply = _function(
    "mjb_apply", types.int32, _ADDRESS, _ADDRESS, types.int32, _ADDRESS, _ADDRESS, types.int32
)


class Simulation(NamedTuple):
    """What compiled code needs of one thread's ``MjData``.

    :param model: address of the model.
    :param data: address of the ``MjData``.
    :param guard: address of a batch of nothing, which catches MuJoCo's errors.
    :param stepper: address of the function that makes one environment step.
    :param job: ``[4]``, its arguments.
    :param controls: ``[nu]``, view of ``ctrl``.
    :param warnings: view of the counters of those warnings that mean divergence.
    """

    model: int
    data: int
    guard: int
    stepper: int
    job: np.ndarray
    controls: np.ndarray
    warnings: np.ndarray


class OwnedSimulation:
    """An ``MjData`` for one thread, and views of its fields.

    :param model: the model, not copied.
    :param frame_skip: MuJoCo steps in an environment step.
    :param fields: the ``MjData`` fields that will be read. ``mj_rnePostConstraint`` runs after every step if
        one of them needs it, as in Gymnasium.

    :ivar handle: for compiled code.
    :ivar fields: views of the fields.
    """

    def __init__(self, model: mujoco.MjModel, frame_skip: int, fields: tuple[str, ...]) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._guard = _Guard()
        with_forces = not {"cacc", "cfrc_int", "cfrc_ext"}.isdisjoint(fields)
        addresses = model._address, self._data._address
        self.handle = Simulation(
            *addresses,
            self._guard.address,
            _stepper().address,
            np.array([*addresses, frame_skip, with_forces], dtype=np.int64),
            self._data.ctrl,
            self._data.warning.number[DIVERGENCE_WARNINGS],
        )
        self.fields = tuple(getattr(self._data, name) for name in fields)


class _Guard:
    """A batch whose only purpose is :c:func:`mjb_apply`: it runs a function and catches MuJoCo's errors.

    Elsewhere an error ends the process.
    """

    def __init__(self) -> None:
        class Config(ctypes.Structure):
            _fields_ = (("nthread", ctypes.c_int), ("persistent", ctypes.c_bool))

        make, delete = _library.mjb_makeBatch, _library.mjb_deleteBatch
        make.restype, delete.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
        make.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.POINTER(Config), ctypes.c_char_p, ctypes.c_int]
        empty = mujoco.MjModel.from_xml_string("<mujoco/>")
        self.address = make(empty._address, 1, ctypes.byref(Config(1, False)), None, 0)
        weakref.finalize(self, delete, self.address)


@functools.cache
def _stepper() -> Any:
    signature = types.void(_ADDRESS, _ADDRESS, types.int32, types.CPointer(types.int64))
    try:
        return numba.cfunc(signature, cache=True, **OPTIONS)(_environment_step)
    except RuntimeError:  # no folder can be written
        return numba.cfunc(signature, **OPTIONS)(_environment_step)


def _environment_step(_model: int, _data: int, _number: int, job: Any) -> None:
    for _ in range(job[2]):
        mj_step(job[0], job[1])
    if job[3]:
        mj_rne_post_constraint(job[0], job[1])
