"""Classes that are made inside functions: what they hold and close over is state of the environment."""

import abc
import dataclasses
import enum
import functools
import gc
import pickle
import threading
import typing
import weakref

import gymnasium as gym
import numpy as np
import pytest

from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotMismatchError, SnapshotUnsupportedError
from tests.test_snapshot_graph import Small, follow

T = typing.TypeVar("T")


def rebound_variable():
    n = 0

    class Env(Small):
        def advance(self):
            nonlocal n
            n += 1
            return n

    return Env()


def shared_list():
    n = [0]

    class Reader:
        def read(self):
            n[0] += 1
            return n[0]

    class Env(Small):
        def prepare(self):
            self.reader = Reader()

        def advance(self):
            return self.reader.read() + n[0]

    return Env()


def function_in_between():
    n = 0

    def tick():
        nonlocal n
        n += 1
        return n

    class Env(Small):
        def advance(self):
            return tick()

    return Env()


def class_in_between():
    n = [0]

    class Helper:
        def tick(self):
            n[0] += 1
            return n[0]

    class Env(Small):
        def advance(self):
            return Helper().tick()

    return Env()


def mutable_defaults():
    class Env(Small):
        def advance(self, rng=np.random.default_rng(0), *, more={}):  # noqa: B006, B008
            more[len(more)] = 1
            return rng.normal() + len(more)

    return Env()


def attributes():
    class Env(Small):
        seen: typing.ClassVar = []

        def advance(self):
            self.seen.append(1)
            Env.advance.calls[0] += 1
            return len(self.seen) + Env.advance.calls[0]

        advance.calls = [0]  # noqa: RUF012

    return Env()


def members_of_every_kind():
    n = [0]

    def tick():
        n[0] += 1
        return n[0]

    class Env(Small):
        @property
        def one(self):
            return tick()

        @staticmethod
        def two():
            return tick()

        @classmethod
        def three(cls):
            return tick()

        @functools.cached_property
        def four(self):
            return tick()

        def advance(self):
            return self.one + self.two() + self.three() + self.four

    return Env()


class Counting(type):
    def __new__(mcs, name, bases, namespace):
        return super().__new__(mcs, name, bases, {**namespace, "made": [0]})


def every_kind_of_class():
    n = [0]

    class Base(abc.ABC):
        @abc.abstractmethod
        def tick(self): ...

    class Abstract(Base):
        def tick(self):
            n[0] += 1
            return n[0] + isinstance(self, Base) * 10 + isinstance(self, Abstract) * 100 + isinstance(n, Base)

    class Box(typing.Generic[T]):
        def tick(self):
            return n[0]

    class Meta(metaclass=Counting):
        def tick(self):
            self.made[0] += 1
            return self.made[0]

    @dataclasses.dataclass(slots=True)
    class Slotted:
        x: int = 0

        def tick(self):
            self.x += 1
            return dataclasses.replace(self).x + n[0]

    class Pair(typing.NamedTuple):
        x: int = 0

        def tick(self):
            return self.x

    class Env(Small):
        def prepare(self):
            self.parts = [Abstract(), Box[int](), Meta(), Slotted(), Pair(3)]

        def advance(self):
            return sum(part.tick() for part in self.parts) + (type(self) is Env)

    return Env()


def inherited():
    n = [0]

    class Base(Small):
        def advance(self):
            n[0] += 1
            return n[0]

    class Env(Base):
        def advance(self):
            return super().advance() + super(Env, self).advance()  # noqa: UP008

    return Env()


def wrapper_and_decorator():
    n = [0]

    def counted(cls):
        original, k = cls.step, [0]

        def step(self, action):
            k[0] += 1
            observation, *rest = original(self, action)
            return observation + k[0], *rest

        cls.step = step
        return cls

    @counted
    class Wrapper(gym.Wrapper):
        def step(self, action):
            n[0] += 1
            observation, *rest = self.env.step(action)
            return observation + n[0], *rest

    return Wrapper(Small())


MAKERS = [
    rebound_variable,
    shared_list,
    function_in_between,
    class_in_between,
    mutable_defaults,
    attributes,
    members_of_every_kind,
    every_kind_of_class,
    inherited,
    wrapper_and_decorator,
]


@pytest.mark.parametrize("make", MAKERS)
def test_same_future_everywhere(make):
    env, other = SnapshotEnvWrapper(make()), SnapshotEnvWrapper(make())
    env.reset(seed=0)
    follow(env, 3)
    state, clone = env.snapshot(), env.clone()
    expected = follow(env)
    assert follow(clone) == expected and follow(env) != expected
    other.reset(seed=1)
    follow(other, 1)
    for target in (env, clone, other, env):
        target.restore(state)
        assert follow(target) == expected
    env.restore(state)
    follow(clone)
    assert follow(env) == expected


@pytest.mark.parametrize("make", MAKERS)
def test_a_pickled_snapshot_needs_a_class_of_the_same_lines(make):
    env = SnapshotEnvWrapper(make())
    env.reset(seed=0)
    follow(env, 3)
    state = pickle.loads(pickle.dumps(env.snapshot()))
    expected = follow(env)
    other = SnapshotEnvWrapper(make())
    other.restore(state)
    assert follow(other) == expected


def test_a_class_of_other_lines_is_refused():
    def make(step):
        class Reader:
            count: typing.ClassVar = [0]
            read = step

        env = Small()
        env.reader = Reader()
        return SnapshotEnvWrapper(env)

    state = pickle.loads(pickle.dumps(make(lambda self: 1).snapshot()))
    with pytest.raises(
        SnapshotMismatchError, match=r"make\.<locals>\.Reader, which is made inside a function"
    ):
        make(lambda self: 2).restore(state)


def test_classes_without_state_are_shared():
    class Color(enum.Enum):
        RED = 1

    class Point:
        sizes = (1, 2)

        def __init__(self):
            self.x = Color.RED

    class Env(Small):
        color: typing.ClassVar = Color.RED

        def prepare(self):
            self.point = Point()

    env = SnapshotEnvWrapper(Env())
    clone = env.clone()
    assert type(clone.unwrapped) is Env and type(clone.unwrapped.point) is Point
    assert clone.unwrapped.point is not env.unwrapped.point


def test_abstract_classes_have_caches_of_their_own():
    made = SnapshotEnvWrapper(every_kind_of_class()).clone().unwrapped.parts[0]
    cls, base = type(made).__mro__[:2]
    assert cls.__qualname__.endswith("Abstract") and base.__qualname__.endswith("Base")
    assert isinstance(made, base) and not isinstance(3, base) and "_abc_impl" in vars(cls)
    assert isinstance(cls(), base)
    with pytest.raises(TypeError, match="abstract"):
        base()


def test_classes_of_clones_are_forgotten():
    env = SnapshotEnvWrapper(shared_list())
    classes = []
    for _ in range(5):
        clone = env.clone()
        clone.restore(clone.snapshot())
        classes.append(weakref.ref(type(clone.unwrapped.reader)))
    del clone
    gc.collect()
    assert [cls() for cls in classes] == [None] * 5


def test_what_a_class_closes_over_may_be_refused():
    lock = threading.Lock()

    class Env(Small):
        def advance(self):
            with lock:
                return 1.0

    with pytest.raises(SnapshotUnsupportedError, match=r"\(advance of the class .*Env\) \(variable lock of "):
        SnapshotEnvWrapper(Env())
