"""The networks of any trained SB3 off-policy agent as two functions on arrays."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import obs_as_tensor

from sb3_mcbs.models.base import Observations

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


def policy_function(agent: OffPolicyAlgorithm) -> Callable[[Observations], np.ndarray]:
    """The actor without exploration: its output (TD3, DDPG) or its squashed mean (SAC, TQC).

    :param agent: a supported agent; its present networks are used at every call.
    :return: observations ``[rows, *obs_shape]`` -> float32 actions ``[rows, act_dim]`` in [-1, 1].
    """
    policy_network: Any = agent.policy
    stochastic = isinstance(agent, SAC | TQC)

    def policy(observations: Observations) -> np.ndarray:
        with th.no_grad():
            tensor = obs_as_tensor(observations, agent.device)
            actor = policy_network.actor
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

    def value(observations: Observations, actions: np.ndarray) -> np.ndarray:
        with th.no_grad():
            tensor = obs_as_tensor(observations, agent.device)
            estimates = policy_network.critic(tensor, th.as_tensor(actions, device=agent.device))
            if quantiles:
                return estimates.mean(dim=(1, 2)).cpu().numpy()
            return th.cat(estimates, dim=1).amin(dim=1).cpu().numpy()

    return value
