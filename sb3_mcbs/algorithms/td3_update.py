"""TD3's gradient step with SB3's mathematics and fewer instructions.

What SB3 does and this does not: convert float64 observations at every call of a network, compute
gradients that are thrown away (of the critics' weights in the actor's step), build autograd's graph,
and step Adam and the target networks one tensor at a time. Random numbers are drawn in the same order,
so both give the same networks up to float32 rounding.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from sb3_mcbs.algorithms.networks import actor_mlp, critic_mlps

logger = logging.getLogger("sb3_mcbs")


class TD3Update:
    """The gradient steps of a TD3 agent whose networks are plain MLPs.

    :param agent: the agent; its networks, optimizers, replay buffer and settings are used, and changed, as
        by its own ``train``.
    :raises TypeError: if a network or optimizer is not covered. SB3's own ``train`` is for those.
    """

    def __init__(self, agent: TD3) -> None:
        self._agent = agent
        self._take_networks()

    def _take_networks(self) -> None:
        agent = self._agent
        self._networks = self._present_networks()
        self._actor, self._actor_target = actor_mlp(agent.actor), actor_mlp(agent.actor_target)
        self._critics, self._critic_targets = critic_mlps(agent.critic), critic_mlps(agent.critic_target)
        for network in (agent.actor, agent.critic):
            _check_optimizer(network)
        self._targets_and_networks: list[tuple[list[th.Tensor], list[th.Tensor]]] = [
            (list(target.parameters()), list(network.parameters()))
            for target, network in ((agent.critic_target, agent.critic), (agent.actor_target, agent.actor))
        ]

    def _present_networks(self) -> list[nn.Module]:
        agent = self._agent
        return [agent.actor, agent.actor_target, agent.critic, agent.critic_target]

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Do what ``TD3.train`` does.

        :param gradient_steps: how many updates of the critics.
        :param batch_size: transitions sampled for each.
        """
        agent = self._agent
        if self._present_networks() != self._networks:
            self._take_networks()
        # No layer here does anything else in training mode, so the mode stays as it is.
        agent._update_learning_rate([agent.actor.optimizer, agent.critic.optimizer])
        actor_losses, critic_losses = [], []
        with th.no_grad():
            for _ in range(gradient_steps):
                agent._n_updates += 1
                assert agent.replay_buffer is not None
                data = agent.replay_buffer.sample(batch_size, env=agent._vec_normalize_env)
                pairs = _pairs(data.observations, data.actions)
                critic_losses.append(self._update_critics(data, pairs))
                if agent._n_updates % agent.policy_delay == 0:
                    actor_losses.append(self._update_actor(pairs))
                    self._update_target_networks()

        agent.logger.record("train/n_updates", agent._n_updates, exclude="tensorboard")
        if actor_losses:
            agent.logger.record("train/actor_loss", np.mean(actor_losses))
        agent.logger.record("train/critic_loss", np.mean(critic_losses))

    def _targets(self, data: ReplayBufferSamples) -> th.Tensor:
        """Clipped double-Q targets with target policy smoothing.

        :return: ``[1, batch]``.
        """
        agent = self._agent
        noise = data.actions.clone().normal_(0, agent.target_policy_noise)
        noise.clamp_(-agent.target_noise_clip, agent.target_noise_clip)
        pairs = _pairs(data.next_observations, noise)
        n_obs = len(pairs) - data.actions.shape[1]
        pairs[n_obs:] += self._actor_target(pairs[:n_obs])
        pairs[n_obs:].clamp_(-1, 1)
        next_values = th.cat([critic(pairs) for critic in self._critic_targets]).amin(dim=0, keepdim=True)
        discounts = agent.gamma if data.discounts is None else data.discounts.t()
        return data.rewards.t() + (1 - data.dones.t()) * discounts * next_values

    def _update_critics(self, data: ReplayBufferSamples, pairs: th.Tensor) -> float:
        """One step of all critics.

        :param pairs: ``[obs_dim + act_dim, batch]``.
        :return: the loss: the sum of their mean squared errors.
        """
        targets = self._targets(data)
        losses = []
        for critic in self._critics:
            outputs = critic.outputs(pairs)
            errors = outputs[-1] - targets
            losses.append(errors.square().mean())
            critic.backward(pairs, outputs, errors * (2 / errors.numel()), of_parameters=True)
        _adam_step(self._agent.critic.optimizer)
        return float(sum(losses))

    def _update_actor(self, pairs: th.Tensor) -> float:
        """One step of the actor up the first critic.

        :param pairs: ``[obs_dim + act_dim, batch]``; its actions are overwritten.
        :return: the loss: the negative mean of the critic's values.
        """
        n_obs = len(pairs) - get_action_dim(self._agent.action_space)
        observations = pairs[:n_obs]
        actor_outputs = self._actor.outputs(observations)
        pairs[n_obs:] = actor_outputs[-1]
        values, gradient = self._action_gradient(pairs, n_obs)
        self._actor.backward(observations, actor_outputs, gradient, of_parameters=True)
        _adam_step(self._agent.actor.optimizer)
        return float(-values.mean())

    def _action_gradient(self, pairs: th.Tensor, n_obs: int) -> tuple[th.Tensor, th.Tensor]:
        """How the actor's loss changes with its actions.

        :param pairs: ``[obs_dim + act_dim, batch]``, with the actor's actions.
        :param n_obs: obs_dim.
        :return: the first critic's values ``[1, batch]``, and the gradient ``[act_dim, batch]``.
        """
        first_critic = self._critics[0]
        outputs = first_critic.outputs(pairs)
        values = outputs[-1]
        gradient = th.full_like(values, -1 / values.numel())
        return values, first_critic.backward(pairs, outputs, gradient, of_parameters=False)[n_obs:]

    def _update_target_networks(self) -> None:
        for targets, networks in self._targets_and_networks:
            th._foreach_mul_(targets, 1 - self._agent.tau)
            th._foreach_add_(targets, networks, alpha=self._agent.tau)


