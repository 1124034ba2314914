"""An agent's networks as ONNX files, for programs without torch and Stable-Baselines3."""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize
from torch import nn

from sb3_mcbs.agents.observation_pipeline import reward_normalizer
from sb3_mcbs.networks.functions import STOCHASTIC, check_agent


class _Graph(nn.Module):
    """What both files have in common: raw observations and actions of the environment.

    :param agent: the agent.
    :param normalizer: normalises its observations, or None.
    """

    low: th.Tensor
    half_range: th.Tensor
    mean: th.Tensor
    deviation: th.Tensor

    def __init__(self, agent: Any, normalizer: VecNormalize | None) -> None:
        super().__init__()
        self.stochastic, self.quantiles = isinstance(agent, STOCHASTIC), isinstance(agent, TQC)
        self.actor, self.critic = agent.policy.actor, agent.policy.critic
        low, high = agent.action_space.low, agent.action_space.high
        self.register_buffer("low", th.as_tensor(low, dtype=th.float32))
        self.register_buffer("half_range", th.as_tensor(0.5 * (high - low), dtype=th.float32))
        self.normalizer = normalizer if normalizer is not None and normalizer.norm_obs else None
        if self.normalizer is not None:
            statistics: Any = self.normalizer.obs_rms
            self.register_buffer("mean", th.as_tensor(statistics.mean))
            self.register_buffer("deviation", th.as_tensor(statistics.var + self.normalizer.epsilon).sqrt())

    def normalized(self, observation: th.Tensor) -> th.Tensor:
        if self.normalizer is None:
            return observation
        clip = self.normalizer.clip_obs
        # In double precision, as VecNormalize does.
        return ((observation.double() - self.mean) / self.deviation).clamp(-clip, clip).float()


class _Actor(_Graph):
    def forward(self, observation: th.Tensor) -> th.Tensor:
        inputs = self.normalized(observation)
        if self.stochastic:
            scaled = th.tanh(self.actor.get_action_dist_params(inputs)[0])
        else:
            scaled = self.actor(inputs)
        return (scaled.reshape(-1, *self.low.shape) + 1.0) * self.half_range + self.low


class _Critic(_Graph):
    def forward(self, observation: th.Tensor, action: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        scaled = ((action - self.low) / self.half_range - 1.0).flatten(1)
        estimates = self.critic(self.normalized(observation), scaled)
        if self.quantiles:
            each = estimates.mean(dim=2)
            return each.mean(dim=1), each
        each = th.cat(estimates, dim=1)
        return each.amin(dim=1), each


def export_onnx(
    agent: OffPolicyAlgorithm,
    path: str | Path,
    env: VecEnv | None = None,
    normalize_reward: bool | None = None,
) -> tuple[Path, Path]:
    """
    Write an agent's actor and critics as ONNX files.

    The actor has the input ``observation`` and the output ``action``, the critics the inputs ``observation``
    and ``action`` and the outputs ``value``, by which a search ranks, and ``values`` of each critic (of TQC:
    the mean of its quantiles). Arrays are float32, the first axis is any number of rows. Observations are
    those of the environment before ``VecNormalize``, actions are the environment's. The metadata of both
    files have ``algorithm``, ``gamma`` and ``reward_scale``: the critics' estimates are of rewards times
    ``reward_scale``.

    :param agent: a TD3, DDPG, SAC, TQC or CrossQ agent, or one that searched in training; also one from
        :func:`~sb3_mcbs.load_agent`
    :param path: of the actor, usually ``policy.onnx``; the critics go to ``policy-critics.onnx`` beside it
    :param env: the environment, whose ``VecNormalize`` becomes part of the files. None: the one that the
        agent was trained in
    :param normalize_reward: as for :class:`~sb3_mcbs.SearchPolicy`
    :return: both files
    :raises ImportError: if the extra ``onnx`` is not installed
    :raises ValueError: if the agent's observations are not a Box, or its actions are not a bounded Box
    :raises TypeError: if it is an agent of another kind
    """
    _check_installed()
    check_agent(agent)
    space = agent.observation_space
    if not isinstance(space, spaces.Box):
        raise ValueError(f"Only agents with observations that are a Box can be exported, not {space}.")
    env = env or agent.get_env()
    normalizer = None if env is None else unwrap_vec_normalize(env)
    scaling = None if env is None else reward_normalizer(agent.get_env(), env, normalize_reward)
    metadata = {
        "algorithm": type(agent).__name__,
        "gamma": repr(float(agent.gamma)),
        "reward_scale": repr(1.0 if scaling is None else _reward_scale(scaling)),
    }
    path = Path(path)
    critics = path.with_name(f"{path.stem}-critics{path.suffix}")
    observation = th.zeros(2, *space.shape)
    action = th.zeros(2, *(agent.action_space.shape or ()))
    _write(_Actor(agent, normalizer), {"observation": observation}, ["action"], path, metadata)
    arguments = {"observation": observation, "action": action}
    _write(_Critic(agent, normalizer), arguments, ["value", "values"], critics, metadata)
    return path, critics


def _reward_scale(normalizer: VecNormalize) -> float:
    return float(1.0 / np.sqrt(normalizer.ret_rms.var + normalizer.epsilon))


def _check_installed() -> None:
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f"Exporting needs onnx and onnxscript ({error}): pip install 'sb3-mcbs[onnx]'"
        ) from error


def _write(
    graph: nn.Module, inputs: dict[str, th.Tensor], outputs: list[str], path: Path, metadata: dict[str, str]
) -> None:
    device = next(graph.parameters()).device
    modes = {module: module.training for module in graph.modules()}  # the agent's own modules
    graph.to("cpu").eval()
    rows = th.export.Dim("rows")
    try:
        with _quietly():
            program: Any = th.onnx.export(
                graph,
                tuple(inputs.values()),
                dynamo=True,
                input_names=list(inputs),
                output_names=outputs,
                dynamic_shapes=tuple({0: rows} for _ in inputs),
                verbose=False,
            )
    finally:
        graph.to(device)
        for module, mode in modes.items():
            module.training = mode
    program.model.metadata_props.update(metadata)
    program.save(path, external_data=False)


@contextmanager
def _quietly() -> Iterator[None]:
    """Without torch's messages about its own deprecations, and about torchvision that is not installed."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
