"""The networks of a trained SB3 off-policy agent as functions of arrays.

A function uses the networks that the agent has when the function is made: make it anew for every search or
batch. Plain MLPs on a GPU are copied to the CPU then: for the few rows of a step, asking the GPU takes longer
than computing.
"""

import functools
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import obs_as_tensor

from sb3_mcbs.networks.mlp import MLP, on_host
from sb3_mcbs.networks.plain_networks import actor_mlp, critic_mlps
from sb3_mcbs.networks.squashed_gaussian import SquashedGaussian
from sb3_mcbs.types import Observations

#: A function that draws actions ``[rows, act_dim]`` for observations, and computes their entropy bonus.
Actor = Callable[[Observations, np.random.Generator], tuple[np.ndarray, np.ndarray]]
#: Agents whose actor is a squashed Gaussian, and whose targets have an entropy term.
STOCHASTIC = (SAC, TQC, CrossQ)
SUPPORTED = (TD3, DDPG, *STOCHASTIC)


def check_agent(agent: OffPolicyAlgorithm) -> None:
    """Refuse an agent whose actor and critics a search cannot use.

    :param agent: the agent.
    :raises TypeError: if it is not TD3, DDPG, SAC, TQC or CrossQ (or a subclass).
    :raises ValueError: if its actions are not a bounded Box.
    """
    if not isinstance(agent, SUPPORTED):
        names = ", ".join(cls.__name__ for cls in SUPPORTED)
        raise TypeError(
            f"{type(agent).__name__} has no actor and Q-critics to search with; supported: {names}."
        )
    if not isinstance(agent.action_space, spaces.Box):
        raise ValueError(f"A search needs a continuous (Box) action space, got {agent.action_space}.")


def _columns(first: np.ndarray, second: np.ndarray | None = None) -> th.Tensor:
    """``[rows, ...]`` arrays side by side as float32 ``[features, rows]``."""
    first = first.reshape(len(first), -1).T
    if second is None:
        columns = np.array(first, dtype=np.float32, order="C")
    else:
        columns = np.empty((len(first) + second.shape[1], len(second)), dtype=np.float32)
        columns[: len(first)] = first
        columns[len(first) :] = second.T
    return th.from_numpy(columns)


def actor_of(agent: Any, target: bool = False) -> Any:
    """The actor that acts, or that of the targets.

    :param agent: a supported agent.
    :param target: for training instead of acting: the target actor, if there is one.
    """
    # SB3 trains what the agent holds, and acts with what its policy holds.
    if not target:
        return agent.policy.actor
    return agent.actor if isinstance(agent, STOCHASTIC) else agent.actor_target


def policy_function(agent: OffPolicyAlgorithm, target: bool = False) -> Callable[[Observations], np.ndarray]:
    """The actor without exploration: its output (TD3, DDPG) or its squashed mean (others).

    :param agent: a supported agent.
    :param target: for training instead of acting: the target actor, if there is one.
    :return: observations ``[rows, *obs_shape]`` -> float32 actions ``[rows, act_dim]`` in [-1, 1].
    """
    actor, stochastic = actor_of(agent, target), isinstance(agent, STOCHASTIC)
    with suppress(TypeError):
        return _plain_policy(actor_mlp(actor))
    device = agent.device if target else agent.policy.device
    if not target:
        agent.policy.set_training_mode(False)
    arguments = {"deterministic": True} if stochastic else {}

    def policy(observations: Observations) -> np.ndarray:
        with th.no_grad():
            return actor(obs_as_tensor(observations, device), **arguments).cpu().numpy()

    return policy


def _plain_policy(mlp: MLP) -> Callable[[Any], np.ndarray]:
    [mlp] = on_host([mlp])

    def policy(observations: np.ndarray) -> np.ndarray:
        with th.no_grad():
            return mlp(_columns(observations)).numpy().T

    return policy


def value_function(agent: OffPolicyAlgorithm) -> Callable[[Observations, np.ndarray], np.ndarray]:
    """The online critics' estimate: the minimum over critics, or TQC's mean over quantiles.

    :param agent: a supported agent.
    :return: observations ``[rows, *obs_shape]``, scaled actions ``[rows, act_dim]`` -> ``[rows]``.
    """
    policy: Any = agent.policy
    critic = policy.critic
    quantiles = isinstance(agent, TQC)
    with suppress(TypeError):
        return _plain_value(critic_mlps(critic), quantiles)
    policy.set_training_mode(False)
    device = policy.device

    def value(observations: Observations, actions: np.ndarray) -> np.ndarray:
        with th.no_grad():
            tensor = obs_as_tensor(observations, device)
            estimates = critic(tensor, th.as_tensor(actions, device=device))
            if quantiles:
                return estimates.flatten(1).t().mean(dim=0).cpu().numpy()
            return th.cat(estimates, dim=1).amin(dim=1).cpu().numpy()

    return value


