"""Multi-layer perceptrons computed without torch's module calls and autograd.

For the small networks of continuous control these cost as much as the matrix products. All arrays are stored
``[features, rows]``: products in this order are faster for few rows.
"""

from collections.abc import Iterator, Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np
import torch as th
from sb3_contrib.common.torch_layers import BatchRenorm1d
from torch import nn

from sb3_mcbs.networks.batch_renorm import Normalized, Renormalization
from sb3_mcbs.networks.layers import check_parameter, gradient_of, own_state
from sb3_mcbs.types import ACTIVATIONS


class _Linear:
    """The present parameters of a linear layer.

    :param layer: the layer.
    :raises TypeError: if it has more than a weight and a bias in float32.

    :ivar weight: ``[out_features, in_features]``.
    :ivar bias: ``[out_features]`` or None.
    """

    __slots__ = ("_column", "bias", "weight")

    def __init__(self, layer: nn.Linear) -> None:
        state = own_state(layer)
        parameters = state["_parameters"]
        if [*parameters] != ["weight", "bias"] or state["_modules"]:
            raise TypeError("a Linear has other parameters than its weight and bias (it may be pruned)")
        self.weight, self.bias = parameters["weight"], parameters["bias"]
        self._column: th.Tensor | None = None
        check_parameter(self.weight)
        if self.bias is not None:
            check_parameter(self.bias)

    @property
    def tensors(self) -> list[th.Tensor]:
        return [self.weight] if self.bias is None else [self.weight, self.bias]

    def replaced(self, tensors: Iterator[th.Tensor]) -> "_Linear":
        """A copy with other :attr:`tensors`."""
        made = copy(self)
        made.weight, made.bias = next(tensors), None if self.bias is None else next(tensors)
        made._column = None
        return made

    @property
    def signature(self) -> tuple[Any, ...]:
        bias = None if self.bias is None else self.bias.data_ptr()
        return self.weight.data_ptr(), tuple(self.weight.shape), bias

    @property
    def column(self) -> th.Tensor:
        """The bias as ``[out_features, 1]``."""
        if self._column is None:
            self._column = self.bias.unsqueeze(1)
        return self._column

    def __call__(self, x: th.Tensor) -> th.Tensor:
        x = th.mm(self.weight, x)
        return x if self.bias is None else x.add_(self.column)

    def set_gradients(self, layer_input: th.Tensor, gradient: th.Tensor) -> None:
        """Set the parameters' ``grad``.

        :param layer_input: ``[in_features, rows]``.
        :param gradient: of the loss with respect to the layer's output, ``[out_features, rows]``.
        """
        th.mm(gradient, layer_input.t(), out=gradient_of(self.weight))
        if self.bias is not None:
            th.sum(gradient, 1, out=gradient_of(self.bias))


_ACTIVATIONS = {nn.ReLU: ACTIVATIONS["relu"], nn.Tanh: ACTIVATIONS["tanh"]}


class Pass(NamedTuple):
    """A run of all layers, with what :meth:`MLP.backward` needs.

    :param inputs: of every layer, ``[features, rows]``; of an activation, its output.
    :param normalized: of every batch renormalization.
    :param output: of the last layer, ``[out_features, rows]``.
    """

    inputs: list[th.Tensor]
    normalized: list[Normalized]
    output: th.Tensor


