"""Observations that are not of the space's dtype, or no arrays: predicted as SB3 stores them."""

import itertools
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_mcbs import SnapshotEnvWrapper


class Careless(gym.Env):
    """Returns observations of another form than its space says.

    :param form: "float64", "list", "tuple", "dict" of a float64 array and a list, or "integers".
    """

    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self, form: str) -> None:
        self.form, box = form, spaces.Box(-9, 9, (3,), np.float32)
        self.observation_space = box
        if form == "dict":
            self.observation_space = spaces.Dict({"all": box, "some": spaces.Box(-9, 9, (2,), np.float32)})
        if form == "integers":
            self.observation_space = spaces.Box(-1000, 1000, (3,), np.int32)

    def observe(self):
        forms = {
            "float64": self.x.copy(),
            "list": self.x.tolist(),
            "tuple": tuple(self.x.tolist()),
            "dict": {"all": self.x.copy(), "some": self.x[:2].tolist()},
            "integers": (100 * self.x).astype(np.int64),
        }
        return forms[self.form]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.age = self.np_random.uniform(-1, 1, 3), 0
        return self.observe(), {}

    def step(self, action):
        self.age += 1
        self.x = 0.9 * self.x + 0.1 * float(action[0])
        return self.observe(), -float(self.x @ self.x), False, self.age >= 12, {}


CASES = [
    *itertools.product(
        ["float64", "list", "tuple", "dict", "integers"], [DummyVecEnv, SubprocVecEnv], [False]
    ),
    ("float64", DummyVecEnv, True),
    ("list", SubprocVecEnv, True),
]


@pytest.mark.parametrize("form, vec_env_cls, normalized", CASES)
def test_nothing_seems_to_differ(make_agent, form, vec_env_cls, normalized) -> None:
    settings = {"start_method": "fork"} if vec_env_cls is SubprocVecEnv else {}
    vec_env = vec_env_cls([lambda: SnapshotEnvWrapper(Monitor(Careless(form)))] * 2, **settings)
    vec_env = VecNormalize(vec_env) if normalized else vec_env
    agent = make_agent(vec_env, policy="MultiInputPolicy" if form == "dict" else "MlpPolicy")
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # as "differs from reality" would be one
        agent.learn(80)
    assert agent.n_decisions == 60 and agent.planner.model.deterministic
    assert agent.replay_buffer.timeouts[:40].sum() == 6, "ends of episodes were among them"
    vec_env.close()
