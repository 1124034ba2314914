"""Tensors of torch: captured by value; those that share memory go on sharing it."""

from typing import Any

import numpy as np
import torch as th

from sb3_mcbs.snapshot.errors import SnapshotUnsupportedError
from sb3_mcbs.snapshot.object_graph import MISSING, Capture, Ref, Restore, class_name
from sb3_mcbs.snapshot.objects import capture_content, restore_content


def is_tensor(obj: Any) -> bool:
    """Return whether an object is a tensor.

    :param obj: any object.
    """
    return isinstance(obj, th.Tensor)


def bytes_of(tensor: Any) -> np.ndarray:
    """Return the whole memory that a tensor is a view of.

    :param tensor: the tensor; what is not on the CPU is copied.
    """
    return _whole(tensor).cpu().numpy()


def _whole(tensor: Any) -> Any:
    """Return the whole memory of a tensor, as a tensor of bytes."""
    return th.empty(0, dtype=th.uint8, device=tensor.device).set_(tensor.untyped_storage())


class TensorHandler:
    """Tensors and parameters. Parameters are put back in place: optimizers hold them as well."""

    name = "torch"

    def capture(self, capture: Capture, obj: Any) -> Any:
        storage = _storage_of(obj)
        capture.tensors.append(obj)
        shared = capture.owner_of(storage, obj)
        content = bytes_of(obj).copy() if shared is None else shared
        grad = capture(obj.grad if obj.is_leaf else None)
        return content, _layout(obj), grad, capture_content(capture, obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        content, layout, grad, attributes = payload
        if type(content) is Ref:
            storage = restore(content).untyped_storage()
            stays = restore.is_original(index, current) and current.untyped_storage() is storage
            made = current if stays else _tensor(storage, layout)
        elif (
            (layout[0] or restore.is_original(index, current))
            and _can_be_put_back(current, layout, content)
            and restore.claim(current)
        ):
            made = current
            restore.do_then(_write, current, content)
        else:
            made = _tensor(_storage(content, layout), layout)
        restore.memo[index] = made
        have = made.grad if made is current and made.grad is not None else MISSING
        restored = restore(grad, have)
        if restored is not made.grad:
            restore.do_then(setattr, made, "grad", restored)
        restore_content(restore, attributes, made)
        return made


def _storage_of(tensor: Any) -> Any:
    """Return the memory of a tensor.

    :raises SnapshotUnsupportedError: if it cannot be captured.
    """
    cls = type(tensor)
    if cls not in (th.Tensor, th.nn.Parameter) or tensor.layout is not th.strided:
        raise SnapshotUnsupportedError(f"a {class_name(cls)} of layout {tensor.layout} is no plain tensor")
    # Their memory alone does not say what they contain.
    for name in ("quantized", "nested", "meta", "conj", "neg"):
        answer = getattr(tensor, f"is_{name}")
        if answer() if callable(answer) else answer:
            raise SnapshotUnsupportedError(f"a tensor whose is_{name} is true is no plain tensor")
    if tensor._backward_hooks or getattr(tensor, "_post_accumulate_grad_hooks", None):
        raise SnapshotUnsupportedError("a tensor with hooks is no plain tensor")
    if tensor.grad_fn is not None:
        raise SnapshotUnsupportedError("it is a tensor with a history of gradients; keep its detach()")
    return tensor.untyped_storage()


def check_memory(capture: Capture) -> None:
    """Refuse tensors whose memory is that of a NumPy array: a restore would part the two.

    :param capture: has captured all that belongs together.
    :raises SnapshotUnsupportedError: if there is one.
    """
    spans = [_span(tensor.untyped_storage()) for tensor in capture.tensors if tensor.device.type == "cpu"]
    for array in capture.objects if spans else ():
        if type(array) is np.ndarray and array.base is None and array.nbytes:
            start = int(array.__array_interface__["data"][0])
            if any(start < end and its_start < start + array.nbytes for its_start, end in spans):
                raise SnapshotUnsupportedError(
                    f"A tensor has the memory of a NumPy array of shape {array.shape} of the environment, as "
                    "torch.from_numpy makes it, and a restore would part them. Keep the tensor's clone(), or "
                    "keep the tensor alone and read it with tensor.numpy()."
                )


def _span(storage: Any) -> tuple[int, int]:
    return storage.data_ptr(), storage.data_ptr() + storage.nbytes()


def _layout(tensor: Any) -> tuple[Any, ...]:
    """Return how a tensor lies in its memory, as plain values."""
    is_parameter = isinstance(tensor, th.nn.Parameter)
    place = tensor.storage_offset(), tuple(tensor.shape), tensor.stride()
    dtype = str(tensor.dtype).removeprefix("torch.")
    return is_parameter, dtype, str(tensor.device), tensor.requires_grad, *place


def _can_be_put_back(current: Any, layout: tuple[Any, ...], content: np.ndarray) -> bool:
    if not is_tensor(current) or _layout(current) != layout:
        return False
    return current.untyped_storage().nbytes() == content.nbytes


def _write(tensor: Any, content: np.ndarray) -> None:
    _whole(tensor).copy_(th.tensor(content))


def _storage(content: np.ndarray, layout: tuple[Any, ...]) -> Any:
    return th.tensor(content, device=layout[2]).untyped_storage()


def _tensor(storage: Any, layout: tuple[Any, ...]) -> Any:
    is_parameter, dtype, device, requires_grad, *place = layout
    made = th.empty(0, dtype=getattr(th, dtype), device=device).set_(storage, *place)
    return th.nn.Parameter(made, requires_grad) if is_parameter else made.requires_grad_(requires_grad)
