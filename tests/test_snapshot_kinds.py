"""Snapshots of spaces, parts of simulators and objects of well-known packages, and what is refused."""

import copy
import io
import mmap
import pickle
import queue
import random
import threading
import types
import weakref

import gymnasium as gym
import mujoco
import numpy as np
import pandas as pd
import pytest
import sympy
from gymnasium import spaces

from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotUnsupportedError, handlers
from tests.test_snapshot_graph import Small, follow, wrapped


def assert_same_future(cls):
    """Follow a snapshot where it was taken, in a clone, and in another instance that took none of the steps.

    :return: the environment and its clone, both in the state of the snapshot.
    """
    env, other = wrapped(cls), SnapshotEnvWrapper(cls())
    follow(env, 3)
    state = env.snapshot()
    clone = env.clone()
    expected = follow(env)
    assert follow(clone) == expected and follow(env) != expected
    for target in (env, clone, other, env):
        target.restore(pickle.loads(pickle.dumps(state)))
        assert follow(target) == expected
    env.restore(state)
    clone.restore(state)
    return env, clone


# --- spaces ----------------------------------------------------------------------------------------------


def box(n):
    return spaces.Box(-n, n, (2,), np.float32)


SPACES = {
    "box": box,
    "integers": lambda n: spaces.Box(0, n + 1, (2,), np.int64),
    "discrete": lambda n: spaces.Discrete(n + 2, start=n),
    "multi discrete": lambda n: spaces.MultiDiscrete([n + 1, 2]),
    "binary": lambda n: spaces.MultiBinary(n + 1),
    "text": lambda n: spaces.Text(n + 2),
    "dict": lambda n: spaces.Dict({"z": box(n), "a": spaces.Tuple((spaces.Discrete(n + 1), box(2)))}),
    "sequence": lambda n: spaces.Sequence(spaces.Dict({"x": box(n)})),
    "graph": lambda n: spaces.Graph(box(n), spaces.Discrete(n + 1)),
    "one of": lambda n: spaces.OneOf((box(n), spaces.Discrete(n + 1))),
}


def total(sample):
    if isinstance(sample, str):
        return float(sum(map(ord, sample)))
    parts = sample.values() if isinstance(sample, dict) else sample
    if isinstance(parts, tuple | type({}.values())):
        return sum(total(part) for part in parts if part is not None)
    return float(np.sum(sample))


@pytest.mark.parametrize("exchanged", [True, False])
@pytest.mark.parametrize("name", SPACES)
def test_spaces(name, exchanged):
    class Drawing(Small):
        def prepare(self):
            self.exchange(1)

        def exchange(self, n):
            self.number, self.space = n, SPACES[name](n)
            self.space.seed(n)

        def advance(self):
            drawn = total(self.space.sample())
            if exchanged:
                self.exchange(self.number % 4 + 1)
            return drawn + self.number / 7

    env = wrapped(Drawing)
    follow(env, 2)
    space, state = env.unwrapped.space, env.snapshot()
    clone, expected = env.clone(), follow(env)
    assert follow(clone) == expected
    for target in (env, clone, wrapped(Drawing)):
        target.restore(pickle.loads(pickle.dumps(state)))
        assert target.unwrapped.space == space
        assert follow(target) == expected
    if not exchanged:
        assert env.unwrapped.space is space, "others may hold it"


def test_spaces_that_are_edited():
    class Edited(Small):
        def prepare(self):
            self.space, self.choices = box(1), spaces.Dict({"a": spaces.Discrete(2)})

        def advance(self):
            self.space.high[0] += 1
            self.choices.spaces[str(len(self.choices))] = spaces.Discrete(2)
            return float(self.space.high.sum()) + len(self.choices)

    assert_same_future(Edited)


def test_what_spaces_share_and_hold_besides_stays_so_in_clones():
    class Rounded(spaces.Box):
        """Holds a function with state, and a list."""

        def __init__(self):
            super().__init__(-1, 1, (2,), np.float64)
            digits = [2]
            self.digits, self.round = digits, lambda value: np.round(value, digits[0])

        def sample(self, mask=None, probability=None):
            return self.round(super().sample())

    class Sharing(Small):
        def prepare(self):
            self.inner = Rounded()
            self.outer = spaces.Dict({"a": self.inner, "b": spaces.Discrete(3)})
            self.outer.seed(0)

        def advance(self):
            return float(self.inner.sample().sum()) + float(self.outer.sample()["a"].sum())

    env = wrapped(Sharing)
    follow(env, 3)
    state, clone = env.snapshot(), env.clone()
    expected = follow(env)
    assert follow(clone) == expected
    for target in (env, clone):
        target.restore(state)
        assert follow(target) == expected
        assert target.unwrapped.outer["a"] is target.unwrapped.inner
    clone.unwrapped.inner.digits[0] = 0
    assert env.unwrapped.inner.digits == [2] and float(clone.unwrapped.inner.sample()[0]).is_integer()


