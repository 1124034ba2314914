"""Policy settings that cannot be inferred from tensors, such as the activation function."""

import re
import sys
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn

from sb3_mcbs.loading.agent_file import is_pickled
from sb3_mcbs.loading.architecture import Architecture
from sb3_mcbs.loading.archive import AgentFileError

#: Activation functions by the text that SB3 writes beside a pickled class.
ACTIVATIONS: dict[str, type[nn.Module]] = {
    str(cls): cls
    for cls in (
        nn.ReLU, nn.Tanh, nn.ELU, nn.GELU, nn.LeakyReLU, nn.Mish, nn.SELU, nn.Sigmoid, nn.SiLU, nn.Softplus
    )
}  # fmt: skip

#: Arguments of SB3's policies. Most are inferred from tensors or have no effect on acting.
_ARGUMENTS = {
    "net_arch", "n_critics", "n_quantiles", "use_sde", "log_std_init", "share_features_extractor",
    "normalize_images", "optimizer_class", "optimizer_kwargs", "features_extractor_kwargs", "device",
    "activation_fn", "clip_mean", "use_expln", "features_extractor_class", "batch_norm", "batch_norm_eps",
    "batch_norm_momentum", "renorm_warmup_steps",
}  # fmt: skip

_POLICIES = {
    "stable_baselines3.td3.policies": "TD3Policy",
    "stable_baselines3.sac.policies": "SACPolicy",
    "sb3_contrib.tqc.policies": "TQCPolicy",
    "sb3_contrib.crossq.policies": "CrossQPolicy",
}

_SAY_IT = "Pass policy_kwargs= as it was trained with, for example policy_kwargs=dict(activation_fn=nn.ReLU)."


def is_number(value: Any) -> bool:
    """Whether a value of the JSON is a number that fits into a float; JSON integers have no bound."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def network_settings(
    data: Mapping[str, Any], architecture: Architecture, policy_kwargs: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Arguments for the policy's constructor.

    :param data: the file's JSON entries; its readable copy of ``policy_kwargs`` is used, never the pickle.
    :param architecture: inferred from the tensors.
    :param policy_kwargs: given by the caller; then those of the file are ignored.
    :return: arguments of SB3's policy classes.
    :raises AgentFileError: if a value in the file is out of range.
    :raises ValueError: if the file lacks a setting, or the policy is not a plain MlpPolicy.
    """
    given = _readable_copy(data) if policy_kwargs is None else dict(policy_kwargs)
    unknown = sorted(str(name)[:40] for name in given.keys() - _ARGUMENTS)
    if unknown:
        raise ValueError(f"The policy has arguments that SB3's MlpPolicy does not have: {unknown}. {_SAY_IT}")
    extractor = given.get("features_extractor_class", FlattenExtractor)
    if extractor not in (FlattenExtractor, str(FlattenExtractor)):
        raise ValueError(
            f"The policy extracts features with {str(extractor)[:80]!r}; only agents with an MlpPolicy and "
            "without a features extractor of their own can be read."
        )
    settings = {
        "net_arch": {"pi": architecture.actor, "qf": architecture.critic},
        "n_critics": architecture.n_critics,
        "activation_fn": _activation(given),
    }
    if not architecture.has_targets:
        settings |= {"batch_norm": architecture.normalizes, "batch_norm_eps": _normalization_eps(given)}
    return settings | (_sde_settings(given, architecture) if architecture.use_sde else {})


def _readable_copy(data: Mapping[str, Any]) -> dict[str, Any]:
    """The file's ``policy_kwargs`` if they are complete; otherwise an error asks for them."""
    given, policy = data.get("policy_kwargs"), data.get("policy_class")
    policy = policy if isinstance(policy, dict) else {}
    # A custom policy class may have other defaults than SB3's.
    name = _POLICIES.get(str(policy.get("__module__")))
    if name is None or not re.match(rf"<function {name}\.__init__ at ", str(policy.get("__init__"))):
        raise ValueError(f"The file does not say that the policy is SB3's own MlpPolicy. {_SAY_IT}")
    if not isinstance(given, dict) or (is_pickled(given) and given.get(":type:") != str(dict)):
        raise ValueError(f"The file has no readable policy_kwargs. {_SAY_IT}")
    copy = {key: value for key, value in given.items() if key not in (":type:", ":serialized:")}
    if is_pickled(given) and not copy:
        raise ValueError(f"The file has its policy_kwargs only as a pickle. {_SAY_IT}")
    return copy


def _activation(given: Mapping[str, Any]) -> type[nn.Module]:
    # SB3 writes every argument that was given, so a missing one has SB3's default.
    activation = given.get("activation_fn", nn.ReLU)
    if isinstance(activation, type) and issubclass(activation, nn.Module):
        return activation
    if not isinstance(activation, str) or activation not in ACTIVATIONS:
        raise ValueError(
            f"The activation function {str(activation)[:80]!r} is not one that is known. {_SAY_IT}"
        )
    return ACTIVATIONS[activation]


def _normalization_eps(given: Mapping[str, Any]) -> float:
    eps = given.get("batch_norm_eps", 0.001)
    if not is_number(eps) or eps <= 0:
        raise AgentFileError(f"batch_norm_eps must be a number above 0, got {str(eps)[:80]!r}.")
    return eps


def _sde_settings(given: Mapping[str, Any], architecture: Architecture) -> dict[str, Any]:
    use_expln = given.get("use_expln", False)
    if not isinstance(use_expln, bool):
        raise AgentFileError(f"use_expln must be True or False, got {str(use_expln)[:80]!r}.")
    if not architecture.clips_mean:
        return {"use_expln": use_expln, "clip_mean": 0.0}
    clip_mean = given.get("clip_mean", 2.0)
    if not is_number(clip_mean) or clip_mean <= 0:
        raise AgentFileError(f"clip_mean must be a number above 0, got {str(clip_mean)[:80]!r}.")
    return {"use_expln": use_expln, "clip_mean": clip_mean}
