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


class MLP:
    """Linear layers with ReLU and Tanh between them.

    :param modules: ``nn.Sequential``s and single layers; their present parameters are used at every call.
    :raises TypeError: if a layer is of another kind.
    """

    def __init__(self, *modules: nn.Module) -> None:
        self._layers: list[tuple[type[nn.Module], dict[str, Any]]] = []
        for layer in _flatten(modules):
            if type(layer) not in (nn.Linear, nn.ReLU, nn.Tanh):
                raise TypeError(f"{type(layer).__name__} is not one of the layers Linear, ReLU and Tanh")
            self._layers.append((type(layer), layer._parameters))
        if not self._layers or self._layers[0][0] is not nn.Linear:
            raise TypeError("the first layer is not linear")

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
        for kind, parameters in self._layers:
            if kind is nn.Linear:
                x = th.mm(parameters["weight"], x)
                if parameters["bias"] is not None:
                    x += parameters["bias"].unsqueeze(1)
            else:
                x = x.relu_() if kind is nn.ReLU else x.tanh_()
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
            kind, parameters = self._layers[index]
            if kind is nn.ReLU:
                gradient = th.ops.aten.threshold_backward.grad_input(
                    gradient, outputs[index], 0, grad_input=gradient
                )
            elif kind is nn.Tanh:
                gradient = th.ops.aten.tanh_backward(gradient, outputs[index])
            else:
                if of_parameters:
                    layer_input = outputs[index - 1] if index else x
                    th.mm(gradient, layer_input.t(), out=_gradient_of(parameters["weight"]))
                    if parameters["bias"] is not None:
                        th.sum(gradient, 1, out=_gradient_of(parameters["bias"]))
                if index or not of_parameters:
                    gradient = th.mm(parameters["weight"].t(), gradient)
        return gradient


def _gradient_of(parameter: nn.Parameter) -> th.Tensor:
    if parameter.grad is None:
        parameter.grad = th.empty_like(parameter)
    return parameter.grad
