"""SB3's networks as MLPs, as long as they are as SB3 makes them. SB3 itself runs those that were changed.

A user may change a network at any time: replace or freeze layers, add hooks, or exchange the network. So the
results here are not cached: every search and every training asks anew.
"""

from typing import Any

import torch as th
from gymnasium import spaces
from sb3_contrib.common.torch_layers import BatchRenorm1d
from sb3_contrib.crossq.policies import Actor as CrossQActor
from sb3_contrib.crossq.policies import CrossQCritic
from sb3_contrib.tqc.policies import Actor as TQCActor
from sb3_contrib.tqc.policies import Critic as TQCCritic
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import BaseModel, ContinuousCritic
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.sac.policies import Actor as SACActor
from stable_baselines3.td3.policies import Actor as TD3Actor
from torch import nn
from torch.nn.modules import module as torch_module
from torch.optim import optimizer as torch_optimizer

from sb3_mcbs.networks.layers import own_state
from sb3_mcbs.networks.mlp import MLP

#: Subclasses and wrappers are not included, since they may do something else.
_STOCHASTIC_ACTORS: tuple[type[nn.Module], ...] = (SACActor, TQCActor, CrossQActor)
_CRITICS: tuple[type[nn.Module], ...] = (ContinuousCritic, TQCCritic, CrossQCritic)
_NETWORKS = (TD3Actor, *_STOCHASTIC_ACTORS, *_CRITICS)
_LAYERS = (
    nn.Linear,
    BatchRenorm1d,
    nn.ReLU,
    nn.Tanh,
    nn.Sequential,
    nn.Flatten,
    FlattenExtractor,
)


_METHODS = {
    cls: frozenset(name for name in dir(cls) if callable(getattr(cls, name)))
    for cls in (*_NETWORKS, SquashedDiagGaussianDistribution, th.optim.Adam)
}
#: What calling a network calls; a user may replace it.
_CALLED = [
    (cls, name, getattr(cls, name))
    for cls, name in (
        *((cls, "forward") for cls in (*_NETWORKS, *_LAYERS)),
        (nn.Module, "__call__"),
        (nn.Module, "_call_impl"),
        (BaseModel, "extract_features"),
        (ContinuousCritic, "q1_forward"),
        *((cls, "get_action_dist_params") for cls in _STOCHASTIC_ACTORS),
    )
]
_TANH = nn.Tanh()


def check_unreplaced(called: list[tuple[Any, str, Any]]) -> None:
    """Refuse to bypass functions that a user has replaced.

    :param called: classes or modules, names in them, and the original functions of these names.
    :raises TypeError: names the first that was replaced.
    """
    for owner, name, function in called:
        if getattr(owner, name) is not function:
            raise TypeError(f"{owner.__name__}.{name} was replaced")


def _check_everywhere() -> None:
    """Refuse hooks and settings that affect all networks."""
    if (
        torch_module._global_forward_hooks
        or torch_module._global_forward_pre_hooks
        or torch_module._global_backward_hooks
        or torch_module._global_backward_pre_hooks
    ):
        raise TypeError("there are hooks for all modules")
    check_unreplaced(_CALLED)
    if th.is_autocast_enabled("cpu") or th.is_autocast_enabled("cuda"):
        raise TypeError("autocast is on")


def _check_plain(network: Any) -> Any:
    """Refuse an actor or critic that does more than flatten observations and call its layers.

    :return: its modules by name.
    """
    _check_everywhere()
    if type(network) not in _NETWORKS:
        raise TypeError(f"{type(network).__name__} is not an actor or critic of a known kind")
    state = own_state(network)
    if not _METHODS[type(network)].isdisjoint(state):
        raise TypeError(f"a method of {type(network).__name__} was replaced")
    space = network.observation_space
    if not isinstance(space, spaces.Box) or (network.normalize_images and is_image_space(space)):
        raise TypeError("observations are not vectors of numbers")
    modules = state["_modules"]
    _check_flattens(modules.get("features_extractor"))
    return modules


def _check_flattens(extractor: Any) -> None:
    if type(extractor) is not FlattenExtractor:
        raise TypeError(f"features are extracted by a {type(extractor).__name__}")
    state = own_state(extractor)
    flatten = state["_modules"].get("flatten")
    if type(flatten) is not nn.Flatten or (flatten.start_dim, flatten.end_dim) != (1, -1):
        raise TypeError("observations are not flattened")
    own = own_state(flatten)
    if len(state["_modules"]) > 1 or own["_modules"] or state["_parameters"] or own["_parameters"]:
        raise TypeError("what flattens observations has parameters")


