"""Snapshots of environments that are not known are checked before they are relied on."""

import os
import random
import time
from collections import Counter

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation, NormalizeObservation, TimeLimit, TransformReward
from stable_baselines3.common.monitor import Monitor

from sb3_mcbs.snapshot import (
    SnapshotAdapter,
    SnapshotEnvWrapper,
    SnapshotUnsupportedError,
    register_adapter,
    verification,
)

#: How often the environments of a class were stepped and reset.
STEPS: Counter[type] = Counter()
WORLDS = {0: 0.0}
RNG = np.random.default_rng(0)


pytestmark = pytest.mark.usefixtures("nothing_has_passed")


class Walk(gym.Env):
    """Adds up its actions, and in one entry also what ``push`` returns."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = spaces.Box(-1, 1, (1,), np.float64)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.x, self.age, self.n_resets = np.zeros(3), 0, 0
        self.prepare()

    def prepare(self):
        pass

    def push(self):
        return 1.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.age, self.n_resets = self.np_random.normal(size=3), 0, self.n_resets + 1
        return self.x.copy(), {}

    def step(self, action):
        STEPS[type(self)] += 1
        self.age += 1
        self.x = self.x + np.sum(action)
        self.x[1] += self.push()
        return self.x.copy(), float(self.x[0]), False, False, {"time": time.time()}


def follow(env, n=6):
    action = np.full(env.action_space.shape, 0.25, env.action_space.dtype)
    results = [env.step(action)[:4] for _ in range(n)]
    return [(np.asarray(o).tobytes(), np.float64(r).tobytes(), *ends) for o, r, *ends in results]


# --- what passes -----------------------------------------------------------------------------------------


def test_a_wrapper_below_a_monitor():
    """SB3 puts a ``Monitor`` around an environment, and the agent then wraps it again."""
    env = SnapshotEnvWrapper(Monitor(SnapshotEnvWrapper(TimeLimit(Walk(), 50))))
    assert env.verify()
    layers = [env, env.env, env.env.env, env.env.env.env]
    assert [type(layer) for layer in layers] == [SnapshotEnvWrapper, Monitor, SnapshotEnvWrapper, TimeLimit]
    env.reset(seed=0)
    copy = env.clone()
    assert follow(copy) == follow(env)


class Noisy(Walk):
    def prepare(self):
        self.rngs = [random.Random(1), np.random.RandomState(2), {"deep": np.random.default_rng(3)}]

    def push(self):
        own = self.np_random.normal() + self.rngs[0].random() + self.rngs[1].uniform()
        return own + self.rngs[2]["deep"].normal()


class GlobalNoise(Walk):
    def prepare(self):
        self.draw = np.random.normal  # the method of a generator that belongs to the process
        self.draw_python = random.random

    def push(self):
        return self.draw() + self.draw_python() + np.random.uniform() + float(th.rand(1))


class Blind(Walk):
    def step(self, action):
        _, _, *rest = super().step(action)
        return np.full(3, np.nan), np.nan, *rest


class Short(Walk):
    def step(self, action):
        if self.age == 1:
            raise RuntimeError("the episode is over")
        return *super().step(action)[:2], True, False, {}


class Picky(Walk):
    """Takes one action in five."""

    def step(self, action):
        if abs(action[0]) > 0.2:
            raise ValueError("that is too much")
        return super().step(action)


class Mixed(Walk):
    observation_space = spaces.Dict({"a": spaces.Tuple((spaces.Discrete(99), spaces.Text(9)))})
    action_space = spaces.Discrete(3)

    def reset(self, **kwargs):
        super().reset(**kwargs)
        return {"a": (0, "")}, {}

    def step(self, action):
        _, *rest = super().step(action)
        return {"a": (self.age, "x" * self.age)}, *rest


class NoShape(Walk):
    action_space = spaces.Box(-1, 1, (), np.float32)


class Market(Walk):
    def prepare(self):
        self.prices, self.news = pd.DataFrame({"open": np.arange(50.0), "name": "a"}), iter([*range(99)])

    def push(self):
        self.prices["open"] = self.prices["open"] + 1
        return float(self.prices["open"].iloc[: self.age].sum()) + next(self.news)


STACKED = {
    "wrappers": lambda: TimeLimit(FrameStackObservation(NormalizeObservation(Noisy()), 3), 20),
    "a function": lambda: TransformReward(gym.make("Pendulum-v1"), lambda reward: 2 * reward),
}
EXACT = {
    cls.__name__: cls for cls in (Walk, Noisy, GlobalNoise, Blind, Short, Picky, Mixed, NoShape, Market)
} | STACKED


@pytest.mark.parametrize("name", EXACT)
def test_exact_environments_pass(name):
    STEPS.clear()
    env = SnapshotEnvWrapper(EXACT[name]())
    assert env.verify()
    assert name == "a function" or 0 < STEPS.total() < 90
    assert verification.has_passed(env._stack.layers)


# --- what is refused -------------------------------------------------------------------------------------


class Handle(Walk):
    """Its simulator is elsewhere, behind a number."""

    def reset(self, **kwargs):
        WORLDS[0] = 0.0
        return super().reset(**kwargs)

    def push(self):
        WORLDS[0] += 1
        return WORLDS[0]


class ClassCounter(Walk):
    count = 0

    def push(self):
        type(self).count += 1
        return self.count


class Entropy(Walk):
    def push(self):
        return os.urandom(1)[0] / 256


class ModuleGenerator(Walk):
    def push(self):
        return RNG.normal()


class Clock(Walk):
    def push(self):
        return time.perf_counter()


@pytest.mark.parametrize("cls", [Handle, ClassCounter, Entropy, ModuleGenerator, Clock])
def test_what_cannot_be_seen_is_found(cls):
    env = SnapshotEnvWrapper(cls())
    env.reset(seed=3)
    what = rf"After a restore step \d of {cls.__name__} gave observation\[1\] = \S+ instead of \S+\. "
    with pytest.raises(SnapshotUnsupportedError, match=what) as error:
        env.snapshot()
    for way_out in ("register_adapter", "ReplayAdapter()", "'ensemble'", "rollout_depth=0", "verify=False"):
        assert way_out in str(error.value)
    # Only the first always does the same from the same seed, so that it could be replayed.
    assert ("does not repeat itself after two resets" in str(error.value)) == (cls is not Handle)


class Late(Handle):
    def push(self):
        return super().push() if self.age > 15 else 0.0


def test_what_matters_only_later_is_found_too():
    with pytest.raises(SnapshotUnsupportedError, match="After a restore farther from the reset step"):
        SnapshotEnvWrapper(Late()).verify()


def test_what_differs_is_named():
    class Keyed(Handle):
        observation_space = spaces.Dict({"here": spaces.Box(-9, 9, (2, 2))})

        def step(self, action):
            _, *rest = super().step(action)
            return {"here": np.full((2, 2), [[0, 0], [WORLDS[0], 0]])}, *rest

    class Paid(Handle):
        def step(self, action):
            _, _, *rest = super().step(action)
            return np.zeros(3), WORLDS[0], *rest

    class Fails(Handle):
        def step(self, action):
            super().step(action)
            if WORLDS[0] > 13:
                raise ZeroDivisionError("the gear broke")
            return np.zeros(3), 0.0, False, False, {}

    for cls, what in (
        (Keyed, r"observation\['here'\]\[1, 0\] = 12\.0 instead of 4\.0"),
        (Paid, r"gave reward = 12\.0 instead of 4\.0"),
        (Fails, r"step 3 of Fails raised ZeroDivisionError: the gear broke"),
    ):
        with pytest.raises(SnapshotUnsupportedError, match=what):
            SnapshotEnvWrapper(cls()).verify()


class Tank:
    """Stands for a simulator in compiled code."""

    __slots__ = ("level",)

    def __init__(self):
        self.level = 0.0


class Tanks(Walk):
    def prepare(self):
        self.tank = Tank()

    def push(self):
        self.tank.level += 1
        return self.tank.level


class SharingAdapter(SnapshotAdapter):
    def capture(self, obj):
        return obj.level

    def restore(self, obj, state):
        obj.level = state

    def clone(self, obj, copy):
        return obj


def test_a_clone_that_shares_state_is_found(own_adapters):
    register_adapter(lambda obj: isinstance(obj, Tank), SharingAdapter())
    env = SnapshotEnvWrapper(Tanks())
    with pytest.raises(
        SnapshotUnsupportedError, match="After steps of a clone, which moved the original, step 1"
    ):
        env.clone()


def test_an_environment_that_fails_at_every_step_is_refused():
    class Broken(Walk):
        def step(self, action):
            return super().step(action)[:4]

    with pytest.raises(
        SnapshotUnsupportedError, match="could not be checked: its step raised ValueError: not en"
    ):
        SnapshotEnvWrapper(Broken()).verify()
