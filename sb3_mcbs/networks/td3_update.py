"""TD3's gradient step with SB3's mathematics and fewer instructions.

Unlike SB3 it does not convert float64 observations at every call of a network, compute gradients that are not
needed (of the critics' weights in the actor's step), build autograd's graph, or update Adam and the target
networks one tensor at a time. Random numbers are drawn in the same order, so both give the same networks up
to float32 rounding.
"""

import functools
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.td3 import td3 as td3_module
from torch.nn import functional as F

from sb3_mcbs.networks.gradient_steps import FastGradientSteps
from sb3_mcbs.networks.plain_networks import (
    actor_mlp,
    check_trained,
    check_unreplaced,
    check_used_once,
    critic_mlps,
    parameters_of,
)
from sb3_mcbs.networks.update import Losses, Update, pairs_of


class TD3Update(Update):
    """The gradient steps of a TD3 agent whose networks are plain MLPs.

    :param agent: the agent; see :class:`Update`.
    :raises TypeError: if something about a network or optimizer is not covered; use SB3's ``train`` then.
    """

    losses = ("actor_loss", "critic_loss")

    def __init__(self, agent: TD3) -> None:
        super().__init__(agent, [agent.actor.optimizer, agent.critic.optimizer])
        self._actor, self._actor_target = actor_mlp(agent.actor), actor_mlp(agent.actor_target)
        self._critics, self._critic_targets = critic_mlps(agent.critic), critic_mlps(agent.critic_target)
        actor = parameters_of(agent.actor, [self._actor])
        actor_target = parameters_of(agent.actor_target, [self._actor_target])
        critic = parameters_of(agent.critic, self._critics)
        critic_target = parameters_of(agent.critic_target, self._critic_targets)
        check_trained(agent.actor.optimizer, actor)
        check_trained(agent.critic.optimizer, critic)
        check_used_once([self._actor, *self._critics])
        self._targets_and_networks = [(critic_target, critic), (actor_target, actor)]
        if len(actor_target) != len(actor) or len(critic_target) != len(critic):
            raise TypeError("a target network is of another shape than its network")
        if th.is_anomaly_enabled():
            raise TypeError("autograd looks for anomalies")

    def next_kind(self, number: int) -> bool:
        """Count the gradient step.

        :return: whether the actor and the targets are updated in it.
        """
        self._agent._n_updates += 1
        return bool(self._agent._n_updates % self._agent.policy_delay == 0)

    def losses_in(self, kind: bool) -> tuple[str, ...]:
        """See :meth:`Update.losses_in`."""
        return self.losses if kind else ("critic_loss",)

    def step(self, data: ReplayBufferSamples, kind: bool) -> Losses:
        """Update the critics, and with ``kind`` the actor and the targets."""
        # The training mode makes no difference to these layers, so it is not set.
        pairs = pairs_of(data.observations, data.actions)
        losses = {"critic_loss": self._update_critics(data, pairs)}
        if kind:
            losses["actor_loss"] = self._update_actor(pairs)
            self._update_target_networks()
        return losses

    def constants(self) -> tuple[Any, ...]:
        """See :meth:`Update.constants`."""
        agent = self._agent
        mlps = [self._actor, self._actor_target, *self._critics, *self._critic_targets]
        settings = agent.gamma, agent.tau, agent.target_policy_noise, agent.target_noise_clip
        return *settings, *(mlp.signature for mlp in mlps)

    def _targets(self, data: ReplayBufferSamples) -> th.Tensor:
        """Clipped double-Q targets with target policy smoothing.

        :return: ``[1, batch]``.
        """
        agent = self._agent
        noise = data.actions.clone().normal_(0, agent.target_policy_noise)
        noise.clamp_(-agent.target_noise_clip, agent.target_noise_clip)
        pairs = pairs_of(data.next_observations, noise)
        n_obs = len(pairs) - data.actions.shape[1]
        pairs[n_obs:] += self._actor_target(pairs[:n_obs])
        pairs[n_obs:].clamp_(-1, 1)
        next_values = th.cat([critic(pairs) for critic in self._critic_targets]).amin(dim=0, keepdim=True)
        discounts = agent.gamma if data.discounts is None else data.discounts.t()
        return data.rewards.t() + (1 - data.dones.t()) * discounts * next_values

    def _update_critics(self, data: ReplayBufferSamples, pairs: th.Tensor) -> th.Tensor:
        """One step of all critics.

        :param pairs: ``[obs_dim + act_dim, batch]``.
        :return: the loss: the sum of their mean squared errors.
        """
        targets = self._targets(data)
        losses = []
        for critic in self._critics:
            run = critic.run(pairs)
            errors = run.output - targets
            losses.append(errors.square().mean())
            critic.backward(run, errors * (2 / errors.numel()), of_parameters=True)
        self.adam_step(1)
        return functools.reduce(th.add, losses)

    def _update_actor(self, pairs: th.Tensor) -> th.Tensor:
        """One step of the actor up the first critic.

        :param pairs: ``[obs_dim + act_dim, batch]``; its actions are overwritten.
        :return: the loss: the negative mean of the critic's values.
        """
        n_obs = len(pairs) - get_action_dim(self._agent.action_space)
        observations = pairs[:n_obs]
        run = self._actor.run(observations)
        pairs[n_obs:] = run.output
        values, gradient = self._action_gradient(pairs, n_obs)
        self._actor.backward(run, gradient, of_parameters=True)
        self.adam_step(0)
        return -values.mean()

    def _action_gradient(self, pairs: th.Tensor, n_obs: int) -> tuple[th.Tensor, th.Tensor]:
        """The gradient of the actor's loss with respect to its actions.

        :param pairs: ``[obs_dim + act_dim, batch]``, with the actor's actions.
        :param n_obs: obs_dim.
        :return: the first critic's values ``[1, batch]``, and the gradient ``[act_dim, batch]``.
        """
        critic = self._critics[0]
        run = critic.run(pairs)
        gradient = th.full_like(run.output, -1 / run.output.numel())
        return run.output, critic.backward(run, gradient, of_input=True)[n_obs:]

    def _update_target_networks(self) -> None:
        for targets, networks in self._targets_and_networks:
            self.update_targets(targets, networks)


#: What TD3's ``train`` calls besides networks and optimizers; a user may replace it.
_CALLED = [
    (owner, name, getattr(owner, name)) for owner, name in ((F, "mse_loss"), (td3_module, "polyak_update"))
]


class FastUpdate(FastGradientSteps, TD3):
    """TD3, or a subclass of it, whose gradient steps are those of :class:`TD3Update` where they can be."""

    _sb3s_train = TD3.train

    def _make_update(self) -> TD3Update:
        check_unreplaced(_CALLED)
        return TD3Update(self)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Get the actor's action, on a GPU by a CUDA graph if there is one observation for each environment.

        :param observation: the input observation
        :param state: not used
        :param episode_start: not used
        :param deterministic: not used: the actor is deterministic
        :return: the action and ``state``
        """
        if self._in_graphs and self.fast_update:
            with self._current_device():
                actions = self._graph_memory.acting.actions(self.policy, observation)
            if actions is not None:
                return actions, state
        return super().predict(observation, state, episode_start, deterministic)
