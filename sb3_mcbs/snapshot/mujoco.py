"""MuJoCo: models and data, whole and exact.

MuJoCo's own state vector leaves out what some environments read, such as ``xpos`` and ``cfrc_ext``,
which lag the state by one substep. So a snapshot holds a full ``MjData``, and besides the values of the
model, which environments may edit.
"""

import ctypes
import operator
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from sb3_mcbs.snapshot.errors import SnapshotMismatchError
from sb3_mcbs.snapshot.identity import ByIdentity
from sb3_mcbs.snapshot.mujoco_views import address, counterpart, place_of, public, view_at
from sb3_mcbs.snapshot.registry import SnapshotAdapter

#: Textures are most of a model's bytes, and only drawing reads them.
_LEFT_OUT = ("tex_data",)
_ALIGNMENT = 64
_MAX_SPARES = 128
# Sizes that tell a reader most about how two models differ come first in a message.
_TELLING = ("nq", "nv", "nu", "nbody", "njnt", "ngeom")
_MAX_SPARE_MODELS = 16

_BAD_NUMBERS = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
    int(mujoco.mjtWarning.mjWARN_BADCTRL),
]
#: The warnings after which MuJoCo resets the simulation or its controls. They follow each other, and a slice
#: is quicker than a list of indices. A full contact or constraint buffer is no divergence.
DIVERGENCE_WARNINGS = slice(min(_BAD_NUMBERS), max(_BAD_NUMBERS) + 1)


class _ModelLayout:
    """Where the values of one ``MjModel`` lie in memory, as few long blocks.

    :param model: the model. The blocks are only valid while it lives.
    """

    def __init__(self, model: Any) -> None:
        values = {name: getattr(model, name) for name in public(type(model))}
        arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
        # Pickled models have lost their signature.
        is_size = {name: type(value) is int and name != "signature" for name, value in values.items()}
        self.sizes = {name: value for name, value in values.items() if is_size[name]}
        self.names = bytes(model.names)
        self.blocks = _blocks(
            [array for name, array in arrays.items() if name not in _LEFT_OUT], arrays, model.nbuffer
        )
        # Their values are read for every snapshot; comparing MuJoCo's structures takes 100 times as long.
        self.scalars: list[str] = []
        self.vectors: list[str] = []
        for part in ("opt", "stat"):
            for name in public(type(getattr(model, part))):
                value = getattr(getattr(model, part), name)
                if isinstance(value, int | float):
                    self.scalars.append(f"{part}.{name}")
                elif isinstance(value, np.ndarray):
                    self.vectors.append(f"{part}.{name}")
        self._read_scalars = operator.attrgetter(*self.scalars)
        self._read_vectors = operator.attrgetter(*self.vectors)
        self.last: ModelState | None = None

    def read_blocks(self) -> list[bytes]:
        """Read the values of all arrays."""
        return [block.tobytes() for block in self.blocks]

    def read_options(self, model: Any) -> tuple[tuple[Any, ...], list[bytes]]:
        """Read the options and statistics.

        :param model: the model; a layout that held on to it would keep it alive.
        """
        return self._read_scalars(model), [vector.tobytes() for vector in self._read_vectors(model)]


def _blocks(wanted: list[np.ndarray], arrays: dict[str, np.ndarray], n_buffer: int) -> list[np.ndarray]:
    """Cover arrays that lie in one buffer by few views of bytes."""
    spans = sorted((address(array), address(array) + array.nbytes) for array in wanted if array.nbytes)
    ends = [(address(array), address(array) + array.nbytes) for array in arrays.values() if array.nbytes]
    one_buffer = max(end for _, end in ends) - min(start for start, _ in ends) <= n_buffer
    merged: list[list[int]] = []
    for start, end in spans:
        if merged and one_buffer and start - merged[-1][1] < _ALIGNMENT:
            merged[-1][1] = max(end, merged[-1][1])
        else:
            merged.append([start, end])
    return [
        np.ctypeslib.as_array((ctypes.c_uint8 * (end - start)).from_address(start)) for start, end in merged
    ]


