"""The gradient steps of SAC and TQC as functions that can be captured in CUDA graphs.

The mathematics, and the order in which random numbers are drawn, are SB3's. Unlike SB3's ``train`` these read
no number back to the host, and check no distribution's parameters, for which the host would wait.
"""

from collections.abc import Sequence
from typing import Any

import torch as th
from sb3_contrib import TQC
from sb3_contrib.common.utils import quantile_huber_loss
from sb3_contrib.crossq.policies import Actor as CrossQActor
from sb3_contrib.tqc import tqc as tqc_module
from sb3_contrib.tqc.policies import Actor as TQCActor
from stable_baselines3 import SAC
from stable_baselines3.common.distributions import DiagGaussianDistribution, SquashedDiagGaussianDistribution
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.sac import sac as sac_module
from stable_baselines3.sac.policies import Actor as SACActor
from torch.nn import functional as F

from sb3_mcbs.networks.gradient_steps import GradientSteps
from sb3_mcbs.networks.mlp import MLP
from sb3_mcbs.networks.plain_networks import (
    actor_mlp,
    all_parameters,
    check_one_mode,
    check_trained,
    check_unreplaced,
    critic_mlps,
)
from sb3_mcbs.networks.squashed_gaussian import DRAWING, LOG_SQRT_TWO_PI
from sb3_mcbs.networks.update import Losses, Update

#: What the ``train`` methods use besides networks and optimizers; a user may replace it.
_CALLED = [
    (owner, name, getattr(owner, name))
    for owner, name in (
        (F, "mse_loss"),
        (sac_module, "polyak_update"),
        (tqc_module, "polyak_update"),
        (tqc_module, "quantile_huber_loss"),
        (DiagGaussianDistribution, "sample"),
        *(
            (SquashedDiagGaussianDistribution, name)
            for name in ("actions_from_params", "get_actions", "log_prob_from_params", "sample")
        ),
        *((actor, "action_log_prob") for actor in (SACActor, TQCActor, CrossQActor)),
    )
] + DRAWING


