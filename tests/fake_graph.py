"""A stand-in for CUDA graphs on the CPU: records torch's operations, and replays them on the same tensors.

Like a graph it contains addresses and constants, not Python: what Python would decide anew, and what lies
elsewhere by then, is as it was when it was recorded.
"""

from collections.abc import Callable
from typing import Any

import torch as th
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

#: For these a GPU would have to be waited for, which no graph can.
READ_BY_THE_HOST = {"aten::_local_scalar_dense", "aten::nonzero", "aten::equal", "aten::is_nonzero"}


class Recorder(TorchDispatchMode):
    """Records operations, and what they overwrite."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Any, Any, Any, Any]] = []
        self.overwritten: dict[int, tuple[Any, Any]] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = func._schema.name
        if name in READ_BY_THE_HOST:
            raise RuntimeError(f"operation not permitted when stream is capturing: {name}")
        arguments = func._schema.arguments
        for argument, value in zip(arguments, args, strict=False):
            self._keep(argument, value)
        for argument in arguments:
            if argument.name in kwargs:
                self._keep(argument, kwargs[argument.name])
        result = func(*args, **kwargs)
        self.calls.append((func, args, kwargs, result))
        return result

    def _keep(self, argument: Any, value: Any) -> None:
        if argument.alias_info is not None and argument.alias_info.is_write:
            for tensor in tree_leaves(value):
                storage = tensor.untyped_storage()
                self.overwritten.setdefault(storage.data_ptr(), (storage, storage.clone()))

    def replay(self) -> None:
        with th.no_grad():
            for func, args, kwargs, recorded in self.calls:
                result = func(*args, **kwargs)
                for old, new in zip(tree_leaves(recorded), tree_leaves(result), strict=True):
                    if isinstance(old, th.Tensor) and old.data_ptr() != new.data_ptr():
                        old.detach().copy_(new)


class FakeBackend:
    """Captures and replays on the CPU."""

    def __init__(self) -> None:
        self.n_warm_ups = self.n_captures = self.n_replays = 0

    def warm_up(self, step: Callable[[], Any]) -> None:
        self.n_warm_ups += 1
        step()

    def capture(self, step: Callable[[], Any]) -> Callable[[], None]:
        self.n_captures += 1
        noise, recorder = th.get_rng_state(), Recorder()
        with recorder:
            step()
        for storage, before in recorder.overwritten.values():  # a capture runs nothing
            storage.copy_(before)
        th.set_rng_state(noise)

        def replay() -> None:
            self.n_replays += 1
            recorder.replay()

        return replay