class ModelState:
    """The values of an ``MjModel``: everything but textures and what only concerns drawing.

    :param model: the model to read.
    :param layout: of that model.
    """

    def __init__(self, model: Any, layout: _ModelLayout) -> None:
        self.sizes = layout.sizes
        self.names = layout.names
        self.blocks = layout.read_blocks()
        self.options = layout.read_options(model)

    def is_in(self, model: Any, layout: _ModelLayout) -> bool:
        """Return whether a model has exactly these values.

        :param model: the model.
        :param layout: of that model, which has the same sizes.
        """
        return self.options == layout.read_options(model) and self.blocks == layout.read_blocks()

    def write(self, model: Any, layout: _ModelLayout) -> None:
        """Give a model these values.

        :param model: the model.
        :param layout: of that model, which has the same sizes.
        """
        for mine, its in zip(self.blocks, layout.blocks, strict=True):
            its[:] = np.frombuffer(mine, np.uint8)
        scalars, vectors = self.options
        for path, value in zip(layout.scalars, scalars, strict=True):
            part, name = path.split(".")
            setattr(getattr(model, part), name, value)
        for path, content in zip(layout.vectors, vectors, strict=True):
            vector = operator.attrgetter(path)(model)
            vector.reshape(-1)[:] = np.frombuffer(content, vector.dtype)


_layouts: ByIdentity[_ModelLayout] = ByIdentity()


def _layout(model: Any) -> _ModelLayout:
    """Return the layout of a model, found once in its life."""
    return _layouts.get(model) or _layouts.put(model, _ModelLayout(model))


def _check_same_model(sizes: dict[str, int], names: bytes, layout: _ModelLayout) -> None:
    """Refuse a state of another model, naming what differs."""
    for name in (*_TELLING, *sizes):
        value = sizes.get(name)
        if layout.sizes.get(name) != value:
            raise SnapshotMismatchError(
                f"The snapshot is of another MuJoCo model: {name} is {value} in it and "
                f"{layout.sizes.get(name)} in this environment."
            )
    if names != layout.names:
        theirs, ours = (set(packed.decode(errors="replace").split("\0")) for packed in (names, layout.names))
        raise SnapshotMismatchError(
            "The snapshot is of another MuJoCo model: names such as "
            f"{sorted(theirs - ours)[:3]} are only in it, and {sorted(ours - theirs)[:3]} only in this one."
        )


def is_model(obj: Any) -> bool:
    """Return whether an object is an ``MjModel``.

    :param obj: any object.
    """
    return isinstance(obj, mujoco.MjModel)


def is_data(obj: Any) -> bool:
    """Return whether an object is an ``MjData``.

    :param obj: any object.
    """
    return isinstance(obj, mujoco.MjData)


class _MujocoAdapter(SnapshotAdapter):
    """What models and data have in common: a state belongs to one model, and both hand out views."""

    def _model_of(self, obj: Any) -> Any:
        return obj.model

    def validate(self, obj: Any, state: Any) -> None:
        layout = _layout(self._model_of(obj))
        if state.sizes != layout.sizes or state.names != layout.names:
            _check_same_model(state.sizes, state.names, layout)

    def place_of(self, obj: Any, view: Any) -> Any:
        return place_of(obj, view)

    def view_at(self, obj: Any, place: Any) -> Any:
        return view_at(obj, place)

    def clone_view(self, obj: Any, new: Any, view: Any) -> Any:
        return counterpart(obj, new, view)


class MjModelAdapter(_MujocoAdapter):
    """Captures the values of a model; snapshots share them for as long as nobody edits the model."""

    what = "MuJoCo's model"

    def _model_of(self, obj: Any) -> Any:
        return obj

    def capture(self, obj: Any) -> ModelState:
        layout = _layout(obj)
        if layout.last is None or not layout.last.is_in(obj, layout):
            layout.last = ModelState(obj, layout)
        return layout.last

    def restore(self, obj: Any, state: ModelState) -> None:
        layout = _layout(obj)
        if not state.is_in(obj, layout):
            state.write(obj, layout)
            layout.last = state

    def clone(self, obj: Any, copy: Callable[[Any], Any]) -> Any:
        return obj.__copy__()


