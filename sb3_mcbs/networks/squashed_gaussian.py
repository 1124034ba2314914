"""The stochastic actor of SAC, TQC and CrossQ without torch's distributions and autograd."""

import math
from copy import copy
from typing import Any, NamedTuple

import torch as th
from sb3_contrib.crossq import policies as crossq_policies
from sb3_contrib.tqc import policies as tqc_policies
from stable_baselines3.common import distributions
from stable_baselines3.common.distributions import DiagGaussianDistribution, SquashedDiagGaussianDistribution
from stable_baselines3.sac import policies as sac_policies
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN

from sb3_mcbs.networks.mlp import MLP, Pass, on_host
from sb3_mcbs.networks.plain_networks import check_unreplaced

LOG_SQRT_TWO_PI = math.log(math.sqrt(2 * math.pi))
#: What SB3's actors draw with; a user may replace it.
DRAWING = [
    (owner, name, getattr(owner, name))
    for owner, name in (
        *((DiagGaussianDistribution, name) for name in ("proba_distribution", "log_prob")),
        *((SquashedDiagGaussianDistribution, name) for name in ("proba_distribution", "log_prob")),
        (distributions, "sum_independent_dims"),
    )
]
#: Where they find the limits of :data:`LOG_STD_MIN` and :data:`LOG_STD_MAX`.
_LIMITS = [
    (policies, name, getattr(policies, name))
    for policies in (sac_policies, tqc_policies, crossq_policies)
    for name in ("LOG_STD_MIN", "LOG_STD_MAX")
]


class Sampled(NamedTuple):
    """Actions of the actor, with what its gradient needs.

    :param actions: ``[act_dim, rows]``, in [-1, 1].
    :param log_prob: ``[1, rows]``, the logarithms of their density.
    :param noise: ``[act_dim, rows]``, standard normal.
    :param log_std: ``[act_dim, rows]``, clipped.
    :param latent: the run of the layers below.
    :param mean: the run of the layer of the means.
    :param unclipped: the run of the layer of the standard deviations' logarithms.
    """

    actions: th.Tensor
    log_prob: th.Tensor
    noise: th.Tensor
    log_std: th.Tensor
    latent: Pass
    mean: Pass
    unclipped: Pass


class SquashedGaussian:
    """An actor whose layers are those of an :class:`MLP`, to be called without autograd.

    :param actor: of SAC, TQC or CrossQ, of which :func:`~.plain_networks.actor_mlp` can be made.
    :raises TypeError: if it normalizes behind the latent layers, or has none, or if what SB3 draws with was
        replaced.

    :ivar act_dim: dimensions of an action.
    :ivar latent: the layers below mean and standard deviation.
    """

    def __init__(self, actor: Any) -> None:
        check_unreplaced([*DRAWING, *_LIMITS])
        self._epsilon: float = actor.action_dist.epsilon
        self.act_dim: int = actor.action_dist.action_dim
        self.latent, self._mean, self._log_std = MLP(actor.latent_pi), MLP(actor.mu), MLP(actor.log_std)
        if self._mean.renormalizations or self._log_std.renormalizations:
            raise TypeError("the layers of mean and standard deviation contain batch renormalization")

    @property
    def mlps(self) -> list[MLP]:
        """All that is trained."""
        return [self.latent, self._mean, self._log_std]

    def on_host(self) -> "SquashedGaussian":
        """This actor on the CPU, see :func:`~.mlp.on_host`."""
        made = copy(self)
        made.latent, made._mean, made._log_std = on_host(self.mlps)
        return made

    def sample(
        self, observations: th.Tensor, noise: th.Tensor, past_warmup: tuple[bool, ...] | None = None
    ) -> Sampled:
        """Draw actions.

        :param observations: ``[obs_dim, rows]``.
        :param noise: ``[act_dim, rows]``, standard normal.
        :param past_warmup: see :meth:`MLP.run`.
        """
        latent = self.latent.run(observations, past_warmup)
        mean, unclipped = self._mean.run(latent.output), self._log_std.run(latent.output)
        log_std = unclipped.output.clamp(LOG_STD_MIN, LOG_STD_MAX)
        actions = (mean.output + noise * log_std.exp()).tanh_()
        density = noise.square().mul_(-0.5).sub_(log_std).sub_(LOG_SQRT_TWO_PI)
        density -= self._squashing(actions).log_()
        return Sampled(actions, density.sum(0, keepdim=True), noise, log_std, latent, mean, unclipped)

    def backward(self, sampled: Sampled, by_action: th.Tensor, by_log_prob: th.Tensor) -> None:
        """Set the parameters' ``grad``.

        :param sampled: the result of :meth:`sample`; parts of it are overwritten.
        :param by_action: of the loss with respect to the actions, ``[act_dim, rows]``; overwritten.
        :param by_log_prob: of the loss with respect to the logarithms of their density, for every row the
            same.
        """
        actions, _, noise, log_std, latent, mean, unclipped = sampled
        by_action += (2 * by_log_prob) * actions / self._squashing(actions)
        by_mean = by_action.mul_(1 - actions.square())
        by_log_std = by_mean * noise * log_std.exp() - by_log_prob
        by_log_std *= unclipped.output == log_std
        by_latent = self._mean.backward(mean, by_mean, of_parameters=True, of_input=True)
        by_latent += self._log_std.backward(unclipped, by_log_std, of_parameters=True, of_input=True)
        self.latent.backward(latent, by_latent, of_parameters=True)

    def _squashing(self, actions: th.Tensor) -> th.Tensor:
        """The derivatives of actions with respect to what the tanh squashes, never 0."""
        return 1 - actions.square() + self._epsilon
