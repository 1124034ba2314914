"""The networks of any trained SB3 off-policy agent as two functions on arrays."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import obs_as_tensor

from sb3_mcbs.networks.mlp import MLP
from sb3_mcbs.networks.plain_networks import actor_mlp, critic_mlps
from sb3_mcbs.types import Observations

_T = TypeVar("_T")

SUPPORTED = (TD3, DDPG, SAC, TQC)


def check_agent(agent: OffPolicyAlgorithm) -> None:
    """Refuse an agent whose actor and critics a search cannot use.

    :param agent: the agent.
    :raises TypeError: if it is no TD3, DDPG, SAC or TQC (or a subclass).
    :raises ValueError: if its actions are not a bounded Box.
    """
    if not isinstance(agent, SUPPORTED):
        names = ", ".join(cls.__name__ for cls in SUPPORTED)
        raise TypeError(
            f"{type(agent).__name__} has no actor and Q-critics to search with; supported: {names}."
        )
    if not isinstance(agent.action_space, spaces.Box):
        raise ValueError(f"A search needs a continuous (Box) action space, got {agent.action_space}.")


def _if_plain(make: Callable[[Any], _T], network: Any) -> _T | None:
    """``make(network)``, or None for a network that it refuses."""
    try:
        return make(network)
    except TypeError:
        return None


def _columns(first: np.ndarray, second: np.ndarray | None, device: th.device) -> th.Tensor:
    """``[rows, ...]`` arrays side by side as float32 ``[features, rows]``."""
    first = first.reshape(len(first), -1).T
    if second is None:
        columns = np.array(first, dtype=np.float32, order="C")
    else:
        columns = np.empty((len(first) + second.shape[1], len(second)), dtype=np.float32)
        columns[: len(first)] = first
        columns[len(first) :] = second.T
    tensor = th.from_numpy(columns)
    # ``to`` and ``cpu`` cost as much as a layer even where they have nothing to do.
    return tensor if device.type == "cpu" else tensor.to(device)


def _to_numpy(tensor: th.Tensor, device: th.device) -> np.ndarray:
    return (tensor if device.type == "cpu" else tensor.cpu()).numpy()


def policy_function(agent: OffPolicyAlgorithm, target: bool = False) -> Callable[[Observations], np.ndarray]:
    """The actor without exploration: its output (TD3, DDPG) or its squashed mean (SAC, TQC).

    :param agent: a supported agent. Its networks are those of now: make this function for every search.
    :param target: for training instead of acting: the target actor where there is one.
    :return: observations ``[rows, *obs_shape]`` -> float32 actions ``[rows, act_dim]`` in [-1, 1].
    """
    own: Any = agent
    stochastic = isinstance(agent, SAC | TQC)
    # SB3 trains what the agent holds, and acts with what its policy holds.
    actor = own.policy.actor if not target else own.actor if stochastic else own.actor_target
    mlp = _if_plain(actor_mlp, actor)
    if mlp is not None:
        return functools.partial(_actions, mlp)
    device = agent.device if target else agent.policy.device
    if not target:
        agent.policy.set_training_mode(False)
    arguments = {"deterministic": True} if stochastic else {}

    def policy(observations: Observations) -> np.ndarray:
        with th.no_grad():
            return actor(obs_as_tensor(observations, device), **arguments).cpu().numpy()

    return policy


def _actions(mlp: MLP, observations: np.ndarray) -> np.ndarray:
    with th.no_grad():
        return _to_numpy(mlp(_columns(observations, None, mlp.device)), mlp.device).T


def value_function(agent: OffPolicyAlgorithm) -> Callable[[Observations, np.ndarray], np.ndarray]:
    """The online critics' estimate: the minimum over critics, or TQC's mean over quantiles.

    :param agent: a supported agent. Its networks are those of now: make this function for every search.
    :return: observations ``[rows, *obs_shape]``, scaled actions ``[rows, act_dim]`` -> ``[rows]``.
    """
    policy: Any = agent.policy
    critic = policy.critic
    quantiles = isinstance(agent, TQC)

    mlps = _if_plain(critic_mlps, critic)
    if mlps is None:
        policy.set_training_mode(False)
    device = policy.device if mlps is None else mlps[0].device

    def value(observations: Observations, actions: np.ndarray) -> np.ndarray:
        with th.no_grad():
            if mlps is not None:
                assert isinstance(observations, np.ndarray)
                inputs = _columns(observations, actions, device)
                columns = [mlp(inputs) for mlp in mlps]
                if quantiles:
                    return _to_numpy(th.cat(columns).mean(dim=0), device)
                return _to_numpy(functools.reduce(th.minimum, columns)[0], device)
            tensor = obs_as_tensor(observations, device)
            estimates = critic(tensor, th.as_tensor(actions, device=device))
            if quantiles:
                return estimates.flatten(1).t().mean(dim=0).cpu().numpy()
            return th.cat(estimates, dim=1).amin(dim=1).cpu().numpy()

    return value


def soft_policy_function(
    agent: OffPolicyAlgorithm,
) -> Callable[[Observations, np.random.Generator], tuple[np.ndarray, np.ndarray]]:
    """The stochastic actor that is trained, drawn from with a generator of one's own, and its entropy.

    :param agent: a SAC or TQC agent. Its actor is that of now: make this function for every batch.
    :return: observations ``[rows, *obs_shape]``, generator -> float32 actions ``[rows, act_dim]`` in [-1, 1],
        and what each adds to the value, ``-ent_coef * log pi(a|s)``, ``[rows]``.
    """
    own: Any = agent
    actor, device = own.actor, agent.device

    def draw(observations: Observations, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        with th.no_grad():
            distribution = _distribution(actor, obs_as_tensor(observations, device))
            normal = distribution.distribution
            noise = rng.standard_normal(tuple(normal.mean.shape), dtype=np.float32)
            latent = normal.mean + normal.stddev * th.as_tensor(noise, device=device)
            actions = th.tanh(latent)
            log_prob = _log_prob(actor, distribution, actions, latent)
            # SB3 has one of the two: the first where the coefficient is learned.
            learned = own.log_ent_coef
            coefficient = own.ent_coef_tensor if learned is None else learned.detach().exp()
            return actions.cpu().numpy(), (-coefficient.item() * log_prob).cpu().numpy()

    return draw


def unscale_function(agent: OffPolicyAlgorithm) -> Callable[[np.ndarray], np.ndarray]:
    """What turns scaled actions into actions of the environment.

    :param agent: a supported agent. Its policy is that of now: make this function for every search.
    :return: ``[rows, act_dim]`` in [-1, 1] -> ``[rows, *act_shape]``.
    """
    policy: Any = agent.policy
    space = policy.action_space
    is_sb3s = getattr(type(policy), "unscale_action", None) is BasePolicy.unscale_action
    if not is_sb3s or "unscale_action" in vars(policy) or space.dtype != np.float32:
        return lambda actions: policy.unscale_action(actions.reshape(-1, *space.shape))
    low, half_range = space.low, 0.5 * (space.high - space.low)

    def unscale(actions: np.ndarray) -> np.ndarray:
        # SB3's formula, low + 0.5 * (action + 1) * (high - low), to the bit: halving rounds nothing.
        unscaled = actions.reshape(-1, *space.shape) + 1.0
        unscaled *= half_range
        unscaled += low
        return unscaled

    return unscale


def _distribution(actor: Any, observations: Any) -> Any:
    mean, log_std, more = actor.get_action_dist_params(observations)
    return actor.action_dist.proba_distribution(mean, log_std, **more)


def _log_prob(actor: Any, distribution: Any, squashed: th.Tensor, latent: th.Tensor) -> th.Tensor:
    """``log pi(a|s)``; SB3's gSDE takes no latent action and inverts the squashing itself."""
    return distribution.log_prob(squashed) if actor.use_sde else distribution.log_prob(squashed, latent)
