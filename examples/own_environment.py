"""Search in an environment of your own: copy its state, check that the copy is exact, then train.

python examples/own_environment.py --steps 3000
"""

import argparse

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env

from sb3_mcbs import MCBSSAC, SnapshotEnvWrapper


class Docking(gym.Env):
    """Stop a cart at the origin, in a wind that every episode draws anew."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)  # draw from self.np_random: it is part of the state
        self.state = self.np_random.uniform(-1, 1, 3) * (1.0, 0.0, 0.3)  # position, speed, wind
        return self.state.astype(np.float32), {}

    def step(self, action):
        self.state[1] += 0.1 * (float(action[0]) + self.state[2])
        self.state[0] += 0.1 * self.state[1]
        return self.state.astype(np.float32), -(self.state[0] ** 2), False, False, {}


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--steps", type=int, default=3_000)
steps = parser.parse_args().steps

SnapshotEnvWrapper(Docking()).verify()  # raises an error that names the first difference
vec_env = make_vec_env(lambda: gym.wrappers.TimeLimit(Docking(), 50))
model = MCBSSAC("MlpPolicy", vec_env, preset="efficient", learning_starts=steps // 3, seed=0, verbose=1)
model.learn(steps)
