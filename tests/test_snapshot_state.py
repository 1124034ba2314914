"""Snapshots of ordinary Python state, adapters, replay, and what is refused."""

import ctypes
import functools
import gc
import pickle
import random
import socket
import threading
import weakref
from collections import deque

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TransformObservation

from sb3_mcbs.snapshot import (
    ReplayAdapter,
    SnapshotAdapter,
    SnapshotEnvWrapper,
    SnapshotMismatchError,
    SnapshotUnsupportedError,
    register_adapter,
)


class Slotted:
    __slots__ = ("env", "value")

    def __init__(self, value, env):
        self.value = value
        self.env = env


class Toy(gym.Env):
    """Holds one of everything that ordinary environments are made of; every step changes all of it."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (6,))

    def __init__(self):
        self.action_space = gym.spaces.Box(-1, 1, (1,))
        self.buffer = np.zeros(6)
        self.view = self.buffer[2:4]
        self.shared = [0.0]
        self.also_shared = {"list": self.shared, "queue": deque([0.0] * 3, maxlen=3)}
        self.slotted = Slotted(0, self)
        self.legacy = np.random.RandomState(0)
        self.python = random.Random(0)
        self.draw = self.legacy.uniform
        self.nothing_yet = None
        count = 0

        def counter():
            nonlocal count
            count += 1
            return count

        self.counter = counter
        self.add = functools.partial(np.add, 1)
        self.method = self._bump

    def _bump(self):
        self.slotted.value += 1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.buffer[:] = self.np_random.normal(size=6)
        return self.buffer.copy(), {}

    def step(self, action):
        self.method()
        self.view += self.slotted.env.np_random.normal()
        self.shared[0] += self.python.random()
        self.also_shared["queue"].append(self.draw())
        self.nothing_yet = {"now": self.counter()}
        numbers = (self.also_shared["list"][0], sum(self.also_shared["queue"]), self.add(self.slotted.value))
        self.buffer[4] = sum(numbers)
        return (
            self.buffer + float(action[0]),
            self.buffer[4],
            False,
            False,
            {"count": self.nothing_yet["now"]},
        )


def follow(env, n=4):
    results = []
    for _ in range(n):
        observation, reward, *rest = env.step(np.full(1, 0.5, np.float32))
        results.append((np.asarray(observation).tobytes(), float(reward), *rest[:2], rest[2].get("count")))
    return results


def rescaled(env):
    """Observe through a function that closes over state of its own."""
    noise = np.random.default_rng(0)
    return TransformObservation(env, lambda o: o * noise.normal(), env.observation_space)


def toy(*wrappers):
    env = Toy()
    for wrapper in wrappers:
        env = wrapper(env)
    env = SnapshotEnvWrapper(env)
    env.reset(seed=0)
    return env


@pytest.mark.parametrize("wrappers", [(), (rescaled,)], ids=["bare", "closure"])
def test_ordinary_state(wrappers):
    env, other = toy(*wrappers), toy(*wrappers)
    follow(env, 3)
    state = env.snapshot()
    expected = follow(env)
    follow(other, 1)
    clone = env.clone()
    from_there = follow(env)
    assert follow(clone) == from_there != expected
    for target in (env, other, clone):
        target.restore(state)
        assert follow(target) == expected
        target.restore(pickle.loads(pickle.dumps(state)))
        assert follow(target) == expected
    inner = other.unwrapped
    assert inner.view.base is inner.buffer and inner.also_shared["list"] is inner.shared
    assert inner.slotted.env is inner and inner.draw.__self__ is inner.legacy
    assert inner.shared is not env.unwrapped.shared


def test_attributes_that_come_and_go():
    env = toy()
    state = env.snapshot()
    follow(env)
    env.unwrapped.extra = 3
    del env.unwrapped.add
    env.restore(state)
    assert not hasattr(env.unwrapped, "extra") and env.unwrapped.nothing_yet is None
    follow(env)


def test_snapshot_is_not_changed_by_what_it_was_restored_into():
    env = toy()
    state = env.snapshot()
    expected = follow(env)
    for _ in range(2):
        env.restore(state)
        env.unwrapped.also_shared["queue"].clear()
        env.unwrapped.buffer[:] = 9
        env.last_observation[:] = 9
    env.restore(state)
    assert follow(env) == expected
    with pytest.raises(AttributeError):
        state.nodes = ()


def test_random_generators_on_request():
    env = toy(rescaled)
    follow(env, 2)
    state = env.snapshot()
    expected = follow(env)

    def states():
        inner = env.unwrapped
        return str((inner.np_random.bit_generator.state, inner.legacy.get_state(), inner.python.getstate()))

    now = states()
    env.restore(state, rng="keep")
    assert states() == now
    assert env.unwrapped.buffer.tobytes() != expected[-1][0]
    kept = follow(env)
    futures = []
    for seed in (1, 1, 2):
        env.restore(state, rng=np.random.default_rng(seed))
        futures.append(follow(env))
    assert futures[0] == futures[1] != futures[2]
    assert all(future != expected for future in [kept, *futures])
    # No draw at all may be shared with what the environment would have drawn.
    assert futures[0][0][1] != expected[0][1]
    env.restore(state)
    assert follow(env) == expected


def test_generator_that_nobody_drew_from_yet_is_seeded_too():
    env = SnapshotEnvWrapper(gym.make("Pendulum-v1"))
    drawn = []
    for _ in range(2):
        env.restore(env.snapshot(), rng=np.random.default_rng(4))
        drawn.append((env.unwrapped.np_random.random(), env.action_space.sample().tobytes()))
        env.unwrapped._np_random = env.action_space._np_random = None
    assert drawn[0] == drawn[1]


def _generator_object():
    yield 1


@pytest.mark.parametrize(
    "make",
    [
        socket.socket,
        threading.Lock,
        lambda: open(__file__),  # noqa: SIM115
        _generator_object,
        lambda: ctypes.pointer(ctypes.c_int(1)),
        lambda: ctypes.CDLL(None),
        lambda: weakref.ref(Toy, print),
        lambda: {"inner": [threading.Thread()]},
    ],
    ids=["socket", "lock", "file", "generator", "pointer", "library", "weakref", "nested"],
)
def test_what_cannot_be_captured_is_refused_when_wrapped(make):
    env = Toy()
    env.thing = make()
    with pytest.raises(SnapshotUnsupportedError, match=r"Toy\.thing") as error:
        SnapshotEnvWrapper(env)
    if isinstance(env.thing, dict):
        assert "Toy.thing['inner'][0]" in str(error.value)
    else:
        assert type(env.thing).__name__ in str(error.value), error.value
        getattr(env.thing, "close", lambda: None)()


def test_views_into_a_simulator_follow_it():
    env = SnapshotEnvWrapper(gym.make("HalfCheetah-v5"))
    env.reset(seed=0)
    env.unwrapped.speed = env.unwrapped.data.qvel[:3]
    state, speed = env.snapshot(), env.unwrapped.data.qvel.copy()
    env.step(np.ones(6, np.float32))
    clone = env.clone()
    assert np.shares_memory(clone.unwrapped.speed, clone.unwrapped.data.qvel)
    assert not np.shares_memory(clone.unwrapped.speed, env.unwrapped.speed)
    for target in (env, clone):
        target.restore(state)
        assert np.array_equal(target.unwrapped.speed, speed[:3])
        assert np.shares_memory(target.unwrapped.speed, target.unwrapped.data.qvel)
        assert np.array_equal(target.unwrapped.data.qvel, speed)


class Counter:
    """Stands for a simulator in compiled code: its state is not in attributes."""

    __slots__ = ("_lock", "_total")

    def __init__(self):
        self._lock = threading.Lock()
        self._total = 0


class CounterAdapter(SnapshotAdapter):
    def capture(self, obj):
        return obj._total

    def restore(self, obj, state):
        obj._total = state

    def clone(self, obj, copy):
        made = Counter()
        made._total = obj._total
        return made

    def validate(self, obj, state):
        if state > 100:
            raise SnapshotMismatchError("too much")


def test_adapters_for_objects(own_adapters):
    def make():
        env = Toy()
        env.counter_object = Counter()
        env.same_counter = [env.counter_object]
        return env

    with pytest.raises(SnapshotUnsupportedError, match=r"Toy\.counter_object\._lock"):
        SnapshotEnvWrapper(make())
    register_adapter(lambda obj: isinstance(obj, Counter), CounterAdapter())
    env = SnapshotEnvWrapper(make())
    env.unwrapped.counter_object._total = 5
    state = env.snapshot()
    env.unwrapped.counter_object._total = 50
    clone = env.clone()
    assert clone.unwrapped.counter_object._total == 50
    assert (
        clone.unwrapped.same_counter[0] is clone.unwrapped.counter_object is not env.unwrapped.counter_object
    )
    clone.restore(state)
    assert (clone.unwrapped.counter_object._total, env.unwrapped.counter_object._total) == (5, 50)
    env.unwrapped.counter_object._total = 101
    bad = env.snapshot()
    clone.unwrapped.shared[0] = "before"
    with pytest.raises(SnapshotMismatchError, match="too much"):
        clone.restore(bad)
    assert clone.unwrapped.shared == ["before"] and clone.unwrapped.counter_object._total == 5
    with pytest.raises(TypeError, match="adapter"):
        register_adapter(lambda obj: True, CounterAdapter)


class Unseen(gym.Env):
    """Its simulator is a generator object: it can neither be copied nor read."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, scale=1.0):
        self.scale = scale
        self.simulation = None

    def _simulate(self, start):
        while True:
            action = yield start
            start = start * 0.9 + float(action[0]) * self.scale + self.np_random.normal()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.simulation = self._simulate(self.np_random.normal() + (options or {}).get("from", 0))
        next(self.simulation)
        return self.step(np.zeros(1, np.float32))[0], {}

    def step(self, action):
        value = self.simulation.send(action)
        return np.array([value]), value, False, False, {}