def _plain_value(mlps: list[MLP], quantiles: bool) -> Callable[[Any, np.ndarray], np.ndarray]:
    mlps = on_host(mlps)

    def value(observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        with th.no_grad():
            inputs = _columns(observations, actions)
            outputs = [mlp(inputs) for mlp in mlps]
            if quantiles:
                return th.cat(outputs).mean(dim=0).numpy()
            return functools.reduce(th.minimum, outputs)[0].numpy()

    return value


def soft_policy_function(agent: OffPolicyAlgorithm) -> Actor:
    """Sample the stochastic actor that is trained, and compute its entropy bonus.

    :param agent: one of :data:`STOCHASTIC`.
    :return: observations ``[rows, *obs_shape]``, generator of the noise -> float32 actions
        ``[rows, act_dim]`` in [-1, 1], and their entropy bonus ``-ent_coef * log pi(a|s)``, ``[rows]``.
    """
    own: Any = agent
    actor, device = own.actor, agent.device
    # SB3 has one of the two: the first where the coefficient is learned.
    coefficient = (own.ent_coef_tensor if own.log_ent_coef is None else own.log_ent_coef.exp()).item()
    with suppress(TypeError):
        actor_mlp(actor)
        return _plain_draw(SquashedGaussian(actor).on_host(), coefficient)
    if isinstance(agent, CrossQ):
        # Its ``train`` samples in training mode, in which every call changes the actor's running statistics.
        actor.set_bn_training_mode(False)

    def draw(observations: Observations, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        with th.no_grad():
            mean, log_std, more = actor.get_action_dist_params(obs_as_tensor(observations, device))
            distribution = actor.action_dist.proba_distribution(mean, log_std, **more)
            normal = distribution.distribution
            noise = rng.standard_normal(tuple(normal.mean.shape), dtype=np.float32)
            latent = normal.mean + normal.stddev * th.as_tensor(noise, device=device)
            actions = th.tanh(latent)
            # SB3's gSDE takes no latent action and inverts the squashing itself.
            arguments = (actions,) if actor.use_sde else (actions, latent)
            log_prob = distribution.log_prob(*arguments)
            return actions.cpu().numpy(), (-coefficient * log_prob).cpu().numpy()

    return draw


def _plain_draw(actor: SquashedGaussian, coefficient: float) -> Actor:
    def draw(observations: Any, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        noise = rng.standard_normal((len(observations), actor.act_dim), dtype=np.float32)
        with th.no_grad():
            drawn = actor.sample(_columns(observations), th.from_numpy(noise).t())
            return drawn.actions.numpy().T, (-coefficient * drawn.log_prob[0]).numpy()

    return draw


def target_actor(agent: Any) -> Actor:
    """The current actor of the targets.

    :param agent: a supported agent.
    :return: observations ``[rows, *obs_shape]``, generator of noise -> float32 actions ``[rows, act_dim]``
        in [-1, 1], and their entropy bonus ``[rows]``, see :func:`soft_policy_function`. TD3 and DDPG need no
        noise and have no bonus.
    """
    if isinstance(agent, STOCHASTIC):
        return soft_policy_function(agent)
    policy = policy_function(agent, target=True)
    return lambda observations, rng: (policy(observations), np.zeros(len(observations)))


def unscales_as_sb3(agent: Any) -> bool:
    """Whether actions are scaled by SB3's own formula, in float32.

    :param agent: a supported agent.
    """
    policy = agent.policy
    is_sb3s = getattr(type(policy), "unscale_action", None) is BasePolicy.unscale_action
    return is_sb3s and "unscale_action" not in vars(policy) and policy.action_space.dtype == np.float32


def unscale_function(agent: OffPolicyAlgorithm) -> Callable[[np.ndarray], np.ndarray]:
    """The function that turns scaled actions into actions of the environment.

    :param agent: a supported agent.
    :return: ``[rows, act_dim]`` in [-1, 1] -> ``[rows, *act_shape]``.
    """
    policy: Any = agent.policy
    space = policy.action_space
    if not unscales_as_sb3(agent):
        return lambda actions: policy.unscale_action(actions.reshape(-1, *space.shape))
    low, half_range = space.low, 0.5 * (space.high - space.low)

    def unscale(actions: np.ndarray) -> np.ndarray:
        # SB3's formula, low + 0.5 * (action + 1) * (high - low), to the bit: halving rounds nothing.
        unscaled = actions.reshape(-1, *space.shape) + 1.0
        unscaled *= half_range
        unscaled += low
        return unscaled

    return unscale
