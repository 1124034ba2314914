"""Attributes of layers: those that are set from outside, and those that an adapter leaves alone."""

import copy

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_mcbs.snapshot import ReplayAdapter, SnapshotEnvWrapper, register_adapter
from tests.test_snapshot_graph import Small
from tests.test_snapshot_state import Toy, Unseen, follow


def test_attributes_set_from_outside_are_those_of_the_layer_below():
    class Scaled(gym.Wrapper):
        scale = 1.0

        def step(self, action):
            observation, *rest = self.env.step(action)
            return observation * self.scale, *rest

    vec_env = DummyVecEnv([lambda: SnapshotEnvWrapper(Scaled(Toy()))])
    env = vec_env.envs[0]
    env.reset(seed=0)
    vec_env.set_attr("scale", 3.0)
    assert env.env.scale == 3.0 and "scale" not in vars(env)
    state = env.snapshot()
    expected = follow(env)
    vec_env.set_attr("scale", 5.0)
    clone = env.clone()
    assert clone.env.scale == 5.0
    for target in (env, clone):
        target.restore(state)
        assert target.env.scale == 3.0 and follow(target) == expected
    vec_env.set_attr("last_observation", None)  # one of its own
    assert env.last_observation is None and not hasattr(env.env, "last_observation")


class Named(ReplayAdapter):
    not_state = frozenset({"note"})


def test_attributes_that_a_replay_leaves_alone(own_adapters):
    register_adapter(lambda obj: isinstance(obj, Unseen), Named())
    env = SnapshotEnvWrapper(Unseen())
    env.unwrapped.note, env.unwrapped.mark = "before the reset", 1
    env.reset(seed=0)
    follow(env, 2)
    env.unwrapped.note, env.unwrapped.mark = "before the snapshot", 2
    with pytest.warns(UserWarning, match="Unseen"):
        state = env.snapshot()
    expected = follow(env)
    assert Named().not_state > ReplayAdapter.not_state, "what records an episode is never put back"
    for target in (env, SnapshotEnvWrapper(Unseen())):
        target.unwrapped.note, target.unwrapped.mark = "now", 3
        target.restore(state)
        assert (target.unwrapped.note, target.unwrapped.mark) == ("now", 2)
        assert follow(target) == expected


def test_a_deep_copy_records_for_itself(own_adapters):
    class Steady(Small):
        pass

    register_adapter(lambda obj: isinstance(obj, Steady), ReplayAdapter())
    env = SnapshotEnvWrapper(Steady(), verify=False)
    env.reset(seed=0)
    env.step(np.zeros(1))
    made = copy.deepcopy(env)
    assert [float(made.step(np.zeros(1))[0][0]) for _ in range(2)] == [2, 3]
    assert env.unwrapped.total == 1 and float(env.step(np.zeros(1))[0][0]) == 2
    for target, n_steps in ((env, 2), (made, 3)):
        assert len(target.snapshot().layers[0].adapted[0].actions) == n_steps


class Curriculum(gym.Wrapper):
    """Goes on with another environment at every third reset."""

    def __init__(self):
        super().__init__(Toy())
        self.n_resets = 0

    def reset(self, **kwargs):
        self.n_resets += 1
        if self.n_resets % 3 == 0:
            self.env = gym.wrappers.TimeLimit(Toy(), 50) if self.n_resets == 3 else Toy()
        return self.env.reset(**kwargs)


def test_a_wrapper_that_exchanges_what_it_wraps():
    env = SnapshotEnvWrapper(Curriculum())
    for seed in range(7):
        env.reset(seed=seed)
        follow(env, 2)
        state, clone = env.snapshot(), env.clone()
        assert len(state.layers) == (3 if 2 <= seed < 5 else 2)
        expected = follow(env)
        for target in (clone, env):
            target.restore(state)
            assert follow(target) == expected
