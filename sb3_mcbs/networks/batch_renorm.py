"""SB3-Contrib's batch renormalization without autograd, with arrays stored ``[features, rows]``."""

from collections.abc import Iterator
from copy import copy
from typing import Any, NamedTuple

import torch as th
from sb3_contrib.common.torch_layers import BatchRenorm1d

from sb3_mcbs.networks.layers import check_parameter, gradient_of, own_state


class Normalized(NamedTuple):
    """What :meth:`Renormalization.backward` needs. All but ``centred`` are ``[features, 1]``.

    :param factor: by which the centred input was multiplied.
    :param centred: ``[features, rows]``, the input less the batch's mean; None in evaluation mode.
    :param inverse: of the standard deviation by which it was divided.
    :param variance: of the batch.
    :param shift: that followed from the running statistics; None before the end of the warm-up.
    :param ratio: of the batch's standard deviation to the running one, clipped; None as well.
    """

    factor: th.Tensor
    centred: th.Tensor | None = None
    inverse: th.Tensor | None = None
    variance: th.Tensor | None = None
    shift: th.Tensor | None = None
    ratio: th.Tensor | None = None


class Renormalization:
    """The present parameters and statistics of a batch renormalization.

    :param layer: the layer.
    :raises TypeError: if it has other parameters or statistics than SB3-Contrib gives it, or chooses its mode
        itself.

    :ivar layer: the layer.
    """

    __slots__ = ("_columns", "_tensors", "layer")

    def __init__(self, layer: BatchRenorm1d) -> None:
        state = own_state(layer)
        parameters, statistics = state["_parameters"], state["_buffers"]
        named = [*parameters, *statistics] == ["scale", "bias", "ra_mean", "ra_var", "steps"]
        if not named or not layer.affine or state["_modules"]:
            raise TypeError("a BatchRenorm1d has other parameters or statistics than SB3-Contrib's")
        if "train" in state:
            raise TypeError("a BatchRenorm1d has a replaced train method, which may keep it in one mode")
        (scale, bias), (mean, variance, _) = parameters.values(), statistics.values()
        for tensor in (scale, bias):
            check_parameter(tensor)
        for tensor in (mean, variance):
            check_parameter(tensor, th.Tensor)
        self.layer, self._tensors = layer, (mean, variance, scale, bias)
        self._columns: list[th.Tensor] = []

    @property
    def tensors(self) -> tuple[th.Tensor, ...]:
        return self._tensors

    def replaced(self, tensors: Iterator[th.Tensor]) -> "Renormalization":
        """A copy with other :attr:`tensors`, for evaluation mode."""
        made = copy(self)
        made._tensors = next(tensors), next(tensors), next(tensors), next(tensors)
        made._columns = []
        return made

    @property
    def signature(self) -> tuple[Any, ...]:
        layer = self.layer
        constants = type(layer), layer.eps, layer.momentum, layer.rmax, layer.dmax, layer.warmup_steps
        return *constants, *(tensor.data_ptr() for tensor in self._tensors), layer.steps.data_ptr()  # type: ignore[operator]

    def __call__(self, x: th.Tensor) -> th.Tensor:
        """Evaluation mode, with the statistics of the first call.

        The layer's own operations in its order: the result is equal to the bit.

        :param x: ``[features, rows]``.
        """
        if not self._columns:
            mean, variance, scale, bias = self._tensors
            with th.no_grad():
                deviation = th.add(variance, self.layer.eps).sqrt_()
                self._columns = [each.unsqueeze(1) for each in (mean, deviation, scale, bias)]
        mean, deviation, scale, bias = self._columns
        return (x - mean).div_(deviation).mul_(scale).add_(bias)

    def factors(self) -> list[th.Tensor]:
        """Evaluation mode with the present statistics: a factor and a summand per feature."""
        mean, variance, scale, bias = self._tensors
        with th.no_grad():
            gain = scale / th.add(variance, self.layer.eps).sqrt_()
            return [gain, bias - mean * gain]

    def evaluate(self, x: th.Tensor) -> tuple[th.Tensor, Normalized]:
        """Evaluation mode with the present statistics.

        :param x: ``[features, rows]``.
        :return: the normalized input, and what :meth:`backward` needs.
        """
        factor, summand = (each.unsqueeze(1) for each in self.factors())
        return (x * factor).add_(summand), Normalized(factor)

    def train(self, x: th.Tensor, past_warmup: bool) -> tuple[th.Tensor, Normalized]:
        """Training mode: normalize with the batch's statistics, and update the running ones.

        :param x: ``[features, rows]``.
        :param past_warmup: whether the running statistics correct those of the batch.
        :return: the normalized input, and what :meth:`backward` needs.
        """
        layer = self.layer
        running_mean, running_variance, scale, bias = (each.unsqueeze(1) for each in self._tensors)
        mean = x.mean(dim=1, keepdim=True)
        centred = x - mean
        # torch's own variance is slow.
        variance = th.linalg.vector_norm(centred, dim=1, keepdim=True).square_().div_(x.shape[1] - 1)
        shift = ratio = None
        corrected = variance
        if past_warmup:
            running = (running_variance + layer.eps).sqrt_()
            ratio = (variance + layer.eps).sqrt_().div_(running).clamp_(1 / layer.rmax, layer.rmax)
            shift = ((mean - running_mean) / running).clamp_(-layer.dmax, layer.dmax)
            shift *= variance.sqrt() / ratio
            corrected = variance / ratio.square()
        running_mean.add_(mean - running_mean, alpha=layer.momentum)
        running_variance.add_(variance - running_variance, alpha=layer.momentum)
        layer.steps += 1  # type: ignore[operator, assignment]
        inverse = (corrected + layer.eps).rsqrt_()
        factor = scale * inverse
        summand = bias if shift is None else th.addcmul(bias, shift, factor)
        return (centred * factor).add_(summand), Normalized(factor, centred, inverse, variance, shift, ratio)

    def backward(
        self, kept: Normalized, gradient: th.Tensor, of_parameters: bool, of_input: bool
    ) -> th.Tensor:
        """Backpropagate a gradient.

        :param kept: of :meth:`train` or :meth:`evaluate`; its ``centred`` may be overwritten.
        :param gradient: with respect to the normalized input; may be overwritten.
        :param of_parameters: set the ``grad`` of scale and bias, for which :meth:`train` is needed.
        :param of_input: return the gradient with respect to the input.
        """
        factor, centred, inverse, variance, shift, ratio = kept
        if centred is None or inverse is None or variance is None:
            return gradient.mul_(factor)
        n = gradient.shape[1]
        of_bias = gradient.sum(dim=1, keepdim=True)
        along = th.linalg.vecdot(gradient, centred, dim=1).unsqueeze(1)
        if shift is not None:
            along += shift * of_bias
        if of_parameters:
            _, _, scale, bias = self._tensors
            th.mul(along[:, 0], inverse[:, 0], out=gradient_of(scale))
            gradient_of(bias).copy_(of_bias[:, 0])
        if not of_input:
            return gradient
        of_variance = -0.5 * factor * inverse.square() * along
        if shift is not None and ratio is not None:
            # The shift grows with the batch's deviation; ratio and the rest of it are constants in the loss.
            # A unit that is dead in the whole batch has no variance: no gradient, where SB3-Contrib's is NaN.
            of_shift = factor * of_bias * shift / (2 * variance).clamp_min_(th.finfo(variance.dtype).tiny)
            of_variance = of_variance / ratio.square() + of_shift
        of_mean = factor * of_bias
        centred.mul_(of_variance * (2 / (n - 1))).sub_(of_mean / n)
        return gradient.mul_(factor).add_(centred)
