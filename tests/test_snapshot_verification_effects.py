"""What the check of snapshots leaves behind, which is nothing, and when it is made."""

import gc
import random
import weakref
from collections import OrderedDict

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch as th
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.wrappers import NormalizeObservation, TimeLimit
from stable_baselines3.common.monitor import Monitor

from sb3_mcbs import MCBSTD3, SearchPolicy
from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotUnsupportedError
from tests.conftest import SMALL
from tests.test_snapshot_graph import Cell
from tests.test_snapshot_verification import EXACT, STEPS, Handle, Walk, follow

DRAWN = [0]

pytestmark = pytest.mark.usefixtures("nothing_has_passed")


def generators():
    return random.getstate(), str(np.random.get_state()), th.get_rng_state().tolist()


@pytest.mark.parametrize("name", ["Noisy", "Market", "wrappers", "a function"])
def test_the_environment_is_where_it_was(name, tmp_path):
    envs = []
    for verify, place in ((True, "one"), (False, "other")):
        monitor = Monitor(EXACT[name](), str(tmp_path / place))
        envs.append(SnapshotEnvWrapper(TimeLimit(monitor, 9), verify))
        envs[-1].reset(seed=3)
        follow(envs[-1], 4)
        envs[-1].reset()
        follow(envs[-1], 3)
    env, other = envs
    before, monitor = generators(), env.env.env
    written, rewards = (tmp_path / "one.monitor.csv").read_text(), [*monitor.rewards]
    moment, last = env.episode_clock, env.last_observation.copy()
    env.verify()
    assert (
        generators() == before and env.episode_clock == moment and np.array_equal(env.last_observation, last)
    )
    assert (tmp_path / "one.monitor.csv").read_text() == written and monitor.rewards == rewards
    assert getattr(env.unwrapped, "n_resets", 2) == getattr(other.unwrapped, "n_resets", 2)
    for _ in range(2):
        assert follow(env, 4) == follow(other, 4)
        assert np.array_equal(env.reset()[0], other.reset()[0])


def test_an_environment_that_nobody_has_reset_yet():
    env = SnapshotEnvWrapper(Walk())
    assert env.verify()
    assert env.unwrapped._np_random is None and env.last_observation is None
    assert (env.unwrapped.n_resets, env.episode_clock) == (0, (0, 0))


def test_objects_that_others_hold_too_stay_the_same_objects():
    held = {"level": 1.0}, [[1.0]], np.zeros(2), OrderedDict(a=[1]), {(1, 2)}, np.zeros(2, object)

    class Shared(Walk):
        def __init__(self, *held):
            super().__init__()
            self.settings, self.rows, self.array, self.ordered, self.seen, self.objects = held
            self.view, self.tensor, self.cell = self.array[1:], th.zeros(2), Cell(1, (2, 3))

        def push(self):
            self.rows[0].append(self.settings["level"])
            self.settings["level"] += 1
            self.view += 1
            self.ordered["a"].append(1)
            self.seen.add((self.age, self.age))
            self.objects[0] = self.age
            self.tensor += 1
            self.cell = Cell(self.age, (0, 0))
            return len(self.rows[0]) + self.array[1] + float(self.tensor[0]) + len(self.ordered["a"])

    env = SnapshotEnvWrapper(Shared(*held))
    env.reset(seed=0)
    before = vars(env.unwrapped) | {}
    env.verify()
    for name, value in before.items():
        if type(value) in (dict, list, np.ndarray, OrderedDict, set, th.Tensor, Cell):
            assert vars(env.unwrapped)[name] is value, name
    assert held[0] == {"level": 1.0} and held[1] == [[1.0]] and held[3] == {"a": [1]} and held[4] == {(1, 2)}
    assert (
        held[2].tolist() == [0, 0] and held[5].tolist() == [0, 0] and env.unwrapped.tensor.tolist() == [0, 0]
    )


class Compiled(Walk):
    """Its model is compiled anew at every reset, with other sizes."""

    def prepare(self):
        self.simulation = type("Simulation", (), {})()
        self.compile(1)

    def compile(self, n):
        spec = mujoco.MjSpec()
        body = spec.worldbody.add_body()
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE)
        for _ in range(n):
            body.add_geom(size=[0.1, 0, 0])
        self.simulation.model = spec.compile()
        self.simulation.data = mujoco.MjData(self.simulation.model)

    def reset(self, **kwargs):
        observation, info = super().reset(**kwargs)
        self.compile(int(self.np_random.integers(1, 20)))
        return observation, info

    def push(self):
        mujoco.mj_step(self.simulation.model, self.simulation.data)
        return float(self.simulation.data.qpos[0] + self.simulation.model.ngeom)


def test_a_simulator_that_every_reset_exchanges_is_there_again():
    env = SnapshotEnvWrapper(Compiled())
    env.reset(seed=3)
    env.reset()
    follow(env, 2)
    model, height = env.unwrapped.simulation.model, float(env.unwrapped.simulation.data.qpos[0])
    env.verify()
    assert env.unwrapped.simulation.model is model
    assert float(env.unwrapped.simulation.data.qpos[0]) == height


