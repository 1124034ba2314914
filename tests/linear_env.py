"""A linear system that cannot be captured, for tests of the learned model."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

MATRIX = np.array([[0.9, 0.2], [-0.1, 0.8]])
PUSH = np.array([0.1, 0.4])


def linear_step(observations: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What happens next.

    :param observations: ``[n, 2]``.
    :param actions: ``[n, 1]``.
    :return: the next observations ``[n, 2]`` and rewards ``[n]``.
    """
    return observations @ MATRIX.T + actions * PUSH, observations[:, 0] - 0.1 * actions[:, 0] ** 2


class LinearEnv(gym.Env):
    """The system as an environment. It holds a generator at work, which no snapshot can capture.

    :param limit: it terminates where the first entry is above.
    :param length: steps of an episode; then it is truncated.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, limit: float = np.inf, length: int = 25) -> None:
        self.limit, self.length = limit, length
        self.real_robot = (signal for signal in (1, 2))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.steps = self.np_random.uniform(-1, 1, 2), 0
        return self.state.astype(np.float32), {}

    def step(self, action):
        following, rewards = linear_step(self.state[None], np.asarray(action, np.float64)[None])
        self.state, self.steps = following[0], self.steps + 1
        terminated = bool(abs(self.state[0]) > self.limit)
        return self.state.astype(np.float32), float(rewards[0]), terminated, self.steps >= self.length, {}
