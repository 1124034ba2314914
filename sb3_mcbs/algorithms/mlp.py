"""Multi-layer perceptrons without the calls of modules, and of autograd, around them.

For the small networks of continuous control those calls cost as much as the matrix products. Everything
here is stored ``[features, rows]``: products in this order are quicker for few rows.
"""

from collections.abc import Iterable
from typing import Any

import torch as th
from torch import nn


def _flatten(modules: Iterable[nn.Module]) -> list[nn.Module]:
    layers: list[nn.Module] = []
    for module in modules:
        layers += _flatten(module) if type(module) is nn.Sequential else [module]
    return layers


class _Linear:
    """A linear layer's parameters, apart from autograd.

    :param layer: the layer; a later change of its parameters' storage, as by ``to(device)``, is followed.
    """

    def __init__(self, layer: nn.Linear) -> None:
        self._parameters: dict[str, Any] = layer._parameters
        self._weight = self._bias = th.empty(0)

    @property
    def weight(self) -> th.Tensor:
        """``[out_features, in_features]``."""
        present = self._parameters["weight"]
        if self._weight.data_ptr() != present.data_ptr():
            self._weight = present.detach()
        return self._weight

    @property
    def bias(self) -> th.Tensor | None:
        """``[out_features, 1]``."""
        present = self._parameters["bias"]
        if present is None:
            return None
        if self._bias.data_ptr() != present.data_ptr():
            self._bias = present.detach().unsqueeze(1)
        return self._bias

    def set_gradients(self, layer_input: th.Tensor, gradient: th.Tensor) -> None:
        """Set the parameters' ``grad``.

        :param layer_input: ``[in_features, rows]``.
        :param gradient: of the loss, by the layer's output: ``[out_features, rows]``.
        """
        weight, bias = self._parameters["weight"], self._parameters["bias"]
        th.mm(gradient, layer_input.t(), out=_gradient_of(weight))
        if bias is not None:
            th.sum(gradient, 1, out=_gradient_of(bias))


def _gradient_of(parameter: nn.Parameter) -> th.Tensor:
    if parameter.grad is None:
        parameter.grad = th.empty_like(parameter)
    return parameter.grad


class MLP:
    """Linear layers with ReLU and Tanh between them. Nothing here is recorded by autograd.

    :param modules: ``nn.Sequential``s and single layers; their present parameters are used at every call.
    :raises TypeError: if a layer is of another kind.
    """

    def __init__(self, *modules: nn.Module) -> None:
        self._layers: list[_Linear | type[nn.Module]] = []
        for layer in _flatten(modules):
            if type(layer) is nn.Linear:
                self._layers.append(_Linear(layer))
            elif type(layer) in (nn.ReLU, nn.Tanh) and self._layers:
                self._layers.append(type(layer))
            else:
                raise TypeError(
                    f"{type(layer).__name__} is not covered; an MLP begins with Linear and goes on with "
                    "Linear, ReLU and Tanh"
                )

    def __call__(self, x: th.Tensor) -> th.Tensor:
        """Run all layers.

        :param x: ``[in_features, rows]`` float32.
        :return: ``[out_features, rows]``.
        """
        return self.outputs(x)[-1]

    def outputs(self, x: th.Tensor) -> list[th.Tensor]:
        """Run all layers and keep what :meth:`backward` needs.

        :param x: ``[in_features, rows]`` float32.
        :return: the output of every layer, ``[features, rows]``. An activation overwrites its input.
        """
        outputs = []
        for layer in self._layers:
            if isinstance(layer, _Linear):
                x = th.mm(layer.weight, x)
                bias = layer.bias
                if bias is not None:
                    x += bias
            else:
                x = x.relu_() if layer is nn.ReLU else x.tanh_()
            outputs.append(x)
        return outputs

    def backward(
        self, x: th.Tensor, outputs: list[th.Tensor], gradient: th.Tensor, of_parameters: bool
    ) -> th.Tensor:
        """Propagate a gradient back.

        :param x: what :meth:`outputs` was called with.
        :param outputs: what it returned.
        :param gradient: of the loss, by the output: ``[out_features, rows]``.
        :param of_parameters: True sets the parameters' ``grad`` (does not add to it), and spares the
            gradient by the input; False is the other way round.
        :return: the gradient by the input, ``[in_features, rows]``, if ``of_parameters`` is False.
        """
        for index in range(len(self._layers) - 1, -1, -1):
            layer = self._layers[index]
            if isinstance(layer, _Linear):
                if of_parameters:
                    layer.set_gradients(outputs[index - 1] if index else x, gradient)
                if index or not of_parameters:
                    gradient = th.mm(layer.weight.t(), gradient)
            elif layer is nn.ReLU:
                gradient = th.ops.aten.threshold_backward.grad_input(
                    gradient, outputs[index], 0, grad_input=gradient
                )
            else:
                gradient = th.ops.aten.tanh_backward(gradient, outputs[index])
        return gradient