class SoftUpdate(Update):
    """What the gradient steps of SAC, TQC and CrossQ have in common.

    :param agent: the agent; see :class:`Update`.
    :raises TypeError: if something about a network or optimizer is not covered; use SB3's ``train`` then.
    """

    losses = ("ent_coef", "actor_loss", "critic_loss", "ent_coef_loss")

    def __init__(self, agent: Any) -> None:
        check_unreplaced(_CALLED)
        if th.is_anomaly_enabled():
            raise TypeError("autograd looks for anomalies")
        learned = agent.ent_coef_optimizer
        optimizers = [agent.actor.optimizer, agent.critic.optimizer]
        super().__init__(agent, optimizers if learned is None else [*optimizers, learned])
        self._critic_mlps = critic_mlps(agent.critic)
        self._mlps = [actor_mlp(agent.actor), MLP(agent.actor.log_std), *self._critic_mlps]
        check_trained(agent.actor.optimizer, all_parameters(agent.actor))
        check_trained(agent.critic.optimizer, all_parameters(agent.critic))
        if learned is not None:
            check_trained(learned, [agent.log_ent_coef])

    def constants(self) -> tuple[Any, ...]:
        """See :meth:`Update.constants`."""
        agent = self._agent
        coefficient = agent.ent_coef_tensor if agent.log_ent_coef is None else agent.log_ent_coef
        settings = agent.gamma, agent.target_entropy, agent.actor.action_dist.epsilon, coefficient.data_ptr()
        return *settings, *(mlp.signature for mlp in self._mlps)

    def _sample(self, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Sample the actor.

        :return: actions ``[batch, act_dim]``, and the logarithms of their density ``[batch, 1]``.
        """
        actor = self._agent.actor
        mean, log_std, _ = actor.get_action_dist_params(observations)
        deviation = th.ones_like(mean) * log_std.exp()
        latent = mean + th.empty_like(mean).normal_() * deviation
        actions = th.tanh(latent)
        density = -((latent - mean) ** 2) / (2 * deviation**2) - deviation.log() - LOG_SQRT_TWO_PI
        squashing = th.log(1 - actions**2 + actor.action_dist.epsilon)
        return actions, (density.sum(dim=1) - squashing.sum(dim=1)).reshape(-1, 1)

    def _coefficient(self) -> th.Tensor:
        """The entropy coefficient."""
        agent = self._agent
        fixed = agent.log_ent_coef is None
        return agent.ent_coef_tensor if fixed else agent.log_ent_coef.detach().exp()

    def _update_coefficient(self, log_prob: th.Tensor) -> Losses:
        """Update the entropy coefficient, if it is learned.

        :return: its loss, if there is one.
        """
        agent = self._agent
        if agent.ent_coef_optimizer is None:
            return {}
        with th.enable_grad():
            loss = -(agent.log_ent_coef * (log_prob + agent.target_entropy).detach()).mean()
        return {"ent_coef_loss": self._descend(2, loss)}

    def _descend(self, index: int, loss: th.Tensor) -> th.Tensor:
        """Step one of the optimizers down a loss.

        :return: the loss.
        """
        parameters: Sequence[th.Tensor] = self._optimizers[index].param_groups[0]["params"]
        gradients = th.autograd.grad(loss, parameters)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient.contiguous()  # Adam's fused step needs the parameter's layout
        self.adam_step(index)
        return loss.detach()

    def _targets(
        self, data: ReplayBufferSamples, next_values: th.Tensor, next_log_prob: th.Tensor, alpha: th.Tensor
    ) -> th.Tensor:
        """Soft targets of the critics.

        :param next_values: ``[batch, values]``.
        :param next_log_prob: ``[batch, 1]``.
        :param alpha: the entropy coefficient.
        """
        discounts = self._agent.gamma if data.discounts is None else data.discounts
        soft = next_values - alpha * next_log_prob
        return data.rewards + (1 - data.dones) * discounts * soft


class SACUpdate(SoftUpdate):
    """The gradient steps of a SAC agent whose networks are plain MLPs."""

    def __init__(self, agent: SAC | TQC) -> None:
        super().__init__(agent)
        check_one_mode(self._mlps)
        self._critics = all_parameters(agent.critic)
        self._critic_targets = all_parameters(agent.critic_target)
        self._mlps += critic_mlps(agent.critic_target)
        if len(self._critics) != len(self._critic_targets):
            raise TypeError("a target network is of another shape than its network")

    def constants(self) -> tuple[Any, ...]:
        """See :meth:`Update.constants`."""
        return self._agent.tau, *super().constants()

    def next_kind(self, number: int) -> bool:
        """Count the gradient step.

        :return: whether the targets are updated in it.
        """
        self._agent._n_updates += 1
        return bool(number % self._agent.target_update_interval == 0)

    def step(self, data: ReplayBufferSamples, kind: bool) -> Losses:
        """Update the entropy coefficient, the critics, the actor, and with ``kind`` the targets."""
        with th.enable_grad():
            actions, log_prob = self._sample(data.observations)
        alpha = self._coefficient()
        losses = {"ent_coef": alpha.reshape(()), **self._update_coefficient(log_prob)}

        next_actions, next_log_prob = self._sample(data.next_observations)
        next_values = self._next_values(data.next_observations, next_actions)
        targets = self._targets(data, next_values, next_log_prob, alpha)
        with th.enable_grad():
            loss = self._critic_loss(data, targets)
        losses["critic_loss"] = self._descend(1, loss)

        with th.enable_grad():
            loss = (alpha * log_prob - self._values(data.observations, actions)).mean()
        losses["actor_loss"] = self._descend(0, loss)
        if kind:
            self.update_targets(self._critic_targets, self._critics)
        return losses

    def _next_values(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        values = th.cat(self._agent.critic_target(observations, actions), dim=1)
        return th.min(values, dim=1, keepdim=True)[0]

    def _critic_loss(self, data: ReplayBufferSamples, targets: th.Tensor) -> th.Tensor:
        values = self._agent.critic(data.observations, data.actions)
        errors = [F.mse_loss(value, targets) for value in values]
        return 0.5 * sum(errors, th.zeros_like(errors[0]))

    def _values(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        values = th.cat(self._agent.critic(observations, actions), dim=1)
        return th.min(values, dim=1, keepdim=True)[0]


class TQCUpdate(SACUpdate):
    """The gradient steps of a TQC agent whose networks are plain MLPs."""

    @property
    def _n_quantiles(self) -> int:
        """Quantiles of the targets that are not dropped."""
        critic, dropped = self._agent.critic, self._agent.top_quantiles_to_drop_per_net
        return int(critic.quantiles_total - dropped * critic.n_critics)

    def constants(self) -> tuple[Any, ...]:
        """See :meth:`Update.constants`."""
        return self._n_quantiles, *super().constants()

    def _next_values(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        quantiles = self._agent.critic_target(observations, actions)
        return th.sort(quantiles.reshape(len(quantiles), -1))[0][:, : self._n_quantiles]

    def _critic_loss(self, data: ReplayBufferSamples, targets: th.Tensor) -> th.Tensor:
        quantiles = self._agent.critic(data.observations, data.actions)
        return quantile_huber_loss(quantiles, targets.unsqueeze(1), sum_over_quantiles=False)

    def _values(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        quantiles: th.Tensor = self._agent.critic(observations, actions)
        return quantiles.mean(dim=2).mean(dim=1, keepdim=True)


class SACSteps(GradientSteps, SAC):
    """SAC, or a subclass of it, whose gradient steps on a GPU are captured in CUDA graphs."""

    _sb3s_train = SAC.train

    def _make_update(self) -> SACUpdate:
        return SACUpdate(self)


class TQCSteps(GradientSteps, TQC):
    """TQC, or a subclass of it, whose gradient steps on a GPU are captured in CUDA graphs."""

    _sb3s_train = TQC.train

    def _make_update(self) -> TQCUpdate:
        return TQCUpdate(self)