class MLP:
    """Linear layers with ReLU and Tanh between them, to be called without autograd.

    It keeps the layers and parameters that the modules have when it is made. Batch renormalization is that of
    evaluation mode, with the statistics of its first call.

    :param modules: ``nn.Sequential``s and single layers.
    :raises TypeError: if a layer is of another kind, or calling it would do more than compute its output.
    """

    def __init__(self, *modules: nn.Module) -> None:
        self._layers: list[_Linear | Renormalization | type[nn.Module]] = []
        for module in modules:
            self._append(module)
        if not self._layers:
            raise TypeError("there are no layers")

    def _append(self, module: nn.Module) -> None:
        if type(module) is nn.Linear:
            self._layers.append(_Linear(module))
            return
        if type(module) is BatchRenorm1d:
            self._layers.append(Renormalization(module))
            return
        is_activation = type(module) in (nn.ReLU, nn.Tanh) and self._layers
        if type(module) is not nn.Sequential and not is_activation:
            raise TypeError(
                f"{type(module).__name__} is not covered; an MLP begins with Linear or BatchRenorm1d "
                "and continues with these, ReLU and Tanh"
            )
        state = own_state(module)
        if state["_parameters"] or (is_activation and state["_modules"]):
            raise TypeError(f"a {type(module).__name__} has parameters")
        if is_activation:
            self._layers.append(type(module))
        for layer in state["_modules"].values():
            self._append(layer)

    @property
    def device(self) -> th.device:
        """The device of the first layer."""
        return self._tensors[0].device

    @property
    def _tensors(self) -> list[th.Tensor]:
        return [tensor for layer in self._layers if not isinstance(layer, type) for tensor in layer.tensors]

    def replaced(self, tensors: Iterator[th.Tensor]) -> "MLP":
        """A copy with other parameters and statistics.

        :param tensors: in the order of the layers.
        """
        made = copy(self)
        made._layers = [
            layer if isinstance(layer, type) else layer.replaced(tensors) for layer in self._layers
        ]
        return made

    @property
    def signature(self) -> tuple[Any, ...]:
        """The layers' addresses and constants: MLPs of the same signature compute the same."""
        return tuple(layer if isinstance(layer, type) else layer.signature for layer in self._layers)

    def rows(self) -> list[tuple[list[th.Tensor], int]]:
        """The layers as :func:`tables` lists them.

        :return: for each linear layer, its arrays (weight and bias, after gain and shift if there are any),
            and the activation of its output.
        :raises TypeError: if they are not linear layers with at most one normalization before and one
            activation after each.
        """
        rows: list[tuple[list[th.Tensor], int]] = []
        before: list[th.Tensor] = []
        for layer in self._layers:
            if isinstance(layer, Renormalization) and not before:
                before = layer.factors()
            elif isinstance(layer, _Linear):
                bias = layer.bias
                if bias is None:
                    bias = th.zeros(len(layer.weight), dtype=th.float32, device=self.device)
                rows.append(([*before, layer.weight, bias], 0))
                before = []
            elif not isinstance(layer, Renormalization) and not before and not rows[-1][1]:
                rows[-1] = rows[-1][0], _ACTIVATIONS[layer]
            else:
                raise TypeError("layers follow each other in an order that compiled code does not know")
        if before:
            raise TypeError("a normalization is the last layer")
        return rows

    @property
    def parameters(self) -> list[nn.Parameter]:
        """In the order of the layers."""
        found = []
        for layer in self._layers:
            if isinstance(layer, Renormalization):
                found += [layer.layer.scale, layer.layer.bias]
            elif isinstance(layer, _Linear):
                found.append(layer.weight)
                if layer.bias is not None:
                    found.append(layer.bias)
        return found

    @property
    def renormalizations(self) -> list[Renormalization]:
        """The batch renormalizations, in the order of the layers."""
        return [layer for layer in self._layers if isinstance(layer, Renormalization)]

    def __call__(self, x: th.Tensor) -> th.Tensor:
        """Run all layers, batch renormalization in evaluation mode with the statistics of its first call.

        :param x: ``[in_features, rows]`` float32.
        :return: ``[out_features, rows]``.
        """
        for layer in self._layers:
            x = _activate(layer, x) if isinstance(layer, type) else layer(x)
        return x

    def run(self, x: th.Tensor, past_warmup: Sequence[bool] | None = None) -> Pass:
        """Run all layers and keep what :meth:`backward` needs.

        :param x: ``[in_features, rows]`` float32.
        :param past_warmup: runs batch renormalization in training mode: for each, whether its warm-up is
            over. None: in evaluation mode, with the present statistics.
        """
        inputs: list[th.Tensor] = []
        kept: list[Normalized] = []
        for before, layer in zip([None, *self._layers], self._layers, strict=False):
            if isinstance(before, type) and isinstance(layer, type):
                x = x.clone()  # an activation overwrites its input, and the one before needs its output
            inputs.append(x)
            if isinstance(layer, Renormalization):
                past = None if past_warmup is None else past_warmup[len(kept)]
                x, normalized = layer.evaluate(x) if past is None else layer.train(x, past)
                kept.append(normalized)
            else:
                x = _activate(layer, x) if isinstance(layer, type) else layer(x)
        return Pass(inputs, kept, x)

    def backward(
        self, run: Pass, gradient: th.Tensor, *, of_parameters: bool = False, of_input: bool = False
    ) -> th.Tensor:
        """Backpropagate a gradient, once.

        :param run: the result of :meth:`run`; parts of it are overwritten.
        :param gradient: of the loss with respect to the output, ``[out_features, rows]``; may be overwritten.
        :param of_parameters: set the parameters' ``grad`` (does not add to it).
        :param of_input: return the gradient with respect to the input, ``[in_features, rows]``.
        """
        kept = [*run.normalized]
        for index in range(len(self._layers) - 1, -1, -1):
            layer, x = self._layers[index], run.inputs[index]
            goes_on = of_input or index > 0
            if isinstance(layer, _Linear):
                if of_parameters:
                    layer.set_gradients(x, gradient)
                if goes_on:
                    gradient = th.mm(layer.weight.t(), gradient)
            elif isinstance(layer, Renormalization):
                gradient = layer.backward(kept.pop(), gradient, of_parameters, goes_on)
            elif layer is nn.ReLU:
                gradient = th.ops.aten.threshold_backward.grad_input(gradient, x, 0, grad_input=gradient)
            else:
                gradient = th.ops.aten.tanh_backward(gradient, x)
        return gradient


def _activate(activation: type[nn.Module], x: th.Tensor) -> th.Tensor:
    return x.relu_() if activation is nn.ReLU else x.tanh_()


def on_host(mlps: Sequence[MLP]) -> list[MLP]:
    """Networks on the CPU: these, or copies from a GPU, in one piece, since each copy waits for it.

    :param mlps: networks on the same device.
    """
    if _is_host(mlps[0].device):
        return [*mlps]
    tensors = [tensor for mlp in mlps for tensor in mlp._tensors]
    with th.no_grad():
        flat = th.cat([tensor.reshape(-1) for tensor in tensors]).cpu()
    parts = flat.split([tensor.numel() for tensor in tensors])
    copies = iter([part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)])
    return [mlp.replaced(copies) for mlp in mlps]


def _is_host(device: th.device) -> bool:
    return device.type == "cpu"


def tables(mlps: Sequence[MLP]) -> tuple[list[np.ndarray], list[th.Tensor]]:
    """Networks for compiled code, which reads their present weights, or copies of these from a GPU.

    :param mlps: networks on the same device.
    :return: for each, ``[layers, 7]`` int64, see :class:`~sb3_mcbs.types.Layer`; and what lies behind the
        addresses: the tables are valid as long as it lives.
    :raises TypeError: if compiled code does not cover the order of their layers.
    """
    found, kept = [], []
    for mlp in on_host(mlps):
        table = []
        for layer, activation in mlp.rows():
            n_out, n_in = layer[-2].shape
            without = [0] * (4 - len(layer))
            table.append([*without, *(array.data_ptr() for array in layer), n_in, n_out, activation])
            kept += layer
        found.append(np.array(table, dtype=np.int64))
    return found, kept
