"""The usual way to search: one environment, ``set_state``, one step and one network call at a time.

This is what a reader of the paper writes first. ``set_state`` is not an exact snapshot (Walker2d leaves
the real course after it), which is one of the reasons for this package.
"""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.noise import ActionNoise


def usual_search(
    agent: TD3,
    real: Any,
    simulator: gym.Env,
    observation: np.ndarray,
    size: tuple[int, int, int],
    noise_scale: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Choose an action by Algorithm 1, line by line.

    :param agent: actor and critics.
    :param real: the unwrapped environment to act in.
    :param simulator: another environment of the same kind.
    :param observation: ``[*obs_shape]``, of the real environment.
    :param size: beam width, rollout depth, simulations per candidate.
    :param noise_scale: sigma_b.
    :param rng: of the search.
    :return: the scaled action ``[act_dim]``.
    """
    beam_width, depth, n_simulations = size

    def act(observation: np.ndarray) -> np.ndarray:
        with th.no_grad():
            action = agent.actor(th.as_tensor(observation[None])).numpy()[0]
        return np.clip(action + noise_scale * rng.standard_normal(action.shape), -1, 1).astype(np.float32)

    def rollout(action: np.ndarray) -> float:
        world: Any = simulator.unwrapped
        world.set_state(qpos, qvel)
        total, discount = 0.0, 1.0
        for _ in range(depth):
            observation, reward, terminated, _, _ = world.step(agent.policy.unscale_action(action))
            total += discount * float(reward)
            discount *= agent.gamma
            if terminated:
                return total
            action = act(observation)
        with th.no_grad():
            values = agent.critic(th.as_tensor(observation[None]), th.as_tensor(action[None]))
        return total + discount * min(float(value) for value in values)

    qpos, qvel = real.data.qpos.copy(), real.data.qvel.copy()
    candidates = [act(observation) for _ in range(beam_width)]
    means = [np.mean([rollout(candidate) for _ in range(n_simulations)]) for candidate in candidates]
    return candidates[int(np.argmax(means))]


class UsualMCBSTD3(TD3):
    """TD3 that searches the usual way, for comparison. One environment of this process.

    :param args: as for TD3.
    :param size: beam width, rollout depth, simulations per candidate.
    :param kwargs: as for TD3.
    """

    def __init__(self, *args: Any, size: tuple[int, int, int] = (6, 3, 5), **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        assert self.env is not None
        self.size = size
        self.real: Any = self.env.get_attr("unwrapped")[0]
        self.simulator = gym.make(self.real.spec.id)
        self.simulator.reset()
        self.search_rng = np.random.default_rng(self.seed)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        if self.num_timesteps < learning_starts:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        assert isinstance(self._last_obs, np.ndarray)
        scaled = usual_search(
            self, self.real, self.simulator, self._last_obs[0], self.size, 0.1, self.search_rng
        )[None]
        return self.policy.unscale_action(scaled), scaled