def actor_mlp(actor: Any) -> MLP:
    """An actor's deterministic action as an MLP.

    :param actor: an SB3 actor.
    :return: float32 observations ``[obs_dim, rows]`` -> actions ``[act_dim, rows]`` in [-1, 1].
    :raises TypeError: if the actor is more than an MLP.
    """
    modules = _check_plain(actor)
    if type(actor) is TD3Actor:
        return MLP(modules.get("mu"))
    if type(actor) in _STOCHASTIC_ACTORS and type(actor.action_dist) is SquashedDiagGaussianDistribution:
        if not _METHODS[SquashedDiagGaussianDistribution].isdisjoint(vars(actor.action_dist)):
            raise TypeError("a method of the actor's distribution was replaced")
        MLP(modules.get("log_std"))  # is called as well
        return MLP(modules.get("latent_pi"), modules.get("mu"), _TANH)
    raise TypeError(f"{type(actor).__name__} is not an actor whose mean action is an MLP")


def critic_mlps(critic: Any) -> list[MLP]:
    """The networks of a critic.

    :param critic: an SB3 critic.
    :return: for each: float32 observations above actions ``[obs_dim + act_dim, rows]`` -> ``[1, rows]`` or
        quantiles ``[n_quantiles, rows]``.
    :raises TypeError: if the critic is more than MLPs.
    """
    _check_plain(critic)
    if type(critic) not in _CRITICS:
        raise TypeError(f"{type(critic).__name__} is not a critic of a known kind")
    return [MLP(network) for network in critic.q_networks]


def parameters_of(network: Any, mlps: list[MLP]) -> list[th.Tensor]:
    """The parameters of a TD3 actor or of a critic.

    :param network: the actor or critic.
    :param mlps: its MLPs.
    :return: in the order of ``network.parameters()``.
    :raises TypeError: if the network has parameters that its MLPs do not use, or batch renormalization.
    """
    state = vars(network)
    _, *called = state["_modules"].values()  # the first extracts features
    expected = state.get("q_networks", called)
    if state["_parameters"] or called != expected or len(called) != len(mlps):
        raise TypeError(f"a {type(network).__name__} has other modules than those that it calls")
    check_one_mode(mlps)
    return [parameter for mlp in mlps for parameter in mlp.parameters]


def check_one_mode(mlps: list[MLP]) -> None:
    """Refuse MLPs that compute something else in training mode.

    :param mlps: the MLPs.
    :raises TypeError: if there is batch renormalization in one.
    """
    if any(mlp.renormalizations for mlp in mlps):
        raise TypeError("there is batch renormalization, which has two modes")


def check_used_once(mlps: list[MLP]) -> None:
    """Refuse MLPs whose gradients must be added up, which :meth:`MLP.backward` does not do.

    :param mlps: all that are trained.
    :raises TypeError: if a parameter is in two layers or in two of the MLPs.
    """
    used = [id(parameter) for mlp in mlps for parameter in mlp.parameters]
    if len({*used}) != len(used):
        raise TypeError("a parameter is used twice")


def all_parameters(network: Any) -> list[th.Tensor]:
    """The parameters of an actor that samples, or of a critic.

    :param network: the actor or critic, of which :func:`actor_mlp` or :func:`critic_mlps` can be made.
    :return: in the order of ``network.parameters()``.
    :raises TypeError: if the network has parameters that it does not use.
    """
    state = vars(network)
    _, *called = state["_modules"].values()  # the first extracts features
    expected = state.get("q_networks")
    if expected is None:
        expected = [network.latent_pi, network.mu, network.log_std]
    if state["_parameters"] or called != expected:
        raise TypeError(f"a {type(network).__name__} has other modules than those that it calls")
    return list(network.parameters())


def check_trained(optimizer: Any, parameters: list[th.Tensor]) -> None:
    """Refuse to train a network that needs more than plain Adam steps on its gradients.

    :param optimizer: that of the actor or critic.
    :param parameters: its parameters.
    :raises TypeError: says why.
    """
    if type(optimizer) is not th.optim.Adam or len(optimizer.param_groups) != 1:
        raise TypeError(
            f"the optimizer is {type(optimizer).__name__}, not Adam with a single group of parameters"
        )
    if (
        optimizer._optimizer_step_pre_hooks
        or optimizer._optimizer_step_post_hooks
        or torch_optimizer._global_optimizer_pre_hooks
        or torch_optimizer._global_optimizer_post_hooks
    ):
        raise TypeError("an optimizer has hooks")
    if not _METHODS[th.optim.Adam].isdisjoint(vars(optimizer)):
        raise TypeError("a method of an optimizer was replaced")
    group = optimizer.param_groups[0]
    if [*map(id, group["params"])] != [*map(id, parameters)]:
        raise TypeError("an optimizer does not hold the parameters of its network")
    if group["differentiable"] or group["capturable"]:
        raise TypeError("Adam is differentiable or capturable")
    for parameter in parameters:
        if not parameter.requires_grad:
            raise TypeError("parameters are frozen")
        if parameter._backward_hooks or parameter._post_accumulate_grad_hooks:
            raise TypeError("parameters have hooks")