def test_the_action_space_of_the_environment():
    class Narrowing(Small):
        def advance(self):
            self.action_space = spaces.Box(-1, float(self.action_space.high[0]) / 2 + 1, (1,), np.float64)
            return float(self.action_space.high[0])

    env, clone = assert_same_future(Narrowing)
    assert env.unwrapped.action_space == clone.unwrapped.action_space != Narrowing.action_space


# --- parts of MuJoCo -------------------------------------------------------------------------------------

XML = """<mujoco><option timestep="0.01"/><worldbody>
<body name="arm"><joint name="hinge"/><geom name="skin" size="0.1 0.1" type="capsule"/></body>
</worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""


class Simulation:
    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(XML)
        self.data = mujoco.MjData(self.model)


class Robot(Small):
    """Holds views and parts of a simulator that is met only after them."""

    def prepare(self):
        simulation = Simulation()
        self.angle = simulation.data.qpos[:1]
        self.parts = {"arm": simulation.data.body("arm"), "hinge": simulation.data.joint("hinge")}
        self.skin, self.options = simulation.model.geom("skin"), simulation.model.opt
        self.gravity = simulation.model.opt.gravity
        self.deeper = types.SimpleNamespace(simulation=simulation, gain=1.0)

    def advance(self):
        simulation = self.deeper.simulation
        self.gravity[0] += 1.0
        self.options.timestep += 0.001
        self.skin.friction[0] += 0.1
        self.deeper.gain += 0.5
        simulation.data.ctrl[0] = self.deeper.gain
        mujoco.mj_step(simulation.model, simulation.data)
        return float(
            self.angle[0] + self.parts["arm"].xpos[2] + self.parts["hinge"].qvel[0] + self.skin.friction[0]
        )


def test_parts_of_mujoco_that_are_met_before_it():
    env, clone = assert_same_future(Robot)
    for target in (env, clone):
        inner = target.unwrapped
        data, model = inner.deeper.simulation.data, inner.deeper.simulation.model
        data.qpos[0], data.qvel[0], model.opt.timestep, model.opt.gravity[0] = 3.0, 4.0, 5.0, 6.0
        assert inner.angle[0] == 3 and inner.parts["hinge"].qvel[0] == 4
        assert inner.options.timestep == 5 and inner.gravity[0] == 6 and inner.skin.name == "skin"
    assert clone.unwrapped.skin.friction[0] == env.unwrapped.skin.friction[0]
    clone.unwrapped.skin.friction[0] = 9
    assert env.unwrapped.skin.friction[0] != 9


# --- objects of well-known packages ----------------------------------------------------------------------


class Simulated(Small):
    """A base environment that calls its simulator ``env``, and wrappers set things on it."""

    def prepare(self):
        self.env = types.SimpleNamespace(level=[0.0])

    def advance(self):
        self.env.level[0] += 1
        return self.env.level[0]


class Frames(Small):
    def prepare(self):
        self.prices = pd.DataFrame(
            {"open": np.arange(5.0), "name": list("abcde")}, pd.date_range("2020", periods=5)
        )
        self.last, self.day = self.prices["open"].copy(), pd.Timestamp("2020")

    def advance(self):
        self.prices.loc[self.day, "open"] += 1
        self.last.iloc[0] += 1
        self.day = min(self.day + pd.Timedelta(days=1), self.prices.index[-1])
        self.prices["more"] = self.prices["open"] * 2
        return float(self.prices["more"].sum() + self.last.iloc[0])


class Game(Small):
    """Pygame's rectangles, vectors and sprites are state, though it is a package that draws."""

    def prepare(self):
        pygame = pytest.importorskip("pygame")
        self.place, self.speed = pygame.Rect(0, 0, 2, 2), pygame.Vector2(1, 0)
        self.sprite, self.group = pygame.sprite.Sprite(), pygame.sprite.Group()
        self.sprite.rect = self.place
        self.group.add(self.sprite)

    def advance(self):
        self.speed.x += 1
        self.place.move_ip(self.speed)
        self.group.sprites()[0].rect.y += 1
        return float(self.place.x + self.place.y + len(self.group))