def test_replay(own_adapters):
    adapter = ReplayAdapter()
    register_adapter(lambda obj: isinstance(obj, Unseen), adapter)
    env, other = SnapshotEnvWrapper(Unseen()), SnapshotEnvWrapper(Unseen())
    env.reset(seed=0)
    follow(env, 2)
    env.reset()
    env.unwrapped.step(np.ones(1, np.float32))  # behind the wrapper
    env.reset(options={"from": 10})
    follow(env, 3)
    env.unwrapped.note = "kept"
    with pytest.warns(UserWarning, match=r"Unseen .* ms for 3 steps"):  # of the check before it
        state = env.snapshot()
    expected = follow(env)
    env.restore(state)
    assert follow(env) == expected
    other.restore(pickle.loads(pickle.dumps(state)))  # a second warning would be an error: see pytestmark
    assert other.unwrapped.note == "kept"
    assert follow(other) == expected
    clone = other.clone()
    assert follow(clone) == follow(other)
    clone.restore(state, rng=np.random.default_rng(0))
    assert follow(clone) != expected
    now = env.unwrapped.np_random.bit_generator.state
    env.restore(state, rng="keep")
    assert env.unwrapped.np_random.bit_generator.state == now


@pytest.mark.parametrize("name", ["LunarLanderContinuous-v3", "BipedalWalker-v3"])
@pytest.mark.filterwarnings("ignore:The simulator of:UserWarning", "ignore::DeprecationWarning")
def test_box2d(name):
    pytest.importorskip("Box2D")
    env, other = (SnapshotEnvWrapper(gym.make(name)) for _ in range(2))
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (55, *env.action_space.shape)).astype(np.float32)

    def run(target, some):
        return [
            (np.asarray(o).tobytes(), float(r), t) for o, r, t, *_ in (target.step(action) for action in some)
        ]

    other.reset(seed=9)
    env.reset(seed=1)
    for _ in range(2):
        run(env, actions[:20])
        env.reset()  # the third episode is not seeded
    run(env, actions[:40])
    state = env.snapshot()
    expected = run(env, actions[40:])
    for target in (env, other, other):
        target.restore(state)
        assert run(target, actions[40:]) == expected
    env.restore(state)
    clone = env.clone()
    assert run(clone, actions[40:]) == expected
    assert clone.unwrapped.render_mode is None
    assert other.reset()[0].tobytes() == clone.reset()[0].tobytes()


def test_dropped_snapshots_are_used_again():
    from sb3_mcbs.snapshot import mujoco as room

    env = SnapshotEnvWrapper(gym.make("Hopper-v5"))
    env.reset(seed=0)
    kept = env.snapshot()
    spares = room._spares[tuple(room._layout(env.unwrapped.model).sizes.values())]
    env.snapshot()
    n_spares = len(spares)
    assert n_spares >= 1
    action = np.ones(3, np.float32)
    expected = env.step(action)[0]
    for _ in range(3):
        env.snapshot()
    assert len(spares) == n_spares
    # Those snapshots overwrote spares; the one that is still there must not have been among them.
    env.restore(kept)
    assert np.array_equal(env.step(action)[0], expected)


def test_clones_can_be_forgotten():
    env = SnapshotEnvWrapper(gym.make("Hopper-v5"))
    models = [weakref.ref(env.clone().unwrapped.model) for _ in range(3)]
    gc.collect()
    # A spare state of a dropped snapshot may hold on to one of them.
    assert sum(model() is not None for model in models) <= 1
