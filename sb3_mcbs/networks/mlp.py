"""Multi-layer perceptrons computed without torch's module calls and autograd.

For the small networks of continuous control these cost as much as the matrix products. All arrays are stored
``[features, rows]``: products in this order are faster for few rows.
"""

from typing import Any

import numpy as np
import torch as th
from sb3_contrib.common.torch_layers import BatchRenorm1d
from torch import nn

from sb3_mcbs.networks.batch_renorm import FusedBatchRenorm1d
from sb3_mcbs.types import ACTIVATIONS


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
        _check_parameter(self.weight)
        if self.bias is not None:
            _check_parameter(self.bias)

    @property
    def device(self) -> th.device:
        return self.weight.device

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

    def set_gradients(self, layer_input: th.Tensor, gradient: th.Tensor) -> None:
        """Set the parameters' ``grad``.

        :param layer_input: ``[in_features, rows]``.
        :param gradient: of the loss with respect to the layer's output, ``[out_features, rows]``.
        """
        th.mm(gradient, layer_input.t(), out=_gradient_of(self.weight))
        if self.bias is not None:
            th.sum(gradient, 1, out=_gradient_of(self.bias))


class _Normalization:
    """Batch renormalization in evaluation mode, with the statistics of its first use.

    :param layer: the layer.
    :raises TypeError: if it has other parameters or statistics than SB3-Contrib gives it.
    """

    __slots__ = ("_columns", "_layer", "_tensors")

    def __init__(self, layer: BatchRenorm1d) -> None:
        state = own_state(layer)
        parameters, statistics = state["_parameters"], state["_buffers"]
        named = [*parameters, *statistics] == ["scale", "bias", "ra_mean", "ra_var", "steps"]
        if not named or not layer.affine or state["_modules"]:
            raise TypeError("a BatchRenorm1d has other parameters or statistics than SB3-Contrib's")
        (scale, bias), (mean, variance, _) = parameters.values(), statistics.values()
        for tensor in (scale, bias):
            _check_parameter(tensor)
        for tensor in (mean, variance):
            _check_parameter(tensor, th.Tensor)
        self._layer, self._tensors = layer, (mean, variance, scale, bias)
        self._columns: list[th.Tensor] = []

    @property
    def device(self) -> th.device:
        return self._tensors[0].device

    @property
    def signature(self) -> tuple[Any, ...]:
        layer = self._layer
        constants = type(layer), layer.eps, layer.momentum, layer.rmax, layer.dmax, layer.warmup_steps
        return *constants, *(tensor.data_ptr() for tensor in self._tensors), layer.steps.data_ptr()  # type: ignore[operator]

    @property
    def columns(self) -> list[th.Tensor]:
        """Mean, standard deviation, scale and bias as ``[features, 1]``."""
        if not self._columns:
            mean, variance, scale, bias = self._tensors
            with th.no_grad():
                deviation = th.add(variance, self._layer.eps).sqrt_()
                self._columns = [each.unsqueeze(1) for each in (mean, deviation, scale, bias)]
        return self._columns

    def factors(self) -> list[th.Tensor]:
        """One factor and one summand per feature."""
        with th.no_grad():
            mean, deviation, scale, bias = (column[:, 0] for column in self.columns)
            gain = scale / deviation
            return [gain, bias - mean * gain]

    def __call__(self, x: th.Tensor) -> th.Tensor:
        # The layer's own operations in its order: the result is equal to the bit.
        mean, deviation, scale, bias = self.columns
        return (x - mean).div_(deviation).mul_(scale).add_(bias)


_ACTIVATIONS = {nn.ReLU: ACTIVATIONS["relu"], nn.Tanh: ACTIVATIONS["tanh"]}


def _check_parameter(parameter: th.Tensor, kind: type[th.Tensor] = nn.Parameter) -> None:
    if type(parameter) is not kind or parameter.dtype != th.float32 or not parameter.is_contiguous():
        raise TypeError("parameters are not float32, not contiguous, or of a class of their own")


def _gradient_of(parameter: nn.Parameter) -> th.Tensor:
    if parameter.grad is None:
        parameter.grad = th.empty_like(parameter)
    return parameter.grad


