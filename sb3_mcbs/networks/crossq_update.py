"""CrossQ's gradient step with SB3-Contrib's mathematics and fewer instructions.

The gradients are written out, as in :mod:`~sb3_mcbs.networks.td3_update`: without autograd's graph, without
the gradients that are not needed (of the critics' weights in the actor's step), and with all tensors of Adam
in one call. Random numbers are drawn in the same order, so both give the same networks up to float32
rounding.
"""

import functools
from typing import Any, NamedTuple

import torch as th
from sb3_contrib import CrossQ
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_mcbs.networks.gradient_steps import FastGradientSteps
from sb3_mcbs.networks.mlp import MLP
from sb3_mcbs.networks.plain_networks import check_used_once
from sb3_mcbs.networks.soft_update import SoftUpdate
from sb3_mcbs.networks.squashed_gaussian import Sampled, SquashedGaussian
from sb3_mcbs.networks.update import Losses, pairs_of


class _Kind(NamedTuple):
    """What Python decides in a gradient step: which layers' warm-up is over, and more.

    :param with_actor: whether the actor is updated.
    :param critics: for each critic and each of its batch renormalizations.
    :param actor: for each of the actor's, if it is updated.
    """

    with_actor: bool
    critics: tuple[tuple[bool, ...], ...]
    actor: tuple[bool, ...]


class CrossQUpdate(SoftUpdate):
    """The gradient steps of a CrossQ agent whose networks are MLPs with batch renormalization.

    :param agent: the agent; see :class:`~sb3_mcbs.networks.update.Update`.
    :raises TypeError: if something about a network or optimizer is not covered; use SB3-Contrib's ``train``
        then.
    """

    def __init__(self, agent: CrossQ) -> None:
        super().__init__(agent)
        self._gaussian = SquashedGaussian(agent.actor)
        check_used_once([*self._critic_mlps, *self._gaussian.mlps])

    def next_kind(self, number: int) -> _Kind:
        """Count the gradient step.

        :return: what Python decides in it.
        """
        agent = self._agent
        agent._n_updates += 1
        for mlp in (*self._critic_mlps, self._gaussian.latent):
            for renormalization in mlp.renormalizations:
                renormalization.layer.training = False  # as SB3-Contrib leaves it
        with_actor = agent._n_updates % agent.policy_delay == 0
        critics = tuple(map(self._past_warmup, self._critic_mlps))
        return _Kind(with_actor, critics, self._past_warmup(self._gaussian.latent) if with_actor else ())

    def _past_warmup(self, mlp: MLP) -> tuple[bool, ...]:
        layers: list[Any] = [renormalization.layer for renormalization in mlp.renormalizations]
        return tuple(self._counts.count(layer.steps) > layer.warmup_steps for layer in layers)

    def losses_in(self, kind: _Kind) -> tuple[str, ...]:
        """See :meth:`Update.losses_in`."""
        return self.losses if kind.with_actor else ("ent_coef", "critic_loss")

    def step(self, data: ReplayBufferSamples, kind: _Kind) -> Losses:
        """Update the critics, and with ``kind.with_actor`` the entropy coefficient and the actor."""
        alpha = self._coefficient()
        pairs = pairs_of(data.observations, data.actions)
        losses = {"ent_coef": alpha.reshape(())}
        losses["critic_loss"] = self._update_critics(data, pairs, alpha, kind.critics)
        if kind.with_actor:
            n_obs = len(pairs) - self._gaussian.act_dim
            sampled = self._draw(pairs[:n_obs], kind.actor)
            losses |= self._update_coefficient(sampled.log_prob)
            pairs[n_obs:] = sampled.actions
            losses["actor_loss"] = self._update_actor(pairs, sampled, alpha)
        return losses

    def _draw(self, observations: th.Tensor, past_warmup: tuple[bool, ...] | None = None) -> Sampled:
        """Draw actions.

        :param observations: ``[obs_dim, rows]``.
        :param past_warmup: see :meth:`~sb3_mcbs.networks.mlp.MLP.run`.
        """
        shape = observations.shape[1], self._gaussian.act_dim
        noise = observations.new_empty(shape).normal_().t()
        return self._gaussian.sample(observations, noise, past_warmup)

    def _update_critics(
        self,
        data: ReplayBufferSamples,
        pairs: th.Tensor,
        alpha: th.Tensor,
        past_warmup: tuple[tuple[bool, ...], ...],
    ) -> th.Tensor:
        """One step of all critics, with the values of both ends of the transitions from one run.

        :param pairs: ``[obs_dim + act_dim, batch]``.
        :param alpha: the entropy coefficient.
        :param past_warmup: for each critic.
        :return: the loss: half the sum of their mean squared errors.
        """
        n = len(data.actions)
        next_pairs = pairs_of(data.next_observations, data.actions)
        n_obs = len(pairs) - self._gaussian.act_dim
        sampled = self._draw(next_pairs[:n_obs])
        next_pairs[n_obs:] = sampled.actions
        both = th.cat([pairs, next_pairs], dim=1)
        runs = [critic.run(both, past) for critic, past in zip(self._critic_mlps, past_warmup, strict=True)]
        next_values = th.cat([run.output[:, n:] for run in runs]).amin(dim=0).unsqueeze(1)
        targets = self._targets(data, next_values, sampled.log_prob.t(), alpha).t()
        losses = []
        for critic, run in zip(self._critic_mlps, runs, strict=True):
            errors = run.output[:, :n] - targets
            losses.append(0.5 * errors.square().mean())
            gradient = th.zeros_like(run.output)
            gradient[:, :n] = errors / n
            critic.backward(run, gradient, of_parameters=True)
        self.adam_step(1)
        return functools.reduce(th.add, losses)

    def _update_actor(self, pairs: th.Tensor, sampled: Sampled, alpha: th.Tensor) -> th.Tensor:
        """One step of the actor up the lowest critic.

        :param pairs: ``[obs_dim + act_dim, batch]``, with the actor's actions.
        :param sampled: these actions.
        :param alpha: the entropy coefficient.
        :return: the loss: the mean of the weighted logarithms of their density less their values.
        """
        values, by_action = self._action_gradient(pairs)
        self._gaussian.backward(sampled, by_action, alpha / pairs.shape[1])
        self.adam_step(0)
        return (alpha * sampled.log_prob - values).mean()

    def _action_gradient(self, pairs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """The gradient of the negative mean of the lowest critic's values.

        :param pairs: ``[obs_dim + act_dim, batch]``.
        :return: these values ``[batch]``, and the gradient with respect to the actions ``[act_dim, batch]``.
        """
        runs = [critic.run(pairs) for critic in self._critic_mlps]
        values, lowest = th.cat([run.output for run in runs]).min(dim=0)
        gradients = []
        for number, (critic, run) in enumerate(zip(self._critic_mlps, runs, strict=True)):
            gradient = (lowest == number).to(values.dtype).div_(-len(values)).unsqueeze(0)
            gradients.append(critic.backward(run, gradient, of_input=True))
        return values, functools.reduce(th.add, gradients)[-self._gaussian.act_dim :]


class CrossQSteps(FastGradientSteps, CrossQ):
    """CrossQ, or a subclass, whose gradient steps are those of :class:`CrossQUpdate` where they can be."""

    _sb3s_train = CrossQ.train

    def _make_update(self) -> CrossQUpdate:
        return CrossQUpdate(self)
