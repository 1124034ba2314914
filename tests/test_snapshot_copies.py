"""Deep copies and pickles of wrapped environments: in the same state, and on their own."""

import copy
import pickle

import cloudpickle
import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import NormalizeObservation, TransformReward
from stable_baselines3.common.monitor import Monitor

from sb3_mcbs.snapshot import ReplayAdapter, SnapshotEnvWrapper, SnapshotUnsupportedError, register_adapter
from tests.test_snapshot_graph import Small

WAYS = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "cloudpickle": lambda env: cloudpickle.loads(cloudpickle.dumps(env)),
}


def follow(env, actions):
    return [(step[0].tobytes(), *step[1:4]) for step in map(env.step, actions)]


def assert_exact_and_independent(env, made, actions):
    """Check that a copy does what the original does, whichever of them is stepped first."""
    state, own = env.snapshot(), made.snapshot()
    clone = made.clone()
    expected = follow(env, actions)
    for target in (made, clone):
        assert follow(target, actions) == expected
    for target, its in ((made, state), (made, own), (env, own), (clone, own)):
        target.restore(its)
        assert follow(target, actions) == expected
    env.restore(own)
    made.restore(own)
    follow(env, actions[:1])
    assert follow(made, actions) == expected, "the original was stepped"


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", ["Ant-v5", "InvertedPendulum-v5", "Pendulum-v1", "BipedalWalker-v3"])
@pytest.mark.filterwarnings("ignore:The simulator of BipedalWalker")
def test_copies_in_the_middle_of_an_episode(name, way):
    env = SnapshotEnvWrapper(NormalizeObservation(Monitor(gym.make(name, max_episode_steps=99))))
    fresh = WAYS[way](env)
    env.action_space.seed(0)
    actions = [0.1 * env.action_space.sample() for _ in range(6)]
    for target in (env, fresh):
        target.reset(seed=0)
    assert follow(fresh, actions[:2]) == follow(env, actions[:2])
    made = WAYS[way](env)
    assert made.unwrapped is not env.unwrapped and made.env.env.rewards == env.env.env.rewards
    assert np.array_equal(made.last_observation, env.last_observation)
    start = env.snapshot()
    assert_exact_and_independent(env, made, actions)
    for each in (env, fresh):
        each.restore(start)
    assert_exact_and_independent(env, fresh, actions)


class Cheetah(gym.Env):
    """Holds a simulator and a view into it, and does not say how it was made."""

    observation_space = spaces.Box(-np.inf, np.inf, (9,), np.float64)
    action_space = spaces.Box(-1, 1, (6,), np.float64)

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_path(gym.make("HalfCheetah-v5").unwrapped.fullpath)
        self.data = mujoco.MjData(self.model)
        self.view = self.data.qpos

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        return self.view.copy(), {}

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, 5)
        return self.view.copy(), float(self.view[0]), False, False, {}


@pytest.mark.parametrize("way", WAYS)
def test_copies_of_simulators_and_views(way):
    env = SnapshotEnvWrapper(Cheetah())
    env.reset(seed=0)
    actions = [np.full(6, value) for value in (0.5, -0.5, 0.9)]
    follow(env, actions[:2])
    assert_exact_and_independent(env, WAYS[way](env), actions)


def test_deep_copies_share_no_functions():
    count = [0.0]

    def counted(reward):
        count[0] += 1.0
        return reward + count[0]

    env = SnapshotEnvWrapper(TransformReward(gym.make("Pendulum-v1"), counted))
    env.reset(seed=0)
    actions = [np.ones(1, np.float32)] * 3
    follow(env, actions)
    assert_exact_and_independent(env, copy.deepcopy(env), actions)
    assert (
        env.env.func is counted
        and counted.__closure__[0].cell_contents is env.env.func.__closure__[0].cell_contents
    )


@pytest.mark.parametrize("stepped", [False, True])
def test_an_episode_that_was_not_recorded(own_adapters, stepped):
    """It began before the environment was wrapped, so that nobody can repeat it."""

    class Steady(Small):
        pass

    register_adapter(lambda obj: isinstance(obj, Steady), ReplayAdapter())
    inner = Steady()
    inner.reset()
    env = SnapshotEnvWrapper(inner, verify=False)
    if stepped:
        env.step(np.zeros(1))
        with pytest.raises(SnapshotUnsupportedError, match="before the environment was wrapped"):
            env.snapshot()
    else:
        env.restore(env.snapshot())
        with pytest.raises(SnapshotUnsupportedError, match="before the environment was wrapped"):
            env.step(np.zeros(1))
    env.reset()
    state = env.snapshot()
    env.step(np.zeros(1))
    env.restore(state)
    assert float(env.step(np.zeros(1))[0][0]) == 1
