"""The replay buffer's rows: only what is new since the last checkpoint is written."""

from typing import Any

import numpy as np
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer

from sb3_mcbs.agents.expanded_buffer import ARRAYS as EXPANSION_ARRAYS
from sb3_mcbs.agents.expanded_buffer import make_room
from sb3_mcbs.checkpoints.errors import CheckpointError

#: Buffers that only ever write the row at their position, the one before and the one after.
KNOWN = (ReplayBuffer, NStepReplayBuffer, DictReplayBuffer, HerReplayBuffer)
STATES = EXPANSION_ARRAYS[0]
#: What HER writes into older rows too is small, so all of it is part of every checkpoint.
REWRITTEN = ("ep_start", "ep_length")


def check_buffer(buffer: Any) -> None:
    """Refuse a buffer whose rows may change in a way that is not known.

    :param buffer: the replay buffer.
    :raises CheckpointError: names its class.
    """
    # An expanded buffer writes its rows as the class does that it is made of.
    if getattr(type(buffer), "base_class", type(buffer)) not in KNOWN:
        names = ", ".join(cls.__name__ for cls in KNOWN)
        raise CheckpointError(
            f"Which rows a {type(buffer).__name__} writes is not known, so it cannot be saved row by row. "
            f"Known are {names}."
        )
    if isinstance(buffer, HerReplayBuffer) and buffer.copy_info_dict:
        raise CheckpointError(
            "HerReplayBuffer with copy_info_dict=True keeps whole info dictionaries, which a checkpoint does "
            "not hold. Use copy_info_dict=False."
        )


def row_arrays(buffer: ReplayBuffer) -> dict[str, np.ndarray]:
    """Return the arrays that hold the rows.

    :param buffer: the replay buffer.
    :return: by name, ``[buffer_size, n_envs, ...]``.
    """
    arrays: dict[str, Any] = {}
    for name, value in vars(buffer).items():
        arrays |= (
            {f"{name}/{key}": v for key, v in value.items()} if isinstance(value, dict) else {name: value}
        )
    return {name: array for name, array in arrays.items() if name not in REWRITTEN and _holds_rows(array)}


def _holds_rows(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.ndim > 1 and not value.dtype.hasobject


def row_attributes(buffer: ReplayBuffer) -> set[str]:
    """Return the names of the attributes that hold the rows, HER's empty info dictionaries included.

    :param buffer: the replay buffer.
    """
    return {name.partition("/")[0] for name in row_arrays(buffer)} | {"infos"}


def rows_held(buffer: ReplayBuffer) -> int:
    """Return how many rows there are.

    :param buffer: the replay buffer.
    """
    return buffer.buffer_size if buffer.full else buffer.pos


def read_rows(buffer: ReplayBuffer, first: int, end: int) -> dict[str, np.ndarray]:
    """Copy rows.

    One row before and one after go with them: the last row may be marked as an episode's end after it was
    written, and with ``optimize_memory_usage`` an observation is written ahead.

    :param buffer: the replay buffer.
    :param first: number of the first row, counted since the beginning.
    :param end: one more than the number of the last row: the number of rows added since the beginning.
    :return: the rows, and their positions in the buffer.
    """
    size = buffer.buffer_size
    shift = buffer.pos - end  # a buffer that was filled before the run began need not have begun at 0
    n_rows = min(end - first + 2, size)
    positions = (np.arange(first - 1, first - 1 + n_rows) + shift) % size
    rows = {name: array[positions] for name, array in row_arrays(buffer).items()}
    return {**rows, "positions": positions}


def write_rows(buffer: ReplayBuffer, parts: list[dict[str, np.ndarray]]) -> None:
    """Put rows back.

    :param buffer: an equal buffer. It gets the states of value expansion that was switched on in the run.
    :param parts: from :func:`read_rows`, in the order in which they were read.
    :raises CheckpointError: if they are of another buffer.
    """
    if parts and STATES in parts[-1]:
        make_room(buffer, parts[-1][STATES].shape[-1])
    arrays = row_arrays(buffer)
    for part in parts:
        part = dict(part)
        positions = part.pop("positions")
        if part.keys() != arrays.keys() and part.keys() != arrays.keys() - {*EXPANSION_ARRAYS}:
            raise CheckpointError(f"The rows hold {sorted(part)}, this replay buffer {sorted(arrays)}.")
        if len(positions) and not (positions.min() >= 0 and positions.max() < buffer.buffer_size):
            raise CheckpointError("The rows are of a larger replay buffer.")
        for name in part:
            array = arrays[name]
            if part[name].dtype != array.dtype or part[name].shape[1:] != array.shape[1:]:
                raise CheckpointError(
                    f"The rows' {name} are {part[name].dtype} {part[name].shape[1:]}, this replay buffer's "
                    f"{array.dtype} {array.shape[1:]}."
                )
            array[positions] = part[name]


def added_rows(buffer: ReplayBuffer, position_before: int, steps: int) -> int:
    """Return how many rows were added.

    The position alone does not say how often a buffer was filled, and not every step need add a row.

    :param buffer: the replay buffer.
    :param position_before: its position then.
    :param steps: steps since then, at most this many rows.
    """
    moved = (buffer.pos - position_before) % buffer.buffer_size
    return steps - (steps - moved) % buffer.buffer_size