class FastUpdate(TD3):
    """
    TD3, or a subclass of it, whose gradient steps are those of :class:`TD3Update` where they can be.

    A subclass's constructor sets :attr:`fast_update` before the networks are set up.
    """

    #: Whether to; ``False`` leaves gradient steps to SB3.
    fast_update: bool
    _update: TD3Update | None = None

    def _setup_model(self) -> None:
        if not isinstance(self.fast_update, bool):
            raise TypeError(f"fast_update must be True or False, got {self.fast_update!r}.")
        super()._setup_model()
        self._update = self._make_update()

    def _make_update(self) -> TD3Update | None:
        if not self.fast_update:
            return None
        try:
            return TD3Update(self)
        except TypeError as reason:
            message = f"Gradient steps are SB3's own, not the fast ones: {reason}."
            logger.info(message)
            if self.verbose >= 1:
                print(message)
            return None

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Update the networks as SB3 does.

        :param gradient_steps: how many gradient steps to do
        :param batch_size: transitions sampled for each
        """
        if self._update is None:
            super().train(gradient_steps, batch_size)
        else:
            self._update.train(gradient_steps, batch_size)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_update"]


def _check_optimizer(network: nn.Module) -> None:
    optimizer: Any = network.optimizer
    if type(optimizer) is not th.optim.Adam or len(optimizer.param_groups) != 1:
        raise TypeError(
            f"the optimizer is {type(optimizer).__name__}, not Adam with a single group of parameters"
        )
    group = optimizer.param_groups[0]
    if [id(p) for p in group["params"]] != [id(p) for p in network.parameters()]:
        raise TypeError("an optimizer does not hold the parameters of its network")
    if group["differentiable"] or group["capturable"]:
        raise TypeError("Adam is differentiable or capturable")
    if not all(p.requires_grad and p.dtype == th.float32 for p in group["params"]):
        raise TypeError("parameters are frozen or not float32")


def _pairs(observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Observations above actions: float32 ``[obs_dim + act_dim, batch]``."""
    observations = observations.flatten(1)
    n_obs = observations.shape[1]
    pairs = th.empty((n_obs + actions.shape[1], len(actions)), dtype=th.float32, device=actions.device)
    pairs[:n_obs] = observations.t()
    pairs[n_obs:] = actions.t()
    return pairs


def _adam_step(optimizer: th.optim.Optimizer) -> None:
    with _fused(optimizer.param_groups[0]):
        optimizer.step()


@contextmanager
def _fused(group: dict[str, Any]) -> Iterator[None]:
    """Let Adam do all tensors in one call; its settings, which are saved with the agent, stay."""
    if group["params"][0].device.type != "cpu" or group["foreach"] or group["fused"] is not None:
        yield  # elsewhere torch does many tensors at once by itself; a choice of the user's stays
        return
    group["fused"] = True
    try:
        yield
    finally:
        group["fused"] = None
