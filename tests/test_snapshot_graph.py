"""Snapshots of what environments hold and share: value objects, sequences of seeds, views, functions."""

import copy
import dataclasses
import functools
import mmap
import pickle
import weakref
from collections import namedtuple

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation, TransformReward

from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotMismatchError, SnapshotUnsupportedError


@dataclasses.dataclass(frozen=True)
class Cell:
    x: int
    y: tuple[int, int]


@dataclasses.dataclass(frozen=True, slots=True)
class Pair:
    one: Cell
    two: Cell


class Node:
    """Hashed by its place, and in a circle with its neighbours."""

    def __init__(self, place):
        self.neighbours = set()
        self.place = place

    def __hash__(self):
        return hash(self.place)

    def __eq__(self, other):
        return self.place == other.place


class Settings(dict):
    """A dictionary whose items are its attributes."""

    def __init__(self, **items):
        super().__init__(**items)
        self.__dict__ = self


class Small(gym.Env):
    """Its observation is the sum of what ``advance`` returned."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = spaces.Box(-1, 1, (1,), np.float64)

    def __init__(self):
        self.total = 0.0
        self.prepare()

    def prepare(self):
        pass

    def advance(self):
        return 1.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.total = 0.0
        return np.array([self.total]), {}

    def step(self, action):
        self.total = float(self.total + self.advance())
        return np.array([self.total]), self.total, False, False, {}


class Cells(Small):
    def prepare(self):
        self.here = Cell(0, (0, 0))
        self.visited = {self.here}
        self.values = {self.here: [0.0], Pair(self.here, Cell(1, (0, 0))): [1.0]}
        self.frozen = frozenset(self.visited)

    def advance(self):
        self.here = Cell(len(self.visited), (1, 1))
        self.visited.add(self.here)
        self.values[self.here] = [1.0]
        self.values[Pair(Cell(0, (0, 0)), Cell(1, (0, 0)))][0] += 1
        return sum(value[0] for value in self.values.values()) + (self.here in self.visited)


class Circle(Small):
    def prepare(self):
        self.nodes = [Node((place, 0)) for place in range(3)]
        for node in self.nodes:
            node.neighbours.update(other for other in self.nodes if other is not node)

    def advance(self):
        self.nodes.append(Node((len(self.nodes), 0)))
        self.nodes[0].neighbours.add(self.nodes[-1])
        return sum(node in self.nodes[0].neighbours for node in self.nodes)


class Configured(Small):
    def prepare(self):
        self.settings = Settings(gain=2.0)

    def advance(self):
        self.settings.gain += 1
        return self.settings["gain"]


class Slotted(Small):
    __slots__ = ("hidden",)

    def prepare(self):
        self.hidden = [0.0]

    def advance(self):
        self.hidden = [self.hidden[0] + 1]
        return self.hidden[0]


class Spawning(Small):
    def prepare(self):
        self.seeds = np.random.SeedSequence(5)
        self.noise = np.random.default_rng(self.seeds)

    def advance(self):
        children = [*self.np_random.spawn(1), *self.noise.spawn(1)]
        return sum(child.normal() for child in children) + self.seeds.n_children_spawned


class OneBitGenerator(Small):
    def prepare(self):
        self.bits = np.random.PCG64(3)
        self.rngs = [np.random.Generator(self.bits), np.random.Generator(self.bits)]

    def advance(self):
        return self.rngs[0].normal() + self.rngs[1].normal() + self.bits.random_raw() % 7


class Remembering(Small):
    def prepare(self):
        def advance(calls=[0.0], *, more={}):  # noqa: B006
            calls[0] += 1
            more[len(more)] = 1
            advance.n = getattr(advance, "n", 0) + 1
            return calls[0] + len(more) + advance.n

        self.advance = advance


class Views(Small):
    def prepare(self):
        self.grid = np.asfortranarray(np.zeros((3, 3), object))
        self.grid[2, 0] = [1]
        self.row = self.grid[1]
        self.memory = bytearray(8)
        self.bytes = np.frombuffer(self.memory, np.uint8)
        self.word = self.bytes[4:].view(np.uint32)

    def advance(self):
        self.row[1] += 1
        self.grid[1, 2] += 1
        self.bytes[4] += 1
        self.memory[5] += 1
        return self.grid[1, 1] + self.row[2] + self.memory[4] + self.word[0]


EVERYTHING = [
    Cells,
    Circle,
    Configured,
    Slotted,
    Spawning,
    OneBitGenerator,
    Remembering,
    Views,
]


def follow(env, n=5):
    action = np.zeros(env.action_space.shape, env.action_space.dtype)
    return [env.step(action)[:2] for _ in range(n)]


def wrapped(cls):
    env = SnapshotEnvWrapper(cls())
    env.reset(seed=0)
    return env


@pytest.mark.parametrize("cls", EVERYTHING)
def test_same_future_everywhere(cls):
    env, other = wrapped(cls), wrapped(cls)
    follow(env, 3)
    state = env.snapshot()
    clone = env.clone()
    expected = follow(env)
    assert follow(clone) == expected
    follow(other, 1)
    for target in (env, other, clone, env):
        target.restore(state)
        assert follow(target) == expected
    env.restore(state)
    untouched = env.clone()
    follow(clone, 2)
    follow(env, 2)
    assert follow(untouched) == expected


@pytest.mark.parametrize("cls", [cls for cls in EVERYTHING if cls is not Remembering])
def test_another_instance_that_was_never_stepped(cls):
    env = wrapped(cls)
    follow(env, 3)
    state = pickle.loads(pickle.dumps(env.snapshot()))
    expected = follow(env)
    other = SnapshotEnvWrapper(cls())
    for _ in range(2):
        other.restore(state)
        assert follow(other) == expected


def test_value_objects_are_made_anew_and_others_are_put_back_in_place():
    env = wrapped(Cells)
    here = env.unwrapped.here
    state = env.snapshot()
    follow(env, 2)
    later = env.unwrapped.here
    env.restore(state)
    assert env.unwrapped.here == here and later == Cell(2, (1, 1))
    assert env.unwrapped.here is next(iter(env.unwrapped.visited))
    env = wrapped(Configured)
    settings = env.clone().unwrapped.settings
    assert vars(settings) is settings


def test_a_failing_restore_leaves_value_objects_alone():
    class Stranger(Cells):
        def prepare(self):
            super().prepare()
            self.own = np.frombuffer(mmap.mmap(-1, 8), np.uint8)

    Stranger.__module__, Stranger.__qualname__ = Cells.__module__, Cells.__qualname__
    stranger, env = SnapshotEnvWrapper(Stranger(), verify=False), wrapped(Cells)
    follow(env, 2)
    before, seeds = copy.deepcopy(vars(env.unwrapped)), env.unwrapped.np_random.bit_generator.state
    with pytest.raises(SnapshotMismatchError, match="memory that is not an array"):
        env.restore(stranger.snapshot())
    del before["_np_random"]
    assert {name: vars(env.unwrapped)[name] for name in before} == before
    assert env.unwrapped.np_random.bit_generator.state == seeds


def test_what_is_spawned_in_a_look_ahead_is_not_what_the_environment_will_spawn():
    env = wrapped(Spawning)
    follow(env, 2)
    state = env.snapshot()
    futures = []
    for target in (env, env.clone()):
        for seed in (1, 1, 2):
            target.restore(state, rng=np.random.default_rng(seed))
            draws = [rng.spawn(1)[0].random() for rng in (target.unwrapped.np_random, target.unwrapped.noise)]
            futures.append((draws, target.unwrapped.seeds.n_children_spawned))
    assert futures[0] == futures[1] == futures[3] == futures[4] != futures[2] == futures[5]
    env.restore(state)
    real = [rng.spawn(1)[0].random() for rng in (env.unwrapped.np_random, env.unwrapped.noise)]
    assert not {*real} & {*futures[0][0], *futures[2][0]}
    now = env.unwrapped.seeds.n_children_spawned
    env.restore(state, rng="keep")
    assert env.unwrapped.seeds.n_children_spawned == now


def test_what_generators_share_stays_shared():
    env = wrapped(Spawning)
    state = env.snapshot()
    seeds = env.unwrapped.seeds
    follow(env, 1)
    env.restore(state)
    assert env.unwrapped.seeds is seeds is env.unwrapped.noise.bit_generator.seed_seq
    # Generators that draw apart must not be put back into ones that have come to draw together.
    inner = env.unwrapped
    inner.noise = np.random.Generator(inner.np_random.bit_generator)
    env.restore(state)
    assert inner.noise.bit_generator is not inner.np_random.bit_generator
    assert inner.noise.bit_generator.seed_seq is inner.seeds
    legacy = wrapped(Small)
    legacy.unwrapped.rng = np.random.RandomState(0)
    legacy.unwrapped.bare = np.random.RandomState(0)._bit_generator
    assert legacy.unwrapped.bare.seed_seq is None
    state = legacy.snapshot()
    expected = legacy.unwrapped.bare.random_raw(2).tolist()
    legacy.restore(state)
    assert legacy.unwrapped.bare.random_raw(2).tolist() == expected


def test_views_stay_views():
    env = wrapped(Views)
    state = env.snapshot()
    for target in (env, env.clone()):
        target.restore(state)
        inner = target.unwrapped
        assert inner.row.base is inner.grid and inner.grid[2, 0] == [1]
        inner.memory[0] = 9
        assert inner.bytes[0] == 9 and inner.word.base is inner.bytes


def test_order_of_a_set_that_shrank():
    env = wrapped(Small)
    env.unwrapped.free = {(x, y) for x in range(20) for y in range(20)}
    for cell in list(env.unwrapped.free)[:390]:
        env.unwrapped.free.discard(cell)
    order = list(env.unwrapped.free)
    assert list(set(order)) != order, "the test needs a set whose order cannot be made again"
    state = env.snapshot()
    env.restore(state)
    assert list(env.unwrapped.free) == order
    env.unwrapped.free.discard(order[0])
    env.restore(state)
    assert sorted(env.unwrapped.free) == sorted(order)


Simulation = namedtuple("Simulation", "data name")


def _paid(data, reward):
    return reward + data.qpos[0]


@pytest.mark.parametrize("form", ["partial", "named tuple"])
def test_simulator_that_a_wrapper_holds(form):
    def make():
        env = gym.make("HalfCheetah-v5")
        data = env.unwrapped.data
        if form == "partial":
            return SnapshotEnvWrapper(TransformReward(env, functools.partial(_paid, data)))
        env = TransformReward(env, lambda reward: reward)
        env.simulation = Simulation(data, "cheetah")
        return SnapshotEnvWrapper(env)

    env, other = make(), make()
    env.reset(seed=0)
    state = env.snapshot()

    def rewards(target):
        return [reward for _, reward in [target.step(np.ones(6, np.float32))[:2] for _ in range(3)]]

    expected = rewards(env)
    for target in (env, other):
        target.restore(state)
        inner = target.env
        held = inner.func.args[0] if form == "partial" else inner.simulation.data
        assert held is target.unwrapped.data
        assert rewards(target) == expected


def test_function_with_a_cache_that_its_module_names():
    env = Small()
    env.advance = lambda: 1.0
    flat = functools.partial(spaces.flatten, env.observation_space)
    env = SnapshotEnvWrapper(TransformObservation(env, flat, env.observation_space))
    env.reset(seed=0)
    state = env.snapshot()
    expected = follow(env)
    clone = env.clone()
    for target in (env, clone):
        target.restore(state)
        assert follow(target) == expected
        assert target.env.func.func is spaces.flatten


class Linked(Small):
    def prepare(self):
        self.parts = [Settings(at=0.0), Settings(at=1.0)]
        self.chosen, self.gone = weakref.ref(self.parts[0]), weakref.ref(Node(0))
        self.me, self.again = weakref.ref(self), weakref.ref(self.parts[1])

    def advance(self):
        self.chosen().at += 1
        self.chosen = weakref.ref(self.parts[int(self.me().total) % 2])
        return self.chosen().at + self.again().at + (self.gone() is None)


def test_weak_references():
    env = wrapped(Linked)
    follow(env, 3)
    state, clone = env.snapshot(), env.clone()
    expected = follow(env)
    other = SnapshotEnvWrapper(Linked())
    for target in (clone, env, clone, other):
        target.restore(pickle.loads(pickle.dumps(state)))
        inner = target.unwrapped
        assert inner.me() is inner and any(inner.chosen() is part for part in inner.parts)
        assert follow(target) == expected
    del env.unwrapped.parts[1], target
    held, env.unwrapped.again = Settings(at=1.0), None
    env.unwrapped.chosen = weakref.ref(held)
    with pytest.raises(SnapshotUnsupportedError, match=r"is to a .*Settings that nothing else in it holds"):
        env.snapshot()