def test_an_environment_that_is_refused_is_reset():
    env = SnapshotEnvWrapper(Handle())
    first, _ = env.reset(seed=3, options={"a": 1})
    follow(env, 2)
    with pytest.raises(SnapshotUnsupportedError):
        env.verify()
    assert np.array_equal(env.last_observation, first) and np.array_equal(env.unwrapped.x, first)
    assert env.episode_clock[1] == 0 and env.reset_arguments == {"seed": 3, "options": {"a": 1}}


class Drawing(Walk):
    def step(self, action):
        DRAWN[0] += self.render_mode == "human"
        return super().step(action)


def test_nothing_is_drawn():
    DRAWN[0] = 0
    env = SnapshotEnvWrapper(Drawing(render_mode="human"))
    env.verify()
    assert STEPS[Drawing] > 0 and DRAWN[0] == 0 and env.unwrapped.render_mode == "human"
    env.reset()
    follow(env, 1)
    assert DRAWN[0] == 1


# --- when it is checked ----------------------------------------------------------------------------------


class Configured(Walk):
    def __init__(self, size=1, render_mode=None):
        super().__init__(render_mode)
        self.size = size


class Untold:
    def __repr__(self):
        raise ValueError("no text")


def test_once_per_class_and_spec_and_stack(monkeypatch):
    spec = gym.envs.registration.EnvSpec("tests/Walk-v0", Configured)
    monkeypatch.setitem(gym.registry, "tests/Walk-v0", spec)
    makers = [
        Configured,
        lambda: gym.make("tests/Walk-v0"),
        lambda: gym.make("tests/Walk-v0", size=np.arange(5)),
        lambda: gym.make("tests/Walk-v0", size=Untold()),
        lambda: TimeLimit(Configured(), 5),
    ]
    for make in makers:
        STEPS.clear()
        SnapshotEnvWrapper(make()).verify()
        assert STEPS[Configured] > 0
    STEPS.clear()
    for make in (*makers[:3], *makers[4:]):
        env = SnapshotEnvWrapper(make())
        assert env.verify()
        env.restore(env.snapshot())
        env.clone()
    assert STEPS[Configured] == 0


def test_what_passed_is_not_kept_alive():
    def check():
        class Passing(Walk):
            pass

        SnapshotEnvWrapper(Passing()).verify()
        STEPS.clear()
        return weakref.ref(Passing)

    gone = check()
    gc.collect()
    assert gone() is None


@pytest.mark.parametrize("wrap", [lambda env: env, Monitor, lambda env: TimeLimit(Monitor(env), 5)])
def test_on_request_there_is_no_check(wrap):
    env = SnapshotEnvWrapper(wrap(SnapshotEnvWrapper(Handle(), verify=False)))
    STEPS.clear()
    env.reset(seed=0)
    env.restore(env.snapshot())
    env.clone()
    assert STEPS[Handle] == 0 and not env.verifies


def fail(*args):
    raise AssertionError("it was stepped")


def test_known_environments_are_not_stepped(monkeypatch):
    monkeypatch.setattr(HalfCheetahEnv, "step", fail)
    monkeypatch.setattr(PendulumEnv, "step", fail)
    for name in ("HalfCheetah-v5", "Pendulum-v1"):
        for wrap in (lambda env: env, NormalizeObservation, Monitor):
            env = SnapshotEnvWrapper(wrap(gym.make(name)))
            assert env.verify()
            env.restore(env.snapshot())
        changed = gym.make(name)
        changed.unwrapped.step = fail
        with pytest.raises(SnapshotUnsupportedError, match="its step raised AssertionError: it was stepped"):
            SnapshotEnvWrapper(changed).verify()


def test_a_reset_that_needs_options():
    class Aimed(Walk):
        def reset(self, *, seed=None, options=None):
            self.goal = options["goal"]
            return super().reset(seed=seed)

    env = SnapshotEnvWrapper(Aimed())
    assert not env.verify()
    env.snapshot()  # of an environment that has done nothing yet
    env.reset(options={"goal": 1})
    STEPS.clear()
    assert env.verify() and STEPS[Aimed] > 0


def test_a_reset_that_fails_is_a_reason():
    class Stubborn(Walk):
        def reset(self, **kwargs):
            if 0 < self.age < 5:
                raise RuntimeError("not now")
            return super().reset(**kwargs)

    env = SnapshotEnvWrapper(Stubborn())
    env.reset(seed=0)
    follow(env, 2)
    with pytest.raises(
        SnapshotUnsupportedError, match=r"its reset raised RuntimeError: not now\. .*verify=False"
    ):
        env.snapshot()
    assert env.unwrapped.age == 2, "it could not be reset, and is where it was"


def test_agents_refuse_when_they_are_made(make_agent):
    with pytest.raises(SnapshotUnsupportedError, match="After a restore step 1 of Handle"):
        make_agent(Handle())
    agent = make_agent(Handle(), rollout_depth=0).learn(30)
    assert agent.num_timesteps == 30
    with pytest.raises(SnapshotUnsupportedError, match="After a restore step 1 of Handle"):
        SearchPolicy(agent, SnapshotEnvWrapper(Handle()), rollout_depth=1)
    MCBSTD3("MlpPolicy", SnapshotEnvWrapper(Handle(), verify=False), **SMALL)


def test_copies_are_not_checked_again():
    env = SnapshotEnvWrapper(Walk())
    env.reset(seed=0)
    clone = env.clone()
    STEPS.clear()
    clone.restore(clone.snapshot())
    clone.clone()
    assert STEPS[Walk] == 0 and clone.verifies
