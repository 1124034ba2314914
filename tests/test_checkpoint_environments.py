"""Exact checkpoints of environments that hold what a snapshot holds since they are checked."""

import os
import subprocess
import sys
import warnings
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_mcbs import MCBSTD3, ExactCheckpointCallback, SnapshotEnvWrapper, resume
from sb3_mcbs.checkpoints import CheckpointError
from sb3_mcbs.snapshot import SnapshotUnsupportedError
from tests.checkpoint_helpers import assert_resumed_is_exact, crash, learn
from tests.test_checkpoints import SEARCH, SMALL


class Point(gym.Env):
    """A point that ``push`` moves besides the action."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-9, 9, (2,), np.float32)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.prepare()

    def prepare(self) -> None:
        pass

    def push(self) -> float:
        return 0.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.age = self.np_random.uniform(-1, 1, 2), 0
        return self.x.astype(np.float32), {}

    def step(self, action):
        self.age += 1
        self.x = np.clip(0.9 * self.x + 0.1 * float(action[0]) + 0.01 * self.push(), -9, 9)
        return self.x.astype(np.float32), -float(self.x @ self.x), False, self.age >= 20, {}


def of_local_classes() -> gym.Env:
    n = [0.0]

    class Helper:
        calls = [0]  # noqa: RUF012

        def tick(self, mode: str = "up") -> float:
            if mode in {
                "up",
                "down",
                "left",
                "right",
                "in",
                "out",
                "on",
                "off",
            }:  # a constant whose order is another in every process
                n[0] += 1
            self.calls[0] += 1
            return n[0] + self.calls[0] % 3

    class Env(Point):
        def prepare(self) -> None:
            self.helper = Helper()

        def push(self) -> float:
            return self.helper.tick() % 11

    return Env()


class WithTensors(Point):
    def prepare(self) -> None:
        with th.random.fork_rng():
            th.manual_seed(0)
            self.network = th.nn.Linear(2, 1)
        self.memory = th.zeros(2)

    def push(self) -> float:
        self.memory += self.network(th.as_tensor(self.x, dtype=th.float32)).detach()
        return float(self.memory.sum()) % 5


class WithDrawings(Point):
    def prepare(self) -> None:
        pygame = pytest.importorskip("pygame")
        self.world, self.at = pygame.Surface((6, 6)), pygame.Vector2(0, 1)
        self.part, self.mask = self.world.subsurface((1, 1, 4, 4)), pygame.Mask((3, 3))

    def push(self) -> float:
        self.at.x += 1
        self.part.set_at((int(self.at.x) % 4, 1), (int(self.at.x) % 200, 0, 0))
        self.mask.set_at((int(self.at.x) % 3, 1))
        return float(sum(self.world.get_at((x, 2))[0] for x in range(6)) + self.mask.count()) % 7


class WithSpaces(Point):
    def prepare(self) -> None:
        self.exchange(1)

    def exchange(self, n: int) -> None:
        self.n, self.goals = n, spaces.Dict({"a": spaces.Discrete(n + 3), "b": spaces.Box(0, n, (1,))})
        self.goals.seed(n)

    def push(self) -> float:
        goal = self.goals.sample()
        if goal["a"] == 0:
            self.exchange(self.n % 4 + 1)
        return float(goal["a"] + goal["b"][0])


class Pushing(gym.Wrapper):
    """Sets something on the Monitor that it wraps."""

    def __init__(self) -> None:
        super().__init__(Monitor(Point()))
        self.env.observation_space = spaces.Box(-99, 99, (2,), np.float32)
        self.env.n_pushes = 0
        self.env.step = partial(self.push, self.env.step)

    def push(self, step, action):
        self.env.n_pushes += 1
        observation, *rest = step(action)
        return (observation + self.env.n_pushes % 3).astype(np.float32), *rest


def env_of(make):
    return lambda folder: DummyVecEnv([lambda: Monitor(make(), str(folder / "monitor.csv"))])


@pytest.mark.parametrize("make", [of_local_classes, WithTensors, WithDrawings, WithSpaces, Pushing])
def test_resumed_is_exact(make, tmp_path: Path) -> None:
    def agent(folder: Path):
        networks = dict(net_arch=[16, 16])
        folder.mkdir(exist_ok=True)
        return MCBSTD3(
            "MlpPolicy", env_of(make)(folder), policy_kwargs=networks, buffer_size=90, **SMALL, **SEARCH
        )

    whole, resumed = assert_resumed_is_exact(agent, tmp_path, make_env=env_of(make))
    left, right = (each.env.envs[0].unwrapped.x for each in (whole, resumed))
    np.testing.assert_array_equal(left, right)


IN_ANOTHER_PROCESS = """
import sys
from pathlib import Path
from sb3_mcbs import resume
from tests.checkpoint_helpers import learn
from tests.test_checkpoint_environments import env_of, of_local_classes
folder = Path(sys.argv[1])
print(learn(resume(folder / "checkpoints", env_of(of_local_classes)(folder)), folder, 80).num_timesteps)
"""


def test_local_classes_are_known_again_in_another_process(tmp_path: Path) -> None:
    crash(lambda folder: TD3("MlpPolicy", env_of(of_local_classes)(folder), **SMALL), tmp_path, 80, 70)
    other_hashes = {**os.environ, "PYTHONHASHSEED": "1"}
    command = [sys.executable, "-c", IN_ANOTHER_PROCESS, str(tmp_path)]
    done = subprocess.run(command, env=other_hashes, capture_output=True, text=True)
    assert done.stdout == "80\n", done.stderr


def test_a_local_class_of_other_lines_is_refused(tmp_path: Path) -> None:
    def of_other_lines() -> gym.Env:
        env = of_local_classes()
        type(env.helper).tick = lambda self: 1.0
        return env

    crash(lambda folder: TD3("MlpPolicy", env_of(of_local_classes)(folder), **SMALL), tmp_path, 150, 105)
    resumed = resume(tmp_path / "checkpoints", env_of(of_other_lines)(tmp_path))
    with pytest.raises(CheckpointError, match=r"refers to local .*of_local_classes\.<locals>\.Helper"):
        learn(resumed, tmp_path, 150)


class ClassState(Point):
    count = 0

    def push(self) -> float:
        type(self).count += 1
        return self.count % 7


class Counting(ClassState):
    def step(self, action):
        STEPPED.append(1)
        return super().step(action)


STEPPED: list[int] = []


def test_what_is_not_exact_is_refused_before_training(tmp_path: Path) -> None:
    """Also by an agent without search, and where a checkpoint that fails would only be a warning."""
    agent = TD3("MlpPolicy", env_of(Point)(tmp_path), **SMALL)
    callback = ExactCheckpointCallback(20, tmp_path / "checkpoints")
    agent.learn(50, callback)
    agent.set_env(env_of(ClassState)(tmp_path))
    with pytest.raises(SnapshotUnsupportedError, match="After a restore step 1 of ClassState"):
        agent.learn(50, callback, reset_num_timesteps=False)
    assert agent.num_timesteps == 50
    fresh = TD3("MlpPolicy", env_of(Counting)(tmp_path), **SMALL)
    with pytest.raises(SnapshotUnsupportedError, match="After a restore step 1 of Counting"):
        learn(fresh, tmp_path / "fresh", 50)
    assert fresh.num_timesteps == 0 and 0 < len(STEPPED) < 60, "what was stepped was the check"


def test_without_a_check_where_that_was_asked_for(tmp_path: Path) -> None:
    env = SnapshotEnvWrapper(ClassState(), verify=False)
    learn(TD3("MlpPolicy", env, **SMALL), tmp_path, 50)


class Aimed(Point):
    def reset(self, *, seed=None, options=None):
        if not hasattr(self, "goal") and not options:
            raise ValueError("a goal is missing")
        self.goal = (options or {}).get("goal", 0)
        return super().reset(seed=seed)


def test_an_evaluation_that_cannot_be_reset_yet_is_no_reason(tmp_path: Path) -> None:
    agent = TD3("MlpPolicy", env_of(Point)(tmp_path), **SMALL)
    later = EvalCallback(DummyVecEnv([lambda: Monitor(Aimed())]), eval_freq=10**6)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        agent.learn(50, callback=[ExactCheckpointCallback(20, tmp_path / "checkpoints"), later])
