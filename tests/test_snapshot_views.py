"""What environments hold of others: views into simulators, weak proxies, objects that pass on questions."""

import pickle
import threading
import weakref
from copy import copy as shallow_copy

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from sb3_mcbs import SnapshotEnvWrapper
from sb3_mcbs.models.probing import probe_randomness
from sb3_mcbs.snapshot import SnapshotAdapter, SnapshotUnsupportedError, register_adapter, registry

BALLS = "".join(f"<body name='b{i}' pos='{i} 0 {i}'><freejoint/><geom size='.1'/></body>" for i in range(3))
ACTION = np.zeros(1, np.float32)


class Base(gym.Env):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.start()
        return self.observe(), {}

    def step(self, action):
        self.move(float(action[0]))
        return self.observe(), 0.0, False, False, {}


class Chaser(Base):
    """Looks at another ball in each episode, through views that it keeps."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (9,), np.float64)

    def __init__(self, new_data=False):
        self.model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{BALLS}</worldbody></mujoco>")
        self.data = mujoco.MjData(self.model)
        self.new_data, self.ball = new_data, 0
        self.look()

    def look(self):
        name = f"b{self.ball}"
        self.seen = [self.data.xpos[self.ball + 1], self.data.qvel[6 * self.ball :][:3]]
        self.part = self.data.body(name)
        self.mass = self.model.body(name).mass if self.ball else self.model.body_mass[1:2]

    def start(self):
        if self.new_data:
            self.data = mujoco.MjData(self.model)
        mujoco.mj_resetData(self.model, self.data)
        self.ball = (self.ball + 1) % 3
        self.data.qvel[:] = self.np_random.normal(size=self.model.nv)
        self.look()

    def move(self, amount):
        mujoco.mj_step(self.model, self.data)

    def observe(self):
        mujoco.mj_kinematics(self.model, self.data)
        return np.concatenate([*self.seen, self.part.xpos[:2], self.mass])


def future(env):
    return [env.step(ACTION)[0].tobytes() for _ in range(5)]


@pytest.mark.parametrize("new_data", [False, True])
def test_exchanged_views_into_a_simulator_are_put_back(new_data):
    env = SnapshotEnvWrapper(Chaser(new_data))
    states, futures = [], []
    for seed in range(3):
        env.reset(seed=seed)
        env.step(ACTION)
        states.append(env.snapshot())
        futures.append(future(env))
    clone, other = env.clone(), SnapshotEnvWrapper(Chaser(new_data))
    for _ in range(2):
        for state, expected in zip(states, futures, strict=True):
            for target in (env, clone, other):
                target.restore(pickle.loads(pickle.dumps(state)) if target is other else state)
                assert future(target) == expected
                target.restore(state)
                seen, data = target.unwrapped.seen, target.unwrapped.data
                assert np.shares_memory(seen[0], data.xpos) and np.shares_memory(seen[1], data.qvel)
                copied = target.clone()
                assert future(copied) == expected == future(target)
        env.unwrapped.reset(seed=7)  # past the wrapper


def test_views_of_the_warnings_belong_to_the_clone():
    env = SnapshotEnvWrapper(Chaser())
    env.unwrapped.counts = env.unwrapped.data.warning.number
    copied = env.clone().unwrapped
    assert copied.counts is copied.data.warning.number


class Tank:
    def __init__(self):
        self.level = 0.0


class Gauge:
    """Passes on what it does not have, and has nothing but slots."""

    __slots__ = ("tank", "unit")

    def __init__(self, tank):
        self.tank, self.unit = tank, 1.0

    def __getattr__(self, name):
        return getattr(self.tank, name)


class Plant(Base):
    def __init__(self):
        self.tank, self.levels = Tank(), np.zeros(2)
        self.proxies = [weakref.proxy(self.tank), weakref.proxy(self.levels), weakref.proxy(self)]
        self.gone = weakref.proxy(Tank())
        self.gauge = Gauge(self.tank)

    def start(self):
        self.tank.level, self.levels[:] = self.np_random.normal(), 0.0

    def move(self, amount):
        self.tank.level += 1.0 + self.levels[0]
        self.levels[0] += 0.5

    def observe(self):
        tank, levels, plant = self.proxies
        return np.array([tank.level + levels[0] + plant.levels[1] + self.gauge.level * self.gauge.unit])


def test_proxies_stand_for_what_they_stood_for():
    env = SnapshotEnvWrapper(Plant())
    env.reset(seed=0)
    state = env.snapshot()
    expected = future(env)
    other = SnapshotEnvWrapper(Plant())
    for target in (env, env.clone(), other):
        target.restore(pickle.loads(pickle.dumps(state)))
        plant = target.unwrapped
        assert all(type(proxy) is weakref.ProxyType for proxy in (*plant.proxies, plant.gone))
        assert plant.gauge.tank is plant.tank
        assert future(target) == expected
        assert plant.proxies[0].level == plant.tank.level == plant.gauge.level
        assert plant.proxies[1][0] == plant.levels[0] == 2.5


class Pump:
    """Its lock stands for what cannot be captured; the rest is ordinary."""

    def __init__(self):
        self.lock, self.strokes, self.pipe = threading.Lock(), 0, [0.0]


class PumpAdapter(SnapshotAdapter):
    with_attributes = True
    not_state = frozenset({"lock"})

    def capture(self, obj):
        return None

    def restore(self, obj, state):
        pass

    def clone(self, obj, copy):
        return Pump()


class Station(Base):
    def __init__(self):
        self.pump = Pump()
        self.pipe = self.pump.pipe

    def start(self):
        self.pump.strokes, self.pipe[0] = 0, self.np_random.normal()

    def move(self, amount):
        with self.pump.lock:
            self.pump.strokes += 1
            self.pipe[0] += self.pump.strokes

    def observe(self):
        return np.array([self.pump.pipe[0]])


def test_adapters_leave_ordinary_attributes_to_the_snapshot(monkeypatch):
    monkeypatch.setattr(registry, "_registered", [*registry._registered])
    with pytest.raises(SnapshotUnsupportedError, match=r"Station\.pump\.lock"):
        SnapshotEnvWrapper(Station())
    register_adapter(lambda obj: isinstance(obj, Pump), PumpAdapter())
    env = SnapshotEnvWrapper(Station())
    env.reset(seed=0)
    env.step(ACTION)
    state, lock = env.snapshot(), env.unwrapped.pump.lock
    expected = future(env)
    env.unwrapped.pump.extra = 1
    for target in (env, env.clone(), SnapshotEnvWrapper(Station())):
        target.restore(state)
        station = target.unwrapped
        assert future(target) == expected
        assert station.pipe is station.pump.pipe and not hasattr(station.pump, "extra")
        assert (station.pump.lock is lock) == (target is env)
    env.unwrapped.pump.file = threading.Lock()
    with pytest.raises(SnapshotUnsupportedError, match=r"Station\.pump\.file"):
        env.snapshot()


def test_adapters_may_make_shallow_copies(monkeypatch):
    class ShallowAdapter(PumpAdapter):
        def clone(self, obj, copy):
            return shallow_copy(obj)

    class Valve:
        strokes = 0

    class Deep(Station):
        def __init__(self):
            super().__init__()
            self.pump.valve = Valve()

        def move(self, amount):
            super().move(amount)
            self.pump.valve.strokes += self.pump.strokes
            self.pipe[0] += self.pump.valve.strokes

    monkeypatch.setattr(registry, "_registered", [*registry._registered])
    register_adapter(lambda obj: isinstance(obj, Pump), ShallowAdapter())
    env = SnapshotEnvWrapper(Deep())
    env.reset(seed=0)
    env.step(ACTION)
    state, clone = env.snapshot(), env.clone()
    assert clone.unwrapped.pump.valve is not env.unwrapped.pump.valve
    expected = future(env)
    assert future(clone) == expected
    for target in (env, clone):
        target.restore(state)
        assert future(target) == expected


@pytest.mark.parametrize("form", ["dict", "tuple", "mixed"])
def test_observations_of_spaces_in_spaces_are_no_randomness(form):
    class Nested(gym.ObservationWrapper):
        def __init__(self, env):
            super().__init__(env)
            self.observation_space = self.nest(env.observation_space, gym.spaces.Dict, gym.spaces.Tuple)

        def nest(self, inner, as_dict=dict, as_tuple=tuple):
            if form == "dict":
                return as_dict({"a": as_dict({"b": inner}), "c": inner})
            return as_tuple((inner, as_dict({"a": inner}) if form == "mixed" else inner))

        def observation(self, observation):
            return self.nest(observation)

    env = SnapshotEnvWrapper(Nested(gym.make("Pendulum-v1")))
    env.reset(seed=0)
    randomness = probe_randomness(env)
    assert randomness is not None and not randomness.any
