"""SB3-Contrib's batch renormalisation with fewer instructions.

In CrossQ's gradient step on a CPU, SB3-Contrib's layers take longer than the matrix products: torch's
variance over rows is slow, and autograd records a dozen operations per layer.
"""

from typing import Any

import torch as th
from sb3_contrib.common.torch_layers import BatchRenorm1d
from torch import nn


class FusedBatchRenorm1d(BatchRenorm1d):
    """``BatchRenorm1d`` whose training mode is one operation of autograd; equal up to float32 rounding."""

    #: Whether the warm-up is over, where the layer cannot ask its own counter of steps (in a CUDA graph).
    past_warmup: bool | None = None

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        Normalize the input tensor.

        :param x: ``[rows, features]``
        :return: the same shape, normalized
        """
        if not (self.training and self.affine):
            return super().forward(x)
        normalized: th.Tensor = _TrainingMode.apply(x, self.scale, self.bias, self)
        return normalized


class _TrainingMode(th.autograd.Function):
    """Normalizes with the batch's statistics, after the warm-up corrected by the running ones."""

    @staticmethod
    def forward(
        ctx: Any, x: th.Tensor, scale: th.Tensor, bias: th.Tensor, layer: FusedBatchRenorm1d
    ) -> th.Tensor:
        mean = x.mean(dim=0)
        centred = x - mean
        variance = centred.square().sum(dim=0) / (len(x) - 1)
        # Output: scale * (centred + shift) / deviation + bias.
        shift = ratio = None
        corrected = variance
        known = layer.past_warmup
        if layer.steps > layer.warmup_steps if known is None else known:  # type: ignore[operator]
            running = (layer.ra_var + layer.eps).sqrt_()  # type: ignore[operator, union-attr]
            ratio = (variance + layer.eps).sqrt_().div_(running).clamp_(1 / layer.rmax, layer.rmax)
            shift = ((mean - layer.ra_mean) / running).clamp_(-layer.dmax, layer.dmax)  # type: ignore[operator]
            shift *= variance.sqrt() / ratio
            corrected = variance / ratio.square()
        layer.ra_mean += layer.momentum * (mean - layer.ra_mean)  # type: ignore[operator]
        layer.ra_var += layer.momentum * (variance - layer.ra_var)  # type: ignore[operator]
        layer.steps += 1  # type: ignore[operator, assignment]
        inverse = (corrected + layer.eps).rsqrt_()
        ctx.save_for_backward(centred, inverse, scale, variance, shift, ratio)
        factor = scale * inverse
        return th.addcmul(bias if shift is None else th.addcmul(bias, shift, factor), centred, factor)

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> Any:
        centred, inverse, scale, variance, shift, ratio = ctx.saved_tensors
        n = len(gradient)
        factor = scale * inverse
        of_bias = gradient.sum(dim=0)
        along = (gradient * centred).sum(dim=0)
        if shift is not None:
            along += shift * of_bias
        of_variance = -0.5 * factor * inverse.square() * along
        if shift is not None:
            # The shift grows with the batch's deviation; ratio and the rest of it are constants in the loss.
            # A unit that is dead in the whole batch has no variance: no gradient, where SB3-Contrib's is NaN.
            of_shift = factor * of_bias * shift / (2 * variance).clamp_min_(th.finfo(variance.dtype).tiny)
            of_variance = of_variance / ratio.square() + of_shift
        of_mean = -factor * of_bias
        of_x = th.addcmul(of_mean / n, gradient, factor).addcmul_(centred, of_variance * (2 / (n - 1)))
        return of_x, along * inverse, of_bias, None


def fuse_batch_renorm(network: nn.Module, fused: bool = True) -> None:
    """Choose how a network's batch renormalisation is computed. Layers of a user's own class stay.

    :param network: a policy; its parameters and buffers stay the same tensors.
    :param fused: with fewer instructions, not as SB3-Contrib computes it.
    """
    before, after = (BatchRenorm1d, FusedBatchRenorm1d) if fused else (FusedBatchRenorm1d, BatchRenorm1d)
    for module in network.modules():
        if type(module) is before:
            module.__class__ = after
