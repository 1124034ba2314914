"""What is common to the layers that are computed without torch's module calls and autograd."""

from typing import Any

import torch as th
from torch import nn


def own_state(module: nn.Module) -> dict[str, Any]:
    """A module's attributes, if calling the module does nothing but run its class's ``forward``.

    :param module: the module.
    :raises TypeError: if it has hooks, was compiled, or has a replaced method.
    """
    state = vars(module)
    if (
        state["_forward_hooks"]
        or state["_forward_pre_hooks"]
        or state["_backward_hooks"]
        or state["_backward_pre_hooks"]
        or "forward" in state
        or "_call_impl" in state
        or state.get("_compiled_call_impl") is not None
    ):
        raise TypeError(
            f"a {type(module).__name__} has hooks, was compiled, or has a replaced forward method"
        )
    return state


def check_parameter(parameter: th.Tensor, kind: type[th.Tensor] = nn.Parameter) -> None:
    """Refuse what float32 products at fixed addresses cannot use.

    :param parameter: a parameter or statistic of a layer.
    :param kind: its expected class.
    :raises TypeError: says why.
    """
    if type(parameter) is not kind or parameter.dtype != th.float32 or not parameter.is_contiguous():
        raise TypeError("parameters are not float32, not contiguous, or of a class of their own")


def gradient_of(parameter: th.Tensor) -> th.Tensor:
    """A parameter's ``grad``, which is made if there is none.

    :param parameter: the parameter.
    """
    if parameter.grad is None:
        parameter.grad = th.empty_like(parameter)
    return parameter.grad
