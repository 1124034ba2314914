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
from stable_baselines3.common.distributions import TanhBijector
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
from sb3_mcbs.search import SearchSettings

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


def check_values(agent: OffPolicyAlgorithm, settings: SearchSettings) -> None:
    """Refuse settings of values that the agent's networks do not give.

    :param agent: a supported agent.
    :param settings: of the search.
    :raises ValueError: says which setting, and why.
    """
    if settings.entropy_bonus:
        entropy_coefficient(agent)
    if settings.tqc_value == "truncated":
        if not isinstance(agent, TQC):
            raise ValueError(
                f"tqc_value='truncated' is for TQC's quantiles; a {type(agent).__name__} has none. Leave it "
                "out."
            )
        n_quantiles = agent.policy.critic.n_quantiles
        if not 0 <= agent.top_quantiles_to_drop_per_net < n_quantiles:
            raise ValueError(
                "tqc_value='truncated' needs a top_quantiles_to_drop_per_net from 0 to below the number of "
                f"quantiles, {n_quantiles}; got {agent.top_quantiles_to_drop_per_net}."
            )


def entropy_coefficient(agent: OffPolicyAlgorithm) -> float:
    """What an agent's losses multiply the entropy with at present.

    :param agent: a SAC or TQC agent.
    :raises ValueError: if it is another one, or was loaded from a file that does not say it.
    """
    if not isinstance(agent, SAC | TQC):
        raise ValueError(
            f"entropy_bonus=True is for SAC and TQC: the actor of a {type(agent).__name__} is deterministic "
            "and has no entropy. Leave it out."
        )
    # SB3 has one of the two: the first where the coefficient is learned.
    if agent.log_ent_coef is not None:
        return agent.log_ent_coef.detach().exp().item()
    if getattr(agent, "ent_coef_tensor", None) is None:
        raise ValueError(
            "entropy_bonus=True needs the agent's entropy coefficient, which its file does not say. Set it: "
            "agent.ent_coef_tensor = torch.tensor(0.1)."
        )
    return agent.ent_coef_tensor.item()


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


def policy_function(agent: OffPolicyAlgorithm, target: bool = False) -> Callable[[Observations], np.ndarray]:
    """The actor without exploration: its output (TD3, DDPG) or its squashed mean (SAC, TQC).

    :param agent: a supported agent; its present networks are used at every call.
    :param target: the target actor's, where there is one.
    :return: observations ``[rows, *obs_shape]`` -> float32 actions ``[rows, act_dim]`` in [-1, 1].
    """
    policy_network: Any = agent.policy
    stochastic = isinstance(agent, SAC | TQC)
    name = "actor_target" if target and not stochastic else "actor"
    mlp_of = _if_plain(actor_mlp)

    def policy(observations: Observations) -> np.ndarray:
        actor = getattr(policy_network, name)
        mlp = mlp_of(actor)
        if mlp is not None:
            assert isinstance(observations, np.ndarray)
            return _to_numpy(mlp(_columns(observations, None, agent.device)), agent.device).T
        with th.no_grad():
            tensor = obs_as_tensor(observations, agent.device)
            actions = actor(tensor, deterministic=True) if stochastic else actor(tensor)
            return actions.cpu().numpy()

    return policy


