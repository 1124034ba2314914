"""Copies are made without SB3's Monitor and without recorders, but with what others have set on those."""

import functools
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import RenderCollection
from rl_zoo3.wrappers import HistoryWrapper
from sb3_contrib.common.wrappers import TimeFeatureWrapper
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_mcbs import MCBSTD3
from sb3_mcbs.models.environments import LocalEnvironments
from sb3_mcbs.models.factory import make_forward_model
from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotMismatchError, SnapshotUnsupportedError
from sb3_mcbs.types import ForwardModelError


def doubled(step, action):
    observation, reward, *rest = step(action)
    return observation, 2 * reward, *rest


class Partial(gym.Wrapper):
    def __init__(self, env):
        super().__init__(env)
        self.env.step = functools.partial(doubled, env.step)


class Closure(gym.Wrapper):
    """Has the Monitor's own method called by a function in its place."""

    def __init__(self, env):
        super().__init__(env)
        plain, n_steps = env.step, [0]

        def step(action):
            n_steps[0] += 1
            observation, reward, *rest = plain(action)
            return observation, reward + n_steps[0], *rest

        env.step = step


class OwnMethod(gym.Wrapper):
    def __init__(self, env):
        super().__init__(env)
        self.n_steps, self.inner = 0, env
        env.step = self.counted

    def step(self, action):
        return self.inner.step(action)

    def counted(self, action):
        self.n_steps += 1
        observation, reward, *rest = type(self.env).step(self.env, action)
        return observation, reward * self.n_steps, *rest


class Attribute(gym.Wrapper):
    def __init__(self, env):
        super().__init__(env)
        self.monitor, self.env.gain, self.env.render = env, 1.0, lambda: None

    def step(self, action):
        self.env.gain += 1.0
        observation, reward, *rest = self.monitor.step(action)
        return observation, self.monitor.gain * reward, *rest


class Counting(Monitor):
    def __init__(self, env):
        super().__init__(env)
        self.n_steps = 0

    def step(self, action):
        self.n_steps += 1
        observation, reward, *rest = super().step(action)
        return observation, reward + self.n_steps, *rest


class Reading(gym.Wrapper):
    def step(self, action):
        observation, reward, *rest = self.env.step(action)
        return observation, reward + len(self.env.rewards), *rest


def follow(env, actions):
    return [(step[0].tobytes(), *step[1:4]) for step in map(env.step, actions)]


def monitor_of(env):
    while not isinstance(env, Monitor):
        env = env.env
    return env


SETTING = [TimeFeatureWrapper, HistoryWrapper, Partial, Closure, OwnMethod, Attribute, Counting]


@pytest.mark.parametrize("wrapper", SETTING)
@pytest.mark.parametrize("task", ["Pendulum-v1", "InvertedPendulum-v5"])
def test_what_others_set_on_a_monitor(wrapper, task, tmp_path):
    made = [make_vec_env(task, wrapper_class=wrapper, monitor_dir=str(tmp_path / place)) for place in "ab"]
    env, other = (SnapshotEnvWrapper(vec_env.envs[0]) for vec_env in made)
    monitor, files = monitor_of(env), sorted(tmp_path.rglob("*.csv"))
    written = [file.read_bytes() for file in files]
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [0.1 * env.action_space.sample() for _ in range(6)]
    follow(env, actions[:2])
    state, for_clones, clone = env.snapshot(), env.snapshot(monitor=False), env.clone()
    assert clone.observation_space == env.observation_space
    assert type(monitor) in (Monitor, Counting) and len(monitor.rewards) == 2, "the check left it alone"
    expected = follow(env, actions)
    assert follow(clone, actions) == expected
    assert follow(clone.clone(), actions) != expected and len(monitor.rewards) == 8
    for target, its in ((clone, state), (clone, for_clones), (env, state), (other, state)):
        target.restore(pickle.loads(pickle.dumps(its)) if wrapper is not Closure else its)
        assert follow(target, actions) == expected
    clone.restore(for_clones)
    assert follow(clone.clone(), actions) == expected
    assert [file.read_bytes() for file in files] == written, "no copy writes"


def test_what_others_set_on_a_recorder():
    env = gym.make("Pendulum-v1", render_mode="rgb_array")
    env = SnapshotEnvWrapper(Attribute(TimeFeatureWrapper(RenderCollection(env))))
    env.reset(seed=0)
    frames = len(env.env.env.env.frame_list)
    actions = [env.action_space.sample() for _ in range(4)]
    state, clone = env.snapshot(), env.clone()
    assert len(env.env.env.env.frame_list) == frames, "the check draws nothing"
    expected = follow(env, actions)
    assert clone.observation_space == env.observation_space and follow(clone, actions) == expected
    for target in (env, clone):
        target.restore(state)
        assert follow(target, actions) == expected
    plain = SnapshotEnvWrapper(Attribute(TimeFeatureWrapper(gym.make("Pendulum-v1"))))
    for target, source in ((plain, env), (env, plain)):
        with pytest.raises(SnapshotMismatchError, match=r"RenderCollection, .* have set _observation_space"):
            target.restore(source.snapshot())


def test_what_only_a_monitor_knows_is_missed_by_name():
    env = SnapshotEnvWrapper(Reading(Monitor(gym.make("Pendulum-v1"))))
    with pytest.raises(SnapshotUnsupportedError, match=r"without its Monitor.* no attribute 'rewards'"):
        env.verify()
    assert type(env.env.env) is Monitor


def test_stand_ins_can_be_pickled_and_copied_again():
    env = SnapshotEnvWrapper(TimeFeatureWrapper(Counting(gym.make("Pendulum-v1"))))
    env.reset(seed=0)
    clone = env.clone()
    expected = follow(env, [np.ones(1)] * 3)
    assert follow(pickle.loads(pickle.dumps(clone)), [np.ones(1)] * 3) == expected


def wrapped_for_snapshots(env):
    return SnapshotEnvWrapper(Attribute(TimeFeatureWrapper(env)))


@pytest.mark.parametrize("workers", [False, True])
def test_training(workers):
    vec_env = make_vec_env(
        "Pendulum-v1",
        seed=0,
        wrapper_class=wrapped_for_snapshots if workers else TimeFeatureWrapper,
        vec_env_cls=SubprocVecEnv if workers else None,
    )
    agent = MCBSTD3("MlpPolicy", vec_env, learning_starts=5, policy_kwargs=dict(net_arch=[8]), device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # as of rollouts that are all invalid
        agent.learn(30)
    vec_env.close()


def test_a_clone_is_recognised_as_its_original():
    """Its stand-in changes no more than the Monitor; where a method was replaced, neither is known."""
    env = SnapshotEnvWrapper(Monitor(gym.make("InvertedPendulum-v5")))
    make_forward_model(LocalEnvironments([env.clone()]), "mujoco")
    env.env.step = functools.partial(doubled, env.env.step)
    for each in (env, env.clone()):
        with pytest.raises(ForwardModelError, match=r"Monitor\.step was replaced"):
            make_forward_model(LocalEnvironments([each]), "mujoco")
