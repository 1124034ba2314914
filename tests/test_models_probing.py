"""What a pool finds out about an environment: randomness, late refusals, ends of episodes; its roots."""

import enum
import logging
import os
import pickle
import threading
import warnings
from collections.abc import Iterator

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_mcbs import SearchPolicy
from sb3_mcbs.models import EnvPoolModel, ForwardModelError, LocalEnvironments, WorkerEnvironments
from sb3_mcbs.models.copies import copies_of
from sb3_mcbs.models.probing import Randomness, probe_randomness
from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotUnsupportedError

HIDDEN = [0]


pytestmark = pytest.mark.usefixtures("nothing_has_passed")


class Point(gym.Env):
    """A point that the actions push, and ``push`` besides."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, last: int = 10**9) -> None:
        self.x, self.age, self.last = np.zeros(2, np.float32), 0, last

    def push(self) -> float:
        return 0.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.age = self.np_random.uniform(0, 1, 2).astype(np.float32), 0
        return self.x.copy(), {}

    def step(self, action):
        if self.age == self.last:
            raise RuntimeError("the episode is over")
        self.age += 1
        self.x = self.x + np.float32(0.1 * np.sum(action) + self.push())
        return self.x.copy(), float(self.x[0]), False, self.age == self.last, {}


def pool(env: SnapshotEnvWrapper) -> EnvPoolModel:
    return EnvPoolModel(LocalEnvironments([env]))


def start(model: EnvPoolModel, rows: int) -> None:
    model.set_roots(model.read_roots([0]), np.zeros(rows, dtype=int), np.random.default_rng(0))


# --- randomness ------------------------------------------------------------------------------------------


class Entropy(Point):
    def push(self) -> float:
        return os.urandom(1)[0] / 256


class Late(Point):
    """Its state is elsewhere, but only where the first two episodes of a check do not come."""

    def push(self) -> float:
        HIDDEN[0] += 1
        return HIDDEN[0] * (self.np_random.bit_generator.seed_seq.entropy == 2)


class ClassState(Late):
    moves = 0

    def push(self) -> float:
        type(self).moves += 1
        return self.moves * (self.np_random.bit_generator.seed_seq.entropy == 2)


@pytest.mark.parametrize("cls", [Late, ClassState])
def test_results_that_differ_although_nothing_was_drawn(cls, caplog) -> None:
    env = SnapshotEnvWrapper(cls())
    assert env.verify(), "the test needs an environment that the check does not find"
    with pytest.raises(
        SnapshotUnsupportedError, match=f"steps of {cls.__name__} do not repeat .* generator moved"
    ):
        probe_randomness(env)
    with caplog.at_level(logging.WARNING, logger="sb3_mcbs"):
        found = probe_randomness(SnapshotEnvWrapper(cls(), verify=False))
    assert found == Randomness(any=True, shared=False)
    assert "taken for random dynamics, as verify=False asks for" in caplog.text


def test_hidden_randomness_on_request(caplog) -> None:
    with pytest.raises(SnapshotUnsupportedError, match="After a restore step 1 of Entropy"):
        pool(SnapshotEnvWrapper(Entropy()))
    env = SnapshotEnvWrapper(Monitor(SnapshotEnvWrapper(Entropy(), verify=False)))
    assert not pool(env).deterministic and "Entropy do not repeat themselves" in caplog.text


class Method(Point):
    def __init__(self) -> None:
        super().__init__()
        self.draw = np.random.normal

    def push(self) -> float:
        return self.draw()


def test_a_held_method_of_a_global_generator() -> None:
    """Its copies draw from the same generator, which is put back after every look-ahead."""
    env = SnapshotEnvWrapper(Method())
    env.reset(seed=0)
    model = pool(env)
    assert copies_of(env, model._name).isolate and not model.deterministic
    start(model, 3)
    before = str(np.random.get_state())
    assert len(np.unique(model.step(np.zeros((3, 1), np.float32)).rewards)) == 3
    assert str(np.random.get_state()) == before


# --- resets ----------------------------------------------------------------------------------------------


class Aimed(Point):
    """Its first reset needs options; later ones keep the goal."""

    goal: float

    def reset(self, *, seed=None, options=None):
        self.goal = options["goal"] if options else self.goal
        return super().reset(seed=seed)

    def push(self) -> float:
        return self.goal


class RandomAimed(Aimed):
    def push(self) -> float:
        return self.goal + self.np_random.normal()


def aimed(cls: type = Aimed) -> DummyVecEnv:
    vec_env = DummyVecEnv([lambda: Monitor(TimeLimit(cls(), 15))])
    vec_env.set_options({"goal": 0.25})
    return vec_env


def test_an_agent_whose_environment_needs_options(make_agent) -> None:
    agent = make_agent(aimed())
    assert "show after the first reset" in agent.planner.description
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        agent.learn(60)
    assert agent.planner.model.deterministic and agent.n_decisions > 0
    assert agent.planner.description.startswith("pool of environment copies (deterministic dynamics)")


def test_random_dynamics_that_show_after_the_first_reset(make_agent) -> None:
    agent = make_agent(aimed(RandomAimed)).learn(60)
    assert not agent.planner.model.deterministic
    single = make_agent(aimed(RandomAimed), n_simulations=1, strategy="tree")
    with pytest.raises(ValueError, match="random"):
        single.learn(60)


def test_resets_of_a_probe_have_the_options_of_the_last_one() -> None:
    class Weather(Point):
        windy = False

        def reset(self, *, seed=None, options=None):
            self.windy = bool(options)
            return super().reset(seed=seed)

        def push(self) -> float:
            return self.np_random.normal() if self.windy else 0.0

    env = SnapshotEnvWrapper(Weather())
    for options in (None, {"wind": 1}):
        env.reset(seed=0, options=options)
        assert probe_randomness(env) == Randomness(bool(options), False)


def test_a_refusal_that_only_a_reset_can_bring(make_agent) -> None:
    class Locked(Aimed):
        def reset(self, **kwargs):
            result = super().reset(**kwargs)
            self.lock = threading.Lock()
            return result

    class LockedAtOnce(Locked):
        goal = 0.0

    with pytest.raises(SnapshotUnsupportedError, match=r"LockedAtOnce\.lock cannot be part of a snapshot"):
        make_agent(LockedAtOnce())
    agent = make_agent(aimed(Locked), learning_starts=5)
    with pytest.raises(SnapshotUnsupportedError, match=r"Locked\.lock cannot be part of a snapshot"):
        agent.learn(60)
    assert agent.num_timesteps <= 6, "at the first search, which is the first chance"


def test_an_environment_that_forbids_early_resets_is_probed_where_it_is() -> None:
    class Strict(Point):
        def reset(self, **kwargs):
            if self.age:
                raise RuntimeError("not in the middle of an episode")
            return super().reset(**kwargs)

    class StrictAndRandom(Strict):
        def push(self) -> float:
            return self.np_random.normal()

    for cls, random in ((Strict, False), (StrictAndRandom, True)):
        env = SnapshotEnvWrapper(cls(), verify=False)
        assert probe_randomness(env) is None
        env.reset(seed=0)
        env.step(np.ones(1, np.float32))
        assert probe_randomness(env) == Randomness(random, False)


# --- actions and ends ------------------------------------------------------------------------------------


class NoShape(Point):
    action_space = spaces.Box(-1, 1, (), np.float32)


def test_actions_that_are_single_numbers(make_agent) -> None:
    agent = make_agent(TimeLimit(NoShape(), 15)).learn(40)
    assert agent.planner.model.deterministic and agent.n_decisions > 0
    env = SnapshotEnvWrapper(NoShape())
    env.reset(seed=0)
    model = pool(env)
    start(model, 3)
    actions = np.array([0.1, 0.2, 0.3], np.float32)
    assert model.step(actions).rewards[1] == env.step(actions[1])[1]


def test_an_episode_that_the_environment_truncates_is_not_stepped_on(caplog) -> None:
    env = SnapshotEnvWrapper(TimeLimit(Point(last=3), 100))
    env.reset(seed=0)
    model = pool(env)
    start(model, 2)
    actions = np.full((2, 1), 0.5, np.float32)
    for age in range(1, 4):
        found = model.step(actions)
        assert found.valid.all() and not found.terminated.any()
        assert (None if found.stopped is None else found.stopped.tolist()) == (
            None if age < 3 else [True] * 2
        )
    assert found.goes_on.tolist() == [False, False]
    model.select(np.array([0, 0, 1]))
    after = model.step(np.full((3, 1), 0.5, np.float32))
    assert after.stopped.tolist() == [True] * 3 and after.valid.all() and after.rewards.tolist() == [0] * 3
    np.testing.assert_array_equal(after.observations[2], found.observations[1])
    assert caplog.text == "", "no copy raised"
    start(model, 2)
    assert model.step(actions).stopped is None, "copies go on from new roots"


def test_time_limits_stop_nothing() -> None:
    env = SnapshotEnvWrapper(TimeLimit(Point(), 2))
    env.reset(seed=0)
    model = pool(env)
    start(model, 1)
    for _ in range(4):
        found = model.step(np.zeros((1, 1), np.float32))
        assert found.stopped is None and found.goes_on.all()


@pytest.mark.parametrize("settings", [{}, dict(strategy="tree"), dict(preset="balanced")])
def test_agents_learn_where_the_environment_truncates(make_agent, settings) -> None:
    agent = make_agent(Point(last=7), **{"learning_starts": 10, **settings}).learn(60)
    assert agent.n_decisions > 0 and agent.replay_buffer.timeouts.sum() == 8
    assert agent.planner.model.deterministic
    policy = SearchPolicy(agent, DummyVecEnv([lambda: Point(last=1)]), seed=0, rollout_depth=3)
    policy.predict(policy.vec_env.reset())
    assert np.isfinite(policy.last_result.values).all()


# --- roots -----------------------------------------------------------------------------------------------


def unpicklable() -> SnapshotEnvWrapper:
    class Mode(enum.Enum):
        ONLY = 1

    env = Point()
    env.mode = Mode.ONLY  # a snapshot of it cannot be sent anywhere
    return SnapshotEnvWrapper(env)


def count_roots(wrapper: SnapshotEnvWrapper, name: str) -> int:
    return len(copies_of(wrapper, name).roots)


@pytest.fixture
def workers() -> Iterator[SubprocVecEnv]:
    vec_env = SubprocVecEnv([unpicklable] * 2, start_method="fork")
    yield vec_env
    vec_env.close()


def test_snapshots_stay_in_their_workers(workers: SubprocVecEnv, make_agent) -> None:
    env = unpicklable()
    env.reset(seed=0)
    with pytest.raises((AttributeError, pickle.PicklingError), match="local"):
        pickle.dumps(env.snapshot())
    policy = SearchPolicy(
        make_agent(Point(), rollout_depth=0), workers, seed=0, rollout_depth=2, beam_width=3
    )
    observations = workers.reset()
    for _ in range(4):
        actions, _ = policy.predict(observations)
        predicted = policy.last_result.first_step.observations
        observations, *_ = workers.step(actions)
        np.testing.assert_array_equal(predicted, observations)
    policy.close()


def test_roots_that_nobody_holds_are_forgotten(workers: SubprocVecEnv) -> None:
    workers.reset()
    environments = WorkerEnvironments(workers)
    model = EnvPoolModel(environments)
    kept = model.read_roots([0, 1])
    for _ in range(5):
        roots = model.read_roots([0, 1])
    assert max(environments.apply([0, 1], count_roots, model._name)) <= 3
    workers.step(np.ones((2, 1), np.float32))
    rewards = []
    for some in (kept, roots):
        model.set_roots(some, np.arange(2), np.random.default_rng(0))
        rewards.append(model.step(np.ones((2, 1), np.float32)).rewards.tolist())
    assert rewards[0] == rewards[1]
    model.refresh()
    with pytest.raises(ForwardModelError, match="before the model was refreshed: read them again"):
        model.set_roots(kept, np.arange(2), np.random.default_rng(0))
    model.close()
