"""Adam's step with all tensors in one call, also where it is captured in a CUDA graph.

The optimizer's settings change only during the step, since they are saved with the agent.
"""

from typing import Any

import torch as th


def adam_step(optimizer: th.optim.Optimizer, rate: th.Tensor | None = None) -> None:
    """Step Adam, on the CPU with all tensors in one call unless the user chose otherwise.

    :param optimizer: an Adam with a single group of parameters.
    :param rate: the learning rate on the parameters' device, which a captured step reads again at every
        replay. None: the optimizer's own.
    """
    group = optimizer.param_groups[0]
    device = group["params"][0].device
    settings: dict[str, Any] = {}
    if rate is not None:
        capturing = device.type == "cuda" and th.cuda.is_current_stream_capturing()
        settings = {"fused": True, "lr": rate, "capturable": capturing}
    elif device.type == "cpu" and not group["foreach"] and group["fused"] is None:
        settings = {"fused": True}  # on other devices torch groups the tensors itself
    before = {name: group[name] for name in settings}
    group.update(settings)
    try:
        optimizer.step()
    finally:
        group.update(before)


def check_capturable(optimizer: th.optim.Optimizer) -> None:
    """Refuse to capture the steps of an Adam whose form the user chose.

    :param optimizer: an Adam with a single group of parameters.
    :raises TypeError: if it is not the one that is captured.
    """
    group = optimizer.param_groups[0]
    if group["foreach"] or group["fused"] is False:
        raise TypeError("an optimizer's foreach or fused was chosen, and what is captured is the fused Adam")


def put_step_counters(optimizer: th.optim.Optimizer, device: th.device) -> None:
    """Put Adam's step counters on a device. Captured steps need them on the GPU, others on the CPU.

    :param optimizer: an Adam.
    :param device: the device; the counters stay where they are if Adam is fused anyway.
    """
    if optimizer.param_groups[0].get("fused"):
        return
    for state in optimizer.state.values():
        step = state.get("step")
        if isinstance(step, th.Tensor) and step.device != device:
            state["step"] = step.to(device)


def signature(optimizer: th.optim.Optimizer) -> tuple[Any, ...]:
    """What a captured step of Adam contains: all settings but the learning rate, and addresses.

    :param optimizer: an Adam with a single group of parameters.
    """
    group = optimizer.param_groups[0]
    settings = tuple((name, value) for name, value in group.items() if name not in ("params", "lr"))
    states = tuple(
        tensor.data_ptr()
        for state in optimizer.state.values()
        for tensor in state.values()
        if isinstance(tensor, th.Tensor)
    )
    return settings, tuple(parameter.data_ptr() for parameter in group["params"]), states
