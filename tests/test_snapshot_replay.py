"""Snapshots of Box2D environments: which are replayed, and how their clones are made."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils import EzPickle

from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotUnsupportedError

pytest.importorskip("Box2D")

from gymnasium.envs.box2d.bipedal_walker import BipedalWalker
from gymnasium.envs.box2d.lunar_lander import LunarLander

pytestmark = [
    pytest.mark.filterwarnings("ignore:The simulator of:UserWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


class Hardcore(BipedalWalker):
    """Gives its base class an argument that it does not take itself."""

    def __init__(self):
        super().__init__(hardcore=True)


class Moon(BipedalWalker):
    """Takes an argument of which only the simulator knows."""

    def __init__(self, pull=-3.0, render_mode=None):
        super().__init__(render_mode)
        self.world.gravity = (0, pull)


class Heavy(LunarLander):
    """Keeps its own arguments."""

    def __init__(self, weight, *args, **others):
        super().__init__(*args, **others)
        self.weight = weight
        EzPickle.__init__(self, weight, *args, **others)

    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, reward * self.weight, *rest


class Unchanged(LunarLander):
    """Has the constructor of its base class."""


def follow(env, actions):
    return [(o.tobytes(), float(r), t) for o, r, t, *_ in (env.step(action) for action in actions)]


def some_actions(env, count):
    rng = np.random.default_rng(0)
    return rng.uniform(env.action_space.low, env.action_space.high, (count, *env.action_space.shape)).astype(
        np.float32
    )


def test_car_racing():
    env, other = (SnapshotEnvWrapper(gym.make("CarRacing-v3")) for _ in range(2))
    actions = some_actions(env, 55) * np.float32([1, 1, 0.3])
    other.reset(seed=9)
    env.reset(seed=1)
    follow(env, actions[:10])
    env.reset()
    follow(env, actions[:40])
    state = env.snapshot()
    expected = follow(env, actions[40:])
    for target in (env, other):
        target.restore(state)
        assert follow(target, actions[40:]) == expected
    env.restore(state)
    assert follow(env.clone(), actions[40:]) == expected


@pytest.mark.parametrize(
    "make",
    [
        Hardcore,
        lambda: gym.make("tests/Moon-v0", pull=-5.0, render_mode="rgb_array"),
        lambda: Heavy(2.0, "rgb_array", True, gravity=-5.0),
        lambda: Unchanged(None, True, -5.0),
    ],
    ids=["no arguments", "spec", "own EzPickle", "inherited constructor"],
)
def test_clones_of_subclasses(make, monkeypatch):
    monkeypatch.setitem(gym.registry, "tests/Moon-v0", gym.envs.registration.EnvSpec("tests/Moon-v0", Moon))
    env = SnapshotEnvWrapper(make())
    env.reset(seed=0)
    actions = some_actions(env, 20)
    follow(env, actions[:10])
    clone = env.clone()
    assert clone.unwrapped.render_mode is None
    assert follow(clone, actions[10:]) == follow(env, actions[10:])


def test_a_subclass_whose_arguments_are_not_known_is_refused(monkeypatch):
    by_function = gym.envs.registration.EnvSpec("tests/Moon-v0", lambda **others: Moon(-5.0, **others))
    monkeypatch.setitem(gym.registry, "tests/Moon-v0", by_function)
    for make in (lambda: Moon(-5.0), lambda: gym.make("tests/Moon-v0")):
        with pytest.raises(SnapshotUnsupportedError, match=r"Moon .* EzPickle\.__init__\(self, <the same"):
            SnapshotEnvWrapper(make())


def test_an_environment_inside_another_is_refused():
    class Holder(gym.Env):
        observation_space = action_space = gym.spaces.Box(-1, 1, (1,))

        def __init__(self):
            self.inner = BipedalWalker()

    with pytest.raises(
        SnapshotUnsupportedError, match=r"Holder\.inner cannot .* where it is the environment"
    ):
        SnapshotEnvWrapper(Holder())
