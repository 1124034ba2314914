"""TD3's gradient step with SB3's mathematics and fewer instructions.

Unlike SB3 it does not convert float64 observations at every call of a network, compute gradients that are not
needed (of the critics' weights in the actor's step), build autograd's graph, or update Adam and the target
networks one tensor at a time. Random numbers are drawn in the same order, so both give the same networks up
to float32 rounding.
"""

import logging
from collections.abc import Collection
from typing import ClassVar

import numpy as np
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.td3 import td3 as td3_module
from torch.nn import functional as F

from sb3_mcbs.networks.plain_networks import (
    actor_mlp,
    check_trained,
    check_unreplaced,
    critic_mlps,
    parameters_of,
)

logger = logging.getLogger("sb3_mcbs")

_SB3S_TRAIN = TD3.train


class TD3Update:
    """The gradient steps of a TD3 agent whose networks are plain MLPs.

    It keeps the networks, optimizers and parameters that the agent has when it is made.

    :param agent: the agent; its networks, optimizers, replay buffer and settings are used, and changed, as
        by its own ``train``.
    :raises TypeError: if something about a network or optimizer is not covered; use SB3's ``train`` then.
    """

    def __init__(self, agent: TD3) -> None:
        self._agent = agent
        self._actor, self._actor_target = actor_mlp(agent.actor), actor_mlp(agent.actor_target)
        self._critics, self._critic_targets = critic_mlps(agent.critic), critic_mlps(agent.critic_target)
        actor = parameters_of(agent.actor, [self._actor])
        actor_target = parameters_of(agent.actor_target, [self._actor_target])
        critic = parameters_of(agent.critic, self._critics)
        critic_target = parameters_of(agent.critic_target, self._critic_targets)
        check_trained(agent.actor, actor)
        check_trained(agent.critic, critic)
        if len({*map(id, actor), *map(id, critic)}) != len(actor) + len(critic):
            raise TypeError("a parameter is used twice")
        self._targets_and_networks = [(critic_target, critic), (actor_target, actor)]
        if len(actor_target) != len(actor) or len(critic_target) != len(critic):
            raise TypeError("a target network is of another shape than its network")
        if th.is_anomaly_enabled():
            raise TypeError("autograd looks for anomalies")

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Do what ``TD3.train`` does.

        :param gradient_steps: how many updates of the critics.
        :param batch_size: transitions sampled for each.
        """
        agent = self._agent
        # The training mode makes no difference to these layers, so it is not set.
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
        """The gradient of the actor's loss with respect to its actions.

        :param pairs: ``[obs_dim + act_dim, batch]``, with the actor's actions.
        :param n_obs: obs_dim.
        :return: the first critic's values ``[1, batch]``, and the gradient ``[act_dim, batch]``.
        """
        critic = self._critics[0]
        outputs = critic.outputs(pairs)
        values = outputs[-1]
        gradient = th.full_like(values, -1 / values.numel())
        return values, critic.backward(pairs, outputs, gradient, of_parameters=False)[n_obs:]

    def _update_target_networks(self) -> None:
        for targets, networks in self._targets_and_networks:
            th._foreach_mul_(targets, 1 - self._agent.tau)
            th._foreach_add_(targets, networks, alpha=self._agent.tau)


#: What TD3's ``train`` calls besides networks and optimizers; a user may replace it.
_CALLED = [
    (owner, name, getattr(owner, name)) for owner, name in ((F, "mse_loss"), (td3_module, "polyak_update"))
]


class FastUpdate(TD3):
    """
    TD3, or a subclass of it, whose gradient steps are those of :class:`TD3Update` where they can be.

    A subclass's constructor sets :attr:`fast_update` before the networks are set up.
    """

    #: What neither ``save`` nor an exact checkpoint contains, and why.
    not_checkpointed: ClassVar[Collection[str]] = {"_reasons_said": "messages to the user of this process"}
    #: ``False`` leaves gradient steps to SB3.
    fast_update: bool
    #: The messages that said why gradient steps were left to SB3.
    _reasons_said: frozenset[str] = frozenset()

    def _setup_model(self) -> None:
        super()._setup_model()
        self._reasons_said = frozenset()
        self._present_update()  # tells the user at once if the fast steps cannot be used

    def _make_update(self) -> TD3Update:
        check_unreplaced(_CALLED)
        if getattr(super().train, "__func__", None) is not _SB3S_TRAIN:
            raise TypeError("a class of the agent overrides train")
        return TD3Update(self)

    def _present_update(self) -> TD3Update | None:
        """The fast gradient steps for the present networks and optimizers, or None if they cannot be used."""
        if not isinstance(self.fast_update, bool):
            raise TypeError(f"fast_update must be True or False, got {self.fast_update!r}.")
        if not self.fast_update:
            return None
        try:
            return self._make_update()
        except TypeError as reason:
            message = f"Gradient steps are SB3's own, not the fast ones: {reason}."
            if message not in self._reasons_said:
                self._reasons_said |= {message}
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
        update = self._present_update()
        if update is None:
            super().train(gradient_steps, batch_size)
        else:
            update.train(gradient_steps, batch_size)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *FastUpdate.not_checkpointed]


def _pairs(observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Observations above actions: float32 ``[obs_dim + act_dim, batch]``."""
    observations = observations.flatten(1)
    n_obs = observations.shape[1]
    pairs = th.empty((n_obs + actions.shape[1], len(actions)), dtype=th.float32, device=actions.device)
    pairs[:n_obs] = observations.t()
    pairs[n_obs:] = actions.t()
    return pairs


def _adam_step(optimizer: th.optim.Optimizer) -> None:
    """Step Adam, on the CPU with all tensors in one call unless the user chose otherwise."""
    group = optimizer.param_groups[0]
    fuse = group["params"][0].device.type == "cpu" and not group["foreach"] and group["fused"] is None
    if not fuse:  # on other devices torch groups the tensors itself
        optimizer.step()
        return
    group["fused"] = True
    try:
        optimizer.step()
    finally:
        group["fused"] = None  # the settings are saved with the agent
