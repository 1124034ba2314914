"""Batches at fixed addresses on a device, as captured gradient steps need them.

Torch's graphs replay copies from the same addresses, so every batch is written to where the first one was.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

logger = logging.getLogger("sb3_mcbs")

#: Float32 entries that are copied to a device at once.
_CHUNK = 1 << 18
#: What draws a batch; a user may replace it.
_DRAWING = tuple(
    (cls, name, getattr(cls, name))
    for cls, name in ((ReplayBuffer, "sample"), (ReplayBuffer, "_get_samples"), (BaseBuffer, "sample"))
)


class Staging:
    """Copies float32 numbers to a device without waiting for it.

    :param size: the most numbers of one copy.
    :param device: the device.
    """

    #: Copies under way: memory is written again only after its copy.
    n_slots = 4

    def __init__(self, size: int, device: th.device) -> None:
        on_gpu = device.type == "cuda"
        self._slots = [th.empty(size, pin_memory=on_gpu) for _ in range(self.n_slots)]
        self._copied = [th.cuda.Event() for _ in range(self.n_slots)] if on_gpu else []
        self._next = 0

    def numbers(self, size: int) -> np.ndarray:
        """Memory for the next copy.

        :param size: number of entries.
        :return: ``[size]`` float32, to be filled.
        """
        self._next = (self._next + 1) % self.n_slots
        if self._copied:
            self._copied[self._next].synchronize()
        numbers: np.ndarray = self._slots[self._next][:size].numpy()
        return numbers

    def send(self, target: th.Tensor) -> None:
        """Copy the memory of the last :meth:`numbers`.

        :param target: contiguous float32 tensor on the device.
        """
        target.view(-1).copy_(self._slots[self._next][: target.numel()], non_blocking=True)
        if self._copied:
            self._copied[self._next].record()


class CopiedBatches:
    """Batches that a replay buffer of any class draws on the CPU, copied in one piece.

    :param buffer: the replay buffer; its observations are no dictionaries.
    :param batch_size: transitions.
    :param device: where the batches are needed.
    """

    def __init__(self, buffer: ReplayBuffer, batch_size: int, device: th.device) -> None:
        self._buffer, self._batch_size, self._device = buffer, batch_size, device
        #: Whether there was no room for :class:`MirroredBatches`.
        self.instead = False
        self._widths: list[int] = []
        self._parts: list[th.Tensor] = []
        self._ahead: Callable[[], None] | None = None

    def fits(self, buffer: ReplayBuffer, batch_size: int, env: VecNormalize | None) -> bool:
        """Whether these are batches of this size from this replay buffer."""
        known = buffer is self._buffer and batch_size == self._batch_size
        return known and (self.instead or not _may_mirror(buffer, env))

    def draw(self, env: VecNormalize | None) -> None:
        """Draw the next batch.

        :param env: normalises observations and rewards.
        """
        with self._on_host() as buffer:
            samples = buffer.sample(self._batch_size, env=env)
            self._ahead = None
            if hasattr(buffer, "next_simulation"):  # a buffer can lose it
                self._ahead = buffer.next_simulation(self._batch_size, env)
        fields = [field.numpy().reshape(self._batch_size, -1) for field in samples if field is not None]
        widths = [field.shape[1] for field in fields]
        if widths != self._widths:
            self._set_up(widths)
        numbers = self._staging.numbers(self._target.numel())
        start = 0
        for field in fields:
            numbers[start : start + field.size].reshape(field.shape)[...] = field
            start += field.size
        self._staging.send(self._target)

    def simulate_ahead(self) -> None:
        """Do what the replay buffer can do for the next batch, while the device learns from this one."""
        if self._ahead is not None:
            with self._on_host():
                self._ahead()

    @contextmanager
    def _on_host(self) -> Iterator[Any]:
        """The replay buffer, which now gives tensors on the CPU."""
        device, self._buffer.device = self._buffer.device, th.device("cpu")
        try:
            yield self._buffer
        finally:
            self._buffer.device = device

    def _set_up(self, widths: list[int]) -> None:
        self._widths = widths
        sizes = [self._batch_size * width for width in widths]
        self._target = th.empty(sum(sizes), device=self._device)
        self._staging = Staging(sum(sizes), self._device)
        self._parts = [part.view(self._batch_size, -1) for part in self._target.split(sizes)]

    def read(self) -> ReplayBufferSamples:
        """The batch, float32 on the device."""
        return ReplayBufferSamples(*self._parts)

    @property
    def key(self) -> tuple[Any, ...]:
        """What a captured step contains of the batches."""
        return self._target.data_ptr(), self._batch_size, *self._widths


class MirroredBatches:
    """Batches that are gathered on the device, from a copy of the replay buffer's observations and actions.

    Rows are copied once, after they were added. Rewards and ends of episodes come from the replay buffer with
    every batch, since they may be changed after the row was added.

    :param buffer: an SB3 ``ReplayBuffer``.
    :param batch_size: transitions.
    :param device: where the batches are needed.
    :raises torch.OutOfMemoryError: if there is no room for the copy.
    """

    def __init__(self, buffer: ReplayBuffer, batch_size: int, device: th.device) -> None:
        self._buffer, self._batch_size = buffer, batch_size
        #: Kept, so that arrays that replace them are others.
        self._arrays = _mirrored_arrays(buffer)
        self._widths = [int(np.prod(array.shape[2:])) for array in self._arrays]
        width = sum(self._widths)
        self._rows = th.empty((buffer.buffer_size * buffer.n_envs, width), device=device)
        self._drawn = th.empty((3, batch_size), device=device)
        self._n_at_once = max(_CHUNK // (width * buffer.n_envs), 1)
        self._staging = Staging(self._n_at_once * buffer.n_envs * width, device)
        self._staging_drawn = Staging(3 * batch_size, device)
        self._seen: tuple[int, bool, int] | None = None

    def fits(self, buffer: ReplayBuffer, batch_size: int, env: VecNormalize | None) -> bool:
        """Whether these are batches of this size from this replay buffer."""
        return (
            buffer is self._buffer
            and batch_size == self._batch_size
            and _may_mirror(buffer, env)
            and all(map(lambda old, new: old is new, self._arrays, _mirrored_arrays(buffer)))
        )

    def copy_rows(self, n_added: int) -> None:
        """Copy the rows that were added since the last call.

        :param n_added: how many steps the agent had stored altogether, or more.
        """
        buffer = self._buffer
        size, pos, full = buffer.buffer_size, buffer.pos, buffer.full
        seen, self._seen = self._seen, (pos, full, n_added)
        if seen is None or _was_rewritten(seen, self._seen, size):
            self._copy(0, size if full else pos)
        elif seen[0] <= pos and seen[1] == full:
            self._copy(seen[0], pos)
        else:
            self._copy(seen[0], size)
            self._copy(0, pos)

    def _copy(self, first: int, end: int) -> None:
        n_envs, width = self._buffer.n_envs, sum(self._widths)
        for start in range(first, end, self._n_at_once):
            stop = min(start + self._n_at_once, end)
            n_rows = (stop - start) * n_envs
            rows = self._staging.numbers(n_rows * width).reshape(n_rows, width)
            column = 0
            for array, columns in zip(self._arrays, self._widths, strict=True):
                rows[:, column : column + columns] = array[start:stop].reshape(n_rows, columns)
                column += columns
            self._staging.send(self._rows[start * n_envs : stop * n_envs])

    def draw(self, env: VecNormalize | None) -> None:
        """Draw the next batch, with the random numbers that SB3 draws.

        :param env: not used: where it normalises, batches are copied.
        """
        buffer, size = self._buffer, self._batch_size
        rows = np.random.randint(0, buffer.size(), size=size)
        envs = np.random.randint(0, buffer.n_envs, size=size)
        index, rewards, dones = self._staging_drawn.numbers(3 * size).reshape(3, size)
        index.view(np.int32)[:] = rows * buffer.n_envs + envs
        rewards[:] = buffer.rewards[rows, envs]
        dones[:] = buffer.dones[rows, envs] * (1 - buffer.timeouts[rows, envs])
        self._staging_drawn.send(self._drawn)

    def simulate_ahead(self) -> None:
        """Nothing: a plain replay buffer does not simulate."""

    def read(self) -> ReplayBufferSamples:
        """The batch, float32 on the device."""
        index, rewards, dones = self._drawn.unsqueeze(2)
        rows = self._rows.index_select(0, index.view(-1).view(th.int32))
        observations, actions, next_observations = rows.split(self._widths, dim=1)
        return ReplayBufferSamples(observations, actions, next_observations, dones, rewards)

    @property
    def key(self) -> tuple[Any, ...]:
        """What a captured step contains of the batches."""
        return self._rows.data_ptr(), *self._rows.shape, self._drawn.data_ptr(), self._batch_size


Batches = CopiedBatches | MirroredBatches


def batches_of(buffer: ReplayBuffer, batch_size: int, env: VecNormalize | None, device: th.device) -> Batches:
    """The fastest batches for a replay buffer.

    :param buffer: the replay buffer.
    :param batch_size: transitions.
    :param env: normalises observations and rewards.
    :param device: where the batches are needed.
    """
    if _may_mirror(buffer, env):
        try:
            return MirroredBatches(buffer, batch_size, device)
        except th.OutOfMemoryError:
            logger.warning(
                "There is no room for the replay buffer on %s: batches are copied to it one by one.", device
            )
            batches = CopiedBatches(buffer, batch_size, device)
            batches.instead = True
            return batches
    return CopiedBatches(buffer, batch_size, device)


def _may_mirror(buffer: ReplayBuffer, env: VecNormalize | None) -> bool:
    return (
        type(buffer) is ReplayBuffer
        and env is None
        and not buffer.optimize_memory_usage
        and not {name for _, name, _ in _DRAWING} & vars(buffer).keys()
        and all(getattr(cls, name) is function for cls, name, function in _DRAWING)
    )


def _mirrored_arrays(buffer: ReplayBuffer) -> tuple[np.ndarray, ...]:
    return buffer.observations, buffer.actions, buffer.next_observations


def _was_rewritten(before: tuple[int, bool, int], now: tuple[int, bool, int], size: int) -> bool:
    """Whether the position in a replay buffer does not say which rows are new.

    :param before: position, whether the buffer was full, and the steps that the agent had stored.
    :param now: the same later.
    :param size: rows of the buffer.
    """
    emptied = (before[1] and not now[1]) or (not now[1] and now[0] < before[0])
    return emptied or not 0 <= now[2] - before[2] < size