class Buffers(Small):
    def prepare(self):
        self.log, self.bytes = io.StringIO(), io.BytesIO(b"abc")
        self.settings = {"gain": [1.0]}
        self.frozen = types.MappingProxyType(self.settings)

    def advance(self):
        self.bytes.read(1)
        self.settings["gain"][0] += 1
        return self.log.write("x") + self.log.tell() + self.bytes.tell() + self.frozen["gain"][0]


@pytest.mark.parametrize("cls", [Simulated, Frames, Game])
def test_objects_of_well_known_packages(cls):
    assert_same_future(cls)


def test_buffers_and_views_of_dictionaries():
    env = wrapped(Buffers)
    state = env.snapshot()
    expected = follow(env)
    for target in (env, env.clone()):
        target.restore(state)
        assert follow(target) == expected
        assert target.unwrapped.frozen["gain"] is target.unwrapped.settings["gain"]


class GlobalNoise(Small):
    def prepare(self):
        self.draws = [np.random.normal, random.random, np.random.mtrand._rand.uniform]

    def advance(self):
        return sum(draw() for draw in self.draws)


def test_generators_of_the_process_are_nobodys_state():
    env = wrapped(GlobalNoise)
    state, clone = env.snapshot(), env.clone()
    assert clone.unwrapped.draws[0].__self__ is np.random.mtrand._rand
    np.random.seed(1)
    random.seed(1)
    before = str(np.random.get_state()), random.getstate()
    for rng in ("restore", "keep", np.random.default_rng(3)):
        env.restore(state, rng=rng)
        assert (str(np.random.get_state()), random.getstate()) == before


# --- what is refused, and where --------------------------------------------------------------------------


class Nested:
    def __init__(self, inside):
        self.inside = inside


def deep(n):
    value = Nested(None)
    for _ in range(n):
        value = Nested(value)
    return value


@pytest.mark.parametrize(
    "make, path, reason",
    [
        # From Python 3.13 on, a thread's first attribute is its handle.
        (threading.Thread, r"\.thing\.(_started\._cond\._lock|_handle)", "_thread.(lock|_ThreadHandle)"),
        (threading.RLock, r"\.thing", "_thread.RLock"),
        (queue.Queue, r"\.thing\.mutex", "_thread.lock"),
        (lambda: Nested([open(__file__)]), r"\.thing\.inside\[0\]", "open file, socket or pipe"),  # noqa: SIM115
        (lambda: (n for n in ()), r"\.thing", "generator"),
        (lambda: mmap.mmap(-1, 8), r"\.thing", "mmap"),
        (lambda: deep(2000), r"\.thing", "too many levels"),
    ],
    ids=["thread", "lock", "queue", "file", "generator", "mmap", "depth"],
)
def test_what_cannot_be_captured_is_named(make, path, reason):
    env = Small()
    env.thing = make()
    with pytest.raises(
        SnapshotUnsupportedError, match=rf"Small{path} cannot be part of a snapshot: .*{reason}"
    ):
        SnapshotEnvWrapper(env)


def test_objects_that_cannot_be_made_again_are_named():
    class Symbolic(Small):
        def prepare(self):
            self.formula = {"sine": sympy.sin(sympy.Symbol("x"))}

    env = SnapshotEnvWrapper(Symbolic())
    env.reset(seed=0)
    formula = env.unwrapped.formula
    with pytest.raises(
        SnapshotUnsupportedError, match=r"Symbolic\.formula.* making another sympy\.\S+ of the same"
    ):
        env.snapshot()
    assert env.unwrapped.formula is formula and formula["sine"].subs("x", 0) == 0


# --- copies of the wrapper itself ------------------------------------------------------------------------


class Selfish(Small):
    def prepare(self):
        self.me, self.count = self, [0]

    def advance(self):
        self.me.count[0] += 1
        return self.count[0]


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copied_wrapper_knows_its_own_layers(duplicate):
    env = SnapshotEnvWrapper(gym.wrappers.TimeLimit(Selfish(), 99))
    env.reset(seed=0)
    follow(env, 2)
    env.snapshot()
    made = duplicate(env)
    assert made.unwrapped is not env.unwrapped
    state, expected = made.snapshot(), follow(made)
    for target in (made, made.clone()):
        target.restore(state)
        assert target.unwrapped.me is target.unwrapped
        assert follow(target) == expected


def test_a_weak_proxy_that_is_dead_when_it_is_first_met():
    class Remembering(Small):
        def prepare(self):
            self.last = weakref.proxy(Small())

    handlers._forget()
    env, clone = assert_same_future(Remembering)
    assert type(env.unwrapped.last) is type(clone.unwrapped.last) is weakref.ProxyType
