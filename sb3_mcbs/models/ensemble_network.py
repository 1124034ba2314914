"""Several small networks of the same shape, computed as one: a batched matrix product per layer."""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch as th
from torch.nn import functional

#: Neurons of the hidden layers of every member.
HIDDEN = (200, 200)
#: Between them lie the logarithms of the variances, in units of the normalised targets.
LOG_VARIANCES = (-10.0, 1.0)


class Outputs(NamedTuple):
    """What the members say.

    :param means: ``[size, rows, n_targets]``.
    :param log_variances: ``[size, rows, n_targets]``.
    :param termination_logits: ``[size, rows]``.
    """

    means: th.Tensor
    log_variances: th.Tensor
    termination_logits: th.Tensor


class EnsembleNetwork:
    """Networks that answer with a Gaussian for every target and the logit of a termination.

    All parameters of all members are one tensor, of which layers are views ``[size, inputs, outputs]``.

    :param size: number of members.
    :param n_inputs: entries of an input.
    :param n_targets: entries of a target.
    :param rng: draws the initial weights.
    :param device: where it is computed.

    :ivar parameters: the tensor.
    """

    def __init__(
        self, size: int, n_inputs: int, n_targets: int, rng: np.random.Generator, device: th.device
    ) -> None:
        self.size, self.n_inputs, self.n_targets = size, n_inputs, n_targets
        drawn = []
        for inputs, outputs in self._layer_sizes():
            # As torch.nn.Linear draws them.
            bound = 1 / math.sqrt(inputs)
            drawn += [rng.uniform(-bound, bound, n * outputs * size) for n in (inputs, 1)]
        flat = th.from_numpy(np.concatenate(drawn).astype(np.float32))
        self.parameters = flat.to(device).requires_grad_()

    def _layer_sizes(self) -> list[tuple[int, int]]:
        widths = (self.n_inputs, *HIDDEN, 2 * self.n_targets + 1)
        return list(pairwise(widths))

    def _layers(self) -> list[th.Tensor]:
        shapes = [
            shape
            for inputs, outputs in self._layer_sizes()
            for shape in ((self.size, inputs, outputs), (self.size, 1, outputs))
        ]
        parts = self.parameters.split([math.prod(shape) for shape in shapes])
        return [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]

    def __call__(self, inputs: th.Tensor) -> Outputs:
        """Ask every member.

        :param inputs: ``[size, rows, n_inputs]`` float32, normalised.
        :return: what they say.
        """
        *hidden, last_weight, last_bias = self._layers()
        values = inputs
        for weight, bias in zip(hidden[::2], hidden[1::2], strict=True):
            values = functional.silu(th.baddbmm(bias, values, weight))
        means, spreads, logits = th.baddbmm(last_bias, values, last_weight).split(
            (self.n_targets, self.n_targets, 1), dim=2
        )
        low, high = LOG_VARIANCES
        log_variances = high - functional.softplus(high - spreads)
        log_variances = low + functional.softplus(log_variances - low)
        return Outputs(means, log_variances, logits[..., 0])
