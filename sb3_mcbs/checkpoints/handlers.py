"""The types of objects that an agent and its callbacks hold besides those of environments."""

from typing import Any

import numpy as np
import torch as th

from sb3_mcbs.checkpoints.encoding import CALLED, is_registered
from sb3_mcbs.snapshot import SnapshotMismatchError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.arrays import ArrayHandler
from sb3_mcbs.snapshot.handlers import HANDLERS as ENVIRONMENT_HANDLERS
from sb3_mcbs.snapshot.handlers import handler_of as environment_handler_of
from sb3_mcbs.snapshot.object_graph import Capture, Restore, TypeHandler, class_name
from sb3_mcbs.snapshot.objects import ReducedHandler


class OwnedArrayHandler(ArrayHandler):
    """NumPy arrays. Those in a tensor's memory are put back with memory of their own."""

    def capture(self, capture: Capture, obj: np.ndarray) -> Any:
        form, *rest = super().capture(capture, obj)
        return ("own" if form == "borrowed" else form, *rest)


class CalledHandler(ReducedHandler):
    """Compiled containers that are made by calling their class. No checkpoint asks for another call."""

    def capture(self, capture: Capture, obj: Any) -> Any:
        if not isinstance(obj, CALLED):
            raise SnapshotUnsupportedError(f"a {class_name(type(obj))} cannot be written as data")
        return super().capture(capture, obj)


class TensorHandler:
    """Tensors: put back in place where there is one of the same shape."""

    name = "tensor"

    def capture(self, capture: Capture, obj: th.Tensor) -> Any:
        try:
            content = obj.detach().cpu().numpy().copy()
        except TypeError as error:
            raise SnapshotUnsupportedError(f"it is a tensor that NumPy cannot hold: {error}") from error
        return content, str(obj.device), obj.requires_grad and obj.is_leaf

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        content, device, requires_grad = payload
        saved = th.from_numpy(np.ascontiguousarray(content).reshape(content.shape))
        same = isinstance(current, th.Tensor) and current.is_leaf and current.shape == saved.shape
        if same and current.dtype == saved.dtype and restore.claim(current):
            restore.do_then(_copy_into, current, saved)
            return current
        return saved.to(device).requires_grad_(requires_grad)


def _copy_into(tensor: th.Tensor, saved: th.Tensor) -> None:
    with th.no_grad():
        tensor.copy_(saved)


class OptimizerHandler:
    """Optimisers: what their ``state_dict`` says."""

    name = "optimizer"

    def capture(self, capture: Capture, obj: th.optim.Optimizer) -> Any:
        return capture(obj.state_dict())

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        restore.do_then(current.load_state_dict, restore(payload))
        return current


class NamedTupleHandler:
    """Named tuples."""

    name = "namedtuple"

    def capture(self, capture: Capture, obj: Any) -> Any:
        return type(obj), tuple(capture(item) for item in obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        cls, items = payload
        return tuple.__new__(cls, [restore(item) for item in items])


class NetworkHandler:
    """Networks: those of the policy are components of the run, and never captured themselves."""

    name = "network"

    def capture(self, capture: Capture, obj: th.nn.Module) -> Any:
        raise SnapshotUnsupportedError(f"it is a network ({class_name(type(obj))}) outside of the policy")

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        raise SnapshotMismatchError("the checkpoint holds a network outside of the policy")


class RegisteredHandler:
    """Objects whose class registered a pair of functions."""

    name = "registered"

    def capture(self, capture: Capture, obj: Any) -> Any:
        # The encoder asks the class, and so does the decoder.
        return (obj,)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        return payload[0]


_OWN: dict[str, TypeHandler] = {
    handler.name: handler
    for handler in (
        OwnedArrayHandler(),
        CalledHandler(),
        TensorHandler(),
        OptimizerHandler(),
        NamedTupleHandler(),
        NetworkHandler(),
        RegisteredHandler(),
    )
}
HANDLERS: dict[str, TypeHandler] = {**ENVIRONMENT_HANDLERS, **_OWN}


def handler_of(obj: Any) -> TypeHandler | None:
    """Return the handler of an object; None if it never changes.

    :param obj: any object that an agent, a callback or a logger holds.
    """
    cls = type(obj)
    if cls is np.ndarray:
        return _OWN["array"]
    if isinstance(obj, th.Tensor):
        return _OWN["tensor"]
    if isinstance(obj, th.optim.Optimizer):
        return _OWN["optimizer"]
    if isinstance(obj, th.distributions.Distribution):
        return HANDLERS["constant"]  # made anew from the networks whenever it is needed
    if is_registered(cls):
        return _OWN["registered"]
    if issubclass(cls, tuple) and hasattr(cls, "_fields"):
        return _OWN["namedtuple"]
    if isinstance(obj, th.nn.Module):
        return _OWN["network"]
    handler = environment_handler_of(obj)
    return _OWN["reduced"] if handler is ENVIRONMENT_HANDLERS["reduced"] else handler
