"""Infers the networks of an SB3 policy from the names and shapes of its parameters."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim, get_flattened_obs_dim, is_image_space

from sb3_mcbs.loading.archive import AgentFileError

Shape = tuple[int, ...]

_USE_SB3 = "If you trust its author, use the load method of the SB3 algorithm: it runs code from the file."


@dataclass(frozen=True)
class Architecture:
    """Sizes of multi-layer perceptrons.

    :param stochastic: whether the actor has a standard deviation (SAC, TQC, CrossQ).
    :param actor: the actor's hidden layers.
    :param critic: each critic's hidden layers.
    :param n_critics: how many critics there are.
    :param n_outputs: a critic's outputs; with several they are quantiles (TQC).
    :param use_sde: whether the exploration depends on the state (gSDE).
    :param clips_mean: whether the actor clips its mean before squashing it; only with gSDE.
    :param has_targets: whether there are target networks (all but CrossQ).
    :param normalizes: whether layers' inputs are normalized over batches; only of CrossQ.
    """

    stochastic: bool
    actor: list[int]
    critic: list[int]
    n_critics: int
    n_outputs: int
    use_sde: bool
    clips_mean: bool
    has_targets: bool
    normalizes: bool


def check_spaces(observation_space: spaces.Space, action_space: spaces.Space) -> None:
    """Refuse an environment that an MLP agent cannot act in.

    :param observation_space: its observations.
    :param action_space: its actions.
    :raises ValueError: if observations are images, a Dict or a Tuple, or actions are not a Box.
    """
    if isinstance(observation_space, spaces.Dict | spaces.Tuple) or is_image_space(observation_space):
        raise ValueError(
            "load_agent reads agents with an MlpPolicy, whose observations are vectors; the environment's "
            f"are {observation_space}. {_USE_SB3}"
        )
    if not isinstance(action_space, spaces.Box):
        raise ValueError(f"The agent needs continuous (Box) actions, the environment has {action_space}.")


def read_architecture(
    shapes: Mapping[str, Shape], observation_space: spaces.Space, action_space: Any
) -> Architecture:
    """Infer the architecture, and check that every parameter fits it and the environment.

    :param shapes: the file's shapes by name.
    :param observation_space: the environment's observations.
    :param action_space: the environment's actions.
    :return: the architecture.
    :raises AgentFileError: if the parameters are not those of an actor and critics that are MLPs, or if one
        is missing, left over or of another shape.
    """
    architecture = _infer(shapes)
    n_features, n_actions = get_flattened_obs_dim(observation_space), get_action_dim(action_space)
    expected = _expected_shapes(architecture, n_features, n_actions)
    for name in sorted(expected.keys() | shapes.keys()):
        if name not in shapes:
            raise AgentFileError(f"The policy's tensor {name!r} is missing, the file is not complete.")
        if name not in expected:
            raise AgentFileError(
                f"The policy has a tensor {name[:80]!r} that SB3's MlpPolicy does not have. {_USE_SB3}"
            )
        if shapes[name] != expected[name]:
            raise AgentFileError(
                f"Tensor {name!r} has the shape {shapes[name]}, but {expected[name]} is needed: for the "
                f"environment's observations {observation_space.shape} and actions {action_space.shape}, and "
                "for the layers beside it. Is it the environment that the agent was trained in?"
            )
    return architecture


def _infer(shapes: Mapping[str, Shape]) -> Architecture:
    """Infer the architecture from names and output sizes, which may contradict other shapes."""
    for name in shapes:
        if "features_extractor" in name:
            raise AgentFileError(
                f"The policy extracts features ({name[:80]!r}), as CnnPolicy and MultiInputPolicy do; only "
                f"the networks of an MlpPolicy can be inferred from a file's tensors. {_USE_SB3}"
            )
    stochastic = any(name.startswith("actor.log_std") for name in shapes)
    normalizes = "critic.qf0.0.ra_mean" in shapes
    actor = _widths(shapes, "actor.latent_pi" if stochastic else "actor.mu", normalizes)
    critic = _widths(shapes, "critic.qf0", normalizes)
    if not critic or not (actor or stochastic):
        raise AgentFileError(
            "The policy's tensors are not those of a TD3, DDPG, SAC, TQC or CrossQ agent: these have "
            f"'actor.*' and 'critic.qf0.*'; the file has {str(sorted(shapes)[:4])[:200]}."
        )
    first = int(normalizes)
    critic_indices = itertools.takewhile(
        lambda i: f"critic.qf{i}.{first}.weight" in shapes, itertools.count()
    )
    targets = any(name.startswith("critic_target.") for name in shapes)
    is_crossq = normalizes or (stochastic and critic[-1] == 1 and not targets)
    return Architecture(
        stochastic=stochastic,
        actor=actor if stochastic else actor[:-1],
        critic=critic[:-1],
        n_critics=len(list(critic_indices)),
        n_outputs=critic[-1],
        use_sde="actor.log_std" in shapes,
        clips_mean="actor.mu.0.weight" in shapes,
        has_targets=not is_crossq,
        normalizes=normalizes,
    )


def _widths(shapes: Mapping[str, Shape], prefix: str, normalizes: bool) -> list[int]:
    indices = itertools.count(1, 3) if normalizes else itertools.count(0, 2)
    weights = (shapes.get(f"{prefix}.{index}.weight") for index in indices)
    return [shape[0] for shape in itertools.takewhile(bool, weights) if shape]


def _expected_shapes(architecture: Architecture, n_features: int, n_actions: int) -> dict[str, Shape]:
    """The shapes of all parameters that an SB3 policy of this architecture has, by name."""
    shapes: dict[str, Shape] = {}
    normalizes = architecture.normalizes
    if architecture.stochastic:
        latent = [n_features, *architecture.actor]
        last = (latent[-1], n_actions)
        shapes |= _layers("actor.latent_pi", latent, normalizes)
        if normalizes and architecture.actor:
            shapes |= _normalization(f"actor.latent_pi.{3 * len(architecture.actor)}", latent[-1])
        if architecture.use_sde:
            mean = "actor.mu.0" if architecture.clips_mean else "actor.mu"
            shapes |= _linear(mean, *last) | {"actor.log_std": last}
        else:
            shapes |= _linear("actor.mu", *last) | _linear("actor.log_std", *last)
    else:
        for actor in ("actor", "actor_target"):
            shapes |= _layers(f"{actor}.mu", [n_features, *architecture.actor, n_actions])
    critic = [n_features + n_actions, *architecture.critic, architecture.n_outputs]
    critics = ("critic", "critic_target") if architecture.has_targets else ("critic",)
    for name, index in itertools.product(critics, range(architecture.n_critics)):
        shapes |= _layers(f"{name}.qf{index}", critic, normalizes)
    return shapes


def _linear(name: str, n_inputs: int, n_outputs: int) -> dict[str, Shape]:
    return {f"{name}.weight": (n_outputs, n_inputs), f"{name}.bias": (n_outputs,)}


def _normalization(name: str, n: int) -> dict[str, Shape]:
    parts = ("scale", "bias", "ra_mean", "ra_var")
    return {f"{name}.steps": (), **{f"{name}.{part}": (n,) for part in parts}}


def _layers(prefix: str, widths: list[int], normalizes: bool = False) -> dict[str, Shape]:
    shapes: dict[str, Shape] = {}
    for index, (n_inputs, n_outputs) in enumerate(itertools.pairwise(widths)):
        # The last module of every layer is an activation function, which has no parameters.
        if normalizes:
            shapes |= _normalization(f"{prefix}.{3 * index}", n_inputs)
            shapes |= _linear(f"{prefix}.{3 * index + 1}", n_inputs, n_outputs)
        else:
            shapes |= _linear(f"{prefix}.{2 * index}", n_inputs, n_outputs)
    return shapes