class MLP:
    """Linear layers with ReLU and Tanh between them, to be called without autograd.

    It keeps the layers and parameters that the modules have when it is made. Batch renormalization is that of
    evaluation mode, with the statistics of its first call.

    :param modules: ``nn.Sequential``s and single layers.
    :raises TypeError: if a layer is of another kind, or calling it would do more than compute its output.
    """

    def __init__(self, *modules: nn.Module) -> None:
        self._layers: list[_Linear | _Normalization | type[nn.Module]] = []
        self._behind_addresses: list[th.Tensor] = []
        for module in modules:
            self._append(module)
        if not self._layers:
            raise TypeError("there are no layers")

    def _append(self, module: nn.Module) -> None:
        if type(module) is nn.Linear:
            self._layers.append(_Linear(module))
            return
        if isinstance(module, BatchRenorm1d) and type(module) in (BatchRenorm1d, FusedBatchRenorm1d):
            self._layers.append(_Normalization(module))
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
        first = self._layers[0]
        assert isinstance(first, _Linear | _Normalization)
        return first.device

    @property
    def signature(self) -> tuple[Any, ...]:
        """The layers' addresses and constants: MLPs of the same signature compute the same."""
        return tuple(layer if isinstance(layer, type) else layer.signature for layer in self._layers)

    def table(self) -> np.ndarray:
        """The layers for compiled code, which are valid as long as this object lives.

        :return: ``[layers, 7]`` int64, see :class:`~sb3_mcbs.types.Layer`.
        :raises TypeError: if they lie on a GPU, or are not linear layers with at most one normalization
            before and one activation after each.
        """
        if self.device.type != "cpu":
            raise TypeError("the networks are not on the CPU")
        table: list[list[int]] = []
        before = [0, 0]
        for layer in self._layers:
            if isinstance(layer, _Normalization) and not any(before):
                self._behind_addresses += (factors := layer.factors())
                before = [factor.data_ptr() for factor in factors]
            elif isinstance(layer, _Linear):
                bias = layer.bias
                if bias is None:
                    self._behind_addresses.append(bias := th.zeros(len(layer.weight)))
                n_out, n_in = layer.weight.shape
                table.append([*before, layer.weight.data_ptr(), bias.data_ptr(), n_in, n_out, 0])
                before = [0, 0]
            elif not isinstance(layer, _Normalization) and not any(before) and not table[-1][-1]:
                table[-1][-1] = _ACTIVATIONS[layer]
            else:
                raise TypeError("layers follow each other in an order that compiled code does not know")
        if any(before):
            raise TypeError("a normalization is the last layer")
        return np.array(table, dtype=np.int64)

    @property
    def parameters(self) -> list[nn.Parameter]:
        """In the order of the layers.

        :raises TypeError: if there are layers that :meth:`backward` does not cover.
        """
        found = []
        for layer in self._layers:
            if isinstance(layer, _Normalization):
                raise TypeError("BatchRenorm1d is trained on the statistics of batches")
            if isinstance(layer, _Linear):
                found.append(layer.weight)
                if layer.bias is not None:
                    found.append(layer.bias)
        return found

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
                if layer.bias is not None:
                    x += layer.column
            elif isinstance(layer, _Normalization):
                x = layer(x)
            else:
                x = x.relu_() if layer is nn.ReLU else x.tanh_()
            outputs.append(x)
        return outputs

    def backward(
        self, x: th.Tensor, outputs: list[th.Tensor], gradient: th.Tensor, of_parameters: bool
    ) -> th.Tensor:
        """Backpropagate a gradient, either to the parameters or to the input.

        :param x: the input of :meth:`outputs`.
        :param outputs: the result of :meth:`outputs`.
        :param gradient: of the loss with respect to the output, ``[out_features, rows]``.
        :param of_parameters: True sets the parameters' ``grad`` (does not add to it) and skips the gradient
            with respect to the input; False does the opposite.
        :return: with ``of_parameters=False`` the gradient with respect to the input, ``[in_features, rows]``.
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