def value_function(
    agent: OffPolicyAlgorithm, tqc_value: str = "mean"
) -> Callable[[Observations, np.ndarray], np.ndarray]:
    """The online critics' estimate: the minimum over critics, or TQC's mean over quantiles.

    :param agent: a supported agent; its present networks are used at every call.
    :param tqc_value: which quantiles, see :class:`~sb3_mcbs.SearchSettings`.
    :return: observations ``[rows, *obs_shape]``, scaled actions ``[rows, act_dim]`` -> ``[rows]``.
    """
    policy_network: Any = agent.policy
    quantiles = isinstance(agent, TQC)

    def mean_quantile(quantiles: th.Tensor, critic: Any) -> th.Tensor:
        # ``[quantiles of all critics, rows]``
        if tqc_value == "truncated":
            n_dropped = agent.top_quantiles_to_drop_per_net * critic.n_critics  # type: ignore[attr-defined]
            quantiles = quantiles.sort(dim=0).values[: len(quantiles) - n_dropped]
        return quantiles.mean(dim=0)

    mlps_of = _if_plain(critic_mlps)

    def value(observations: Observations, actions: np.ndarray) -> np.ndarray:
        critic = policy_network.critic
        mlps = mlps_of(critic)
        if mlps is not None:
            assert isinstance(observations, np.ndarray)
            inputs = _columns(observations, actions, agent.device)
            columns = [mlp(inputs) for mlp in mlps]
            if quantiles:
                return _to_numpy(mean_quantile(th.cat(columns), critic), agent.device)
            return _to_numpy(functools.reduce(th.minimum, columns)[0], agent.device)
        with th.no_grad():
            tensor = obs_as_tensor(observations, agent.device)
            estimates = critic(tensor, th.as_tensor(actions, device=agent.device))
            if quantiles:
                return mean_quantile(estimates.flatten(1).t(), critic).cpu().numpy()
            return th.cat(estimates, dim=1).amin(dim=1).cpu().numpy()

    return value


def entropy_function(agent: OffPolicyAlgorithm) -> Callable[[Observations, np.ndarray], np.ndarray]:
    """What actions add to the soft value: ``-ent_coef * log pi(a|s)``.

    :param agent: a SAC or TQC agent; its present actor and entropy coefficient are used at every call.
    :return: observations ``[rows, *obs_shape]``, scaled actions ``[rows, act_dim]`` -> ``[rows]``.
    """
    policy_network: Any = agent.policy

    def bonus(observations: Observations, actions: np.ndarray) -> np.ndarray:
        actor = policy_network.actor
        with th.no_grad():
            distribution = _distribution(actor, obs_as_tensor(observations, agent.device))
            squashed = th.as_tensor(actions, device=agent.device)
            mean = distribution.distribution.mean
            # Where tanh is saturated its inverse is a guess; that of the policy's own action is known.
            latent = th.where(squashed == th.tanh(mean), mean, TanhBijector.inverse(squashed))
            log_prob = _log_prob(actor, distribution, squashed, latent)
            return (-entropy_coefficient(agent) * log_prob).cpu().numpy()

    return bonus


def soft_policy_function(
    agent: OffPolicyAlgorithm,
) -> Callable[[Observations, np.random.Generator], tuple[np.ndarray, np.ndarray]]:
    """The stochastic actor, drawn from with a generator of one's own, and what its entropy adds to the value.

    :param agent: a SAC or TQC agent; its present actor and entropy coefficient are used at every call.
    :return: observations ``[rows, *obs_shape]``, generator -> float32 actions ``[rows, act_dim]`` in [-1, 1],
        and ``-ent_coef * log pi(a|s)`` of each, ``[rows]``.
    """
    policy_network: Any = agent.policy

    def draw(observations: Observations, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        actor = policy_network.actor
        with th.no_grad():
            distribution = _distribution(actor, obs_as_tensor(observations, agent.device))
            normal = distribution.distribution
            noise = rng.standard_normal(tuple(normal.mean.shape), dtype=np.float32)
            latent = normal.mean + normal.stddev * th.as_tensor(noise, device=agent.device)
            actions = th.tanh(latent)
            log_prob = _log_prob(actor, distribution, actions, latent)
            return actions.cpu().numpy(), (-entropy_coefficient(agent) * log_prob).cpu().numpy()

    return draw


def _distribution(actor: Any, observations: Any) -> Any:
    mean, log_std, more = actor.get_action_dist_params(observations)
    return actor.action_dist.proba_distribution(mean, log_std, **more)


def _log_prob(actor: Any, distribution: Any, squashed: th.Tensor, latent: th.Tensor) -> th.Tensor:
    """``log pi(a|s)``; SB3's gSDE takes no latent action and inverts the squashing itself."""
    return distribution.log_prob(squashed) if actor.use_sde else distribution.log_prob(squashed, latent)