# Making an MjData takes 100 times as long as copying into one, so those of dropped snapshots are used again.
_spares: OrderedDict[tuple[int, ...], list[Any]] = OrderedDict()


def _spares_for(sizes: tuple[int, ...]) -> list[Any]:
    spares = _spares.get(sizes)
    if spares is None:
        spares = _spares[sizes] = []
        while len(_spares) > _MAX_SPARE_MODELS:
            _spares.popitem(last=False)
    return spares


# Fields of MjData that MuJoCo's own pickling forgets.
_NOT_PICKLED = ("flg_rnepost", "nl", "solver_niter", "solver_nnz")


class DataState:
    """A private ``MjData`` that holds a state.

    :param data: what to copy.
    :param model: the model that ``data`` was made for.
    """

    def __init__(self, data: Any, model: Any) -> None:
        layout = _layout(model)
        self.sizes = layout.sizes
        self.names = layout.names
        self._spares = _spares_for(tuple(layout.sizes.values()))
        try:
            self._data = self._spares.pop()
        except IndexError:
            self._data = mujoco.MjData(model)
        self._pickled: dict[str, Any] | None = None
        mujoco.mj_copyData(self._data, model, data)

    def write(self, data: Any, model: Any) -> None:
        """Copy the state into an ``MjData``.

        :param data: where to.
        :param model: the model that ``data`` was made for.
        """
        if self._pickled is not None:
            self._data, self._pickled = _unpickled(self._pickled, model), None
        mujoco.mj_copyData(data, model, self._data)

    def __del__(self) -> None:
        data = getattr(self, "_data", None)
        if data is not None and len(self._spares) < _MAX_SPARES:
            self._spares.append(data)

    def __getstate__(self) -> dict[str, Any]:
        pickled = self._pickled or _pickled(self._data)
        return {"sizes": self.sizes, "names": self.names, "_pickled": pickled}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _data=None, _spares=_spares_for(tuple(state["sizes"].values())))


def _pickled(data: Any) -> dict[str, Any]:
    """Return what a pickle holds of an ``MjData``."""
    content, model = data.__getstate__(), data.model.__getstate__()
    # MuJoCo puts the whole model in front, which whoever restores the state has already.
    start = content.find(model)
    cut = start >= 0
    parts = (content[:start], content[start + len(model) :]) if cut else (content,)
    kept = {name: getattr(data, name) for name in _NOT_PICKLED if hasattr(data, name)}
    return {
        "parts": parts,
        "kept": {n: np.array(v) if isinstance(v, np.ndarray) else v for n, v in kept.items()},
    }


def _unpickled(pickled: dict[str, Any], model: Any) -> Any:
    """Make the ``MjData`` that :func:`_pickled` was given."""
    parts = pickled["parts"]
    content = parts[0] if len(parts) == 1 else parts[0] + model.__getstate__() + parts[1]
    data = mujoco.MjData.__new__(mujoco.MjData)
    data.__setstate__(content)
    for name, value in pickled["kept"].items():
        if isinstance(value, np.ndarray):
            getattr(data, name)[...] = value
        else:
            setattr(data, name, value)
    return data


class MjDataAdapter(_MujocoAdapter):
    """Captures a whole ``MjData``."""

    what = "MuJoCo's data"

    def capture(self, obj: Any) -> DataState:
        return DataState(obj, obj.model)

    def restore(self, obj: Any, state: DataState) -> None:
        state.write(obj, obj.model)

    def clone(self, obj: Any, copy: Callable[[Any], Any]) -> Any:
        model = copy(obj.model)
        data = mujoco.MjData(model)
        mujoco.mj_copyData(data, model, obj)
        return data

    def watch(self, obj: Any) -> Callable[[], bool]:
        # A view of MuJoCo's own memory: making it takes longer than reading it. Time that runs backwards is
        # no sign of its own: environments may reset their simulator on purpose, which clears the warnings.
        numbers = obj.warning.number[DIVERGENCE_WARNINGS]

        def diverged() -> bool:
            if not any(numbers.tolist()):
                return False
            # MuJoCo clears the warnings when it resets itself, so that a count does not grow each time.
            obj.warning.number[DIVERGENCE_WARNINGS] = 0
            return True

        return diverged
