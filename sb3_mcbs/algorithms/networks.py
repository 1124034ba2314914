"""The networks of any trained SB3 off-policy agent as two functions on arrays."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC
from sb3_contrib.tqc.policies import Actor as TQCActor
from sb3_contrib.tqc.policies import Critic as TQCCritic
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.sac.policies import Actor as SACActor
from stable_baselines3.td3.policies import Actor as TD3Actor
from torch import nn

from sb3_mcbs.algorithms.mlp import MLP
from sb3_mcbs.models.base import Observations

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


def _check_plain(network: Any) -> None:
    """Refuse an actor or critic that does more than flatten observations and call its layers."""
    space = network.observation_space
    if not isinstance(space, spaces.Box) or (network.normalize_images and is_image_space(space)):
        raise TypeError("observations are not vectors of numbers")
    if type(network.features_extractor) is not FlattenExtractor:
        raise TypeError(f"features are extracted by a {type(network.features_extractor).__name__}")
    for module in network.modules():
        hooks = module._forward_hooks or module._forward_pre_hooks or module._backward_hooks
        if hooks or "forward" in vars(module):
            raise TypeError(f"a {type(module).__name__} has hooks or a replaced forward method")


def actor_mlp(actor: Any) -> MLP:
    """An actor's deterministic action as an MLP.

    :param actor: an SB3 actor.
    :return: float32 observations ``[obs_dim, rows]`` -> actions ``[act_dim, rows]`` in [-1, 1].
    :raises TypeError: if the actor is more than an MLP.
    """
    _check_plain(actor)
    if type(actor) is TD3Actor:
        return MLP(actor.mu)
    if type(actor) in (SACActor, TQCActor) and not actor.use_sde:
        return MLP(actor.latent_pi, actor.mu, nn.Tanh())
    raise TypeError(f"{type(actor).__name__} is not an actor of a known kind")


def critic_mlps(critic: Any) -> list[MLP]:
    """The single networks of a critic.

    :param critic: an SB3 critic.
    :return: each: float32 observations above actions ``[obs_dim + act_dim, rows]`` -> ``[1, rows]`` or
        quantiles ``[n_quantiles, rows]``.
    :raises TypeError: if the critic is more than MLPs.
    """
    _check_plain(critic)
    if type(critic) not in (ContinuousCritic, TQCCritic):
        raise TypeError(f"{type(critic).__name__} is not a critic of a known kind")
    return [MLP(network) for network in critic.q_networks]


def _if_plain(make: Callable[[Any], _T]) -> Callable[[Any], _T | None]:
    """``make``, with None for a network that it refuses; asked again only when there is another network."""

    @functools.lru_cache(maxsize=1)
    def made(network: Any) -> _T | None:
        try:
            return make(network)
        except TypeError:
            return None

    return made


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


def policy_function(agent: OffPolicyAlgorithm) -> Callable[[Observations], np.ndarray]:
    """The actor without exploration: its output (TD3, DDPG) or its squashed mean (SAC, TQC).

    :param agent: a supported agent; its present networks are used at every call.
    :return: observations ``[rows, *obs_shape]`` -> float32 actions ``[rows, act_dim]`` in [-1, 1].
    """
    policy_network: Any = agent.policy
    stochastic = isinstance(agent, SAC | TQC)
    mlp_of = _if_plain(actor_mlp)

    def policy(observations: Observations) -> np.ndarray:
        actor = policy_network.actor
        mlp = mlp_of(actor)
        if mlp is not None:
            assert isinstance(observations, np.ndarray)
            return _to_numpy(mlp(_columns(observations, None, agent.device)), agent.device).T
        with th.no_grad():
            tensor = obs_as_tensor(observations, agent.device)
            actions = actor(tensor, deterministic=True) if stochastic else actor(tensor)
            return actions.cpu().numpy()

    return policy


def value_function(agent: OffPolicyAlgorithm) -> Callable[[Observations, np.ndarray], np.ndarray]:
    """The online critics' estimate: the minimum over critics, or TQC's mean over all quantiles.

    :param agent: a supported agent; its present networks are used at every call.
    :return: observations ``[rows, *obs_shape]``, scaled actions ``[rows, act_dim]`` -> ``[rows]``.
    """
    policy_network: Any = agent.policy
    quantiles = isinstance(agent, TQC)
    mlps_of = _if_plain(critic_mlps)

    def value(observations: Observations, actions: np.ndarray) -> np.ndarray:
        critic = policy_network.critic
        mlps = mlps_of(critic)
        if mlps is not None:
            assert isinstance(observations, np.ndarray)
            inputs = _columns(observations, actions, agent.device)
            columns = [mlp(inputs) for mlp in mlps]
            if quantiles:
                return _to_numpy(th.cat(columns).mean(dim=0), agent.device)
            return _to_numpy(functools.reduce(th.minimum, columns)[0], agent.device)
        with th.no_grad():
            tensor = obs_as_tensor(observations, agent.device)
            estimates = critic(tensor, th.as_tensor(actions, device=agent.device))
            if quantiles:
                return estimates.mean(dim=(1, 2)).cpu().numpy()
            return th.cat(estimates, dim=1).amin(dim=1).cpu().numpy()

    return value
