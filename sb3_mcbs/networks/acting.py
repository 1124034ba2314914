"""TD3's actor as a CUDA graph: the step of the environment waits for its actions."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.td3.policies import TD3Policy

from sb3_mcbs.networks.batches import Staging
from sb3_mcbs.networks.graphs import Graphs
from sb3_mcbs.networks.plain_networks import actor_mlp

#: What SB3's ``predict`` calls; a user may replace it.
_CALLED = [
    (owner, name, getattr(owner, name))
    for owner, name in (
        (BasePolicy, "predict"),
        (BasePolicy, "obs_to_tensor"),
        (TD3Policy, "forward"),
        (TD3Policy, "_predict"),
    )
]


class Acting:
    """The captured actors of an agent, one for each number of observations."""

    def __init__(self) -> None:
        self.graphs = Graphs()
        self._memory: dict[int, tuple[Staging, th.Tensor, th.Tensor]] = {}

    def actions(self, policy: Any, observations: Any) -> np.ndarray | None:
        """What SB3's ``policy.predict`` returns.

        :param policy: the agent's policy.
        :param observations: any.
        :return: actions of the environment ``[rows, *act_shape]``. None if this policy or these observations
            are not covered.
        """
        shape = policy.observation_space.shape
        if not isinstance(observations, np.ndarray) or not shape or observations.shape[1:] != shape:
            return None
        called = {name for _, name, _ in _CALLED}
        is_sb3s = isinstance(policy, TD3Policy) and called.isdisjoint(vars(policy))
        if not is_sb3s or any(getattr(type(policy), name) is not function for _, name, function in _CALLED):
            return None
        try:
            mlp = actor_mlp(policy.actor)
        except TypeError:
            return None
        n_rows = len(observations)
        if n_rows not in self._memory:
            self._memory[n_rows] = self._make_memory(n_rows, policy)
        staging, inputs, outputs = self._memory[n_rows]
        staging.numbers(inputs.numel()).reshape(inputs.shape)[...] = observations.reshape(n_rows, -1)
        staging.send(inputs)
        with th.no_grad():
            self.graphs.follow((mlp.signature, th.get_float32_matmul_precision()), mlp)
            self.graphs.run(n_rows, lambda: outputs.copy_(mlp(inputs.t()).t()), inputs.device)
        found = outputs.cpu().numpy().reshape(-1, *policy.action_space.shape)
        actions: np.ndarray = policy.unscale_action(found)
        return actions

    @staticmethod
    def _make_memory(n_rows: int, policy: Any) -> tuple[Staging, th.Tensor, th.Tensor]:
        n_obs = int(np.prod(policy.observation_space.shape))
        n_act = int(np.prod(policy.action_space.shape))
        device = policy.device
        inputs = th.empty((n_rows, n_obs), device=device)
        return Staging(inputs.numel(), device), inputs, th.empty((n_rows, n_act), device=device)
