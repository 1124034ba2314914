"""Shared pieces of the tests."""

import multiprocessing
from collections.abc import Callable, Iterator
from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_mcbs import MCBS, MCBSDDPG, MCBSSAC, MCBSTD3, MCBSTQC, MCBSCrossQ, SnapshotEnvWrapper
from sb3_mcbs.agents import learned_model
from sb3_mcbs.models import ensemble
from sb3_mcbs.snapshot import registry, verification

# Workers of environments are forks of a process that has imported this once, not each for itself.
multiprocessing.set_forkserver_preload(["sb3_mcbs"])
# Small networks are fastest on one thread, and idle OpenMP threads would take cores from the simulations.
th.set_num_threads(1)

SMALL = dict(policy_kwargs=dict(net_arch=[16, 16]), buffer_size=2000, batch_size=16, device="cpu")
SMALL_SEARCH = dict(beam_width=3, rollout_depth=2, n_simulations=2, model_kwargs=dict(n_threads=1))
#: Every algorithm that searches, and what it is without.
WITHOUT_SEARCH: dict[type[MCBS], type[OffPolicyAlgorithm]] = {
    MCBSTD3: TD3,
    MCBSDDPG: DDPG,
    MCBSSAC: SAC,
    MCBSTQC: TQC,
    MCBSCrossQ: CrossQ,
}
SEARCHING = list(WITHOUT_SEARCH)


class DictPendulum(gym.ObservationWrapper):
    """Pendulum whose observation is a Dict, so that only copies of the environment can simulate it."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        low, high = env.observation_space.low, env.observation_space.high
        self.observation_space = spaces.Dict(
            {"angle": spaces.Box(low[:2], high[:2]), "speed": spaces.Box(low[2:], high[2:])}
        )

    def observation(self, observation):
        return {"angle": observation[:2], "speed": observation[2:]}


@pytest.fixture(scope="session", autouse=True)
def _loggers_leave_nothing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """SB3's logger makes a folder for every agent that learns, in the system's temporary folder if untold."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SB3_LOGDIR", str(tmp_path_factory.mktemp("loggers")))
        yield


@pytest.fixture
def make_agent() -> Callable[..., MCBS]:
    """Build a small MCBSTD3, or another algorithm; keyword arguments override its settings."""

    def make(env="Pendulum-v1", policy: str = "MlpPolicy", cls: type = MCBSTD3, **settings) -> MCBS:
        search = SMALL_SEARCH if issubclass(cls, MCBS) else {}
        if search and "model_kwargs" in settings:
            settings["model_kwargs"] = {**search["model_kwargs"], **settings["model_kwargs"]}
        # SAC writes into the policy_kwargs that it is given.
        return cls(policy, env, **{"seed": 0, "learning_starts": 20, **deepcopy(SMALL), **search, **settings})

    return make


@pytest.fixture
def make_dict_env() -> Callable[[], gym.Env]:
    return lambda: DictPendulum(gym.make("Pendulum-v1"))


@pytest.fixture
def own_adapters() -> Iterator[None]:
    """Forget the adapters that a test registers."""
    before = list(registry._registered)
    yield
    registry._registered[:] = before
    registry._by_class.clear()
    for forget in registry._on_change:
        forget()


@pytest.fixture
def nothing_has_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Environments are checked as in a new process."""
    monkeypatch.setattr(verification, "_passed", type(verification._passed)())


@pytest.fixture(scope="module")
def small_ensembles() -> Iterator[None]:
    """Learned models with networks that are fitted in no time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ensemble, "HIDDEN", (24, 24))
        patch.setattr(ensemble, "BATCH_SIZE", 64)
        patch.setattr(learned_model, "LEAST_TRANSITIONS", 100)
        yield


def snapshot_vec_env(env_id: str, n_envs: int = 1, **kwargs):
    """A vectorized environment whose environments can be captured, as RL Zoo makes it."""
    return make_vec_env(env_id, n_envs, seed=0, wrapper_class=SnapshotEnvWrapper, **kwargs)


def parameters_of(agent) -> dict[str, np.ndarray]:
    return {name: value.detach().cpu().numpy().copy() for name, value in agent.policy.state_dict().items()}


def assert_same_parameters(left, right) -> None:
    left, right = parameters_of(left), parameters_of(right)
    assert left.keys() == right.keys()
    for name in left:
        np.testing.assert_array_equal(left[name], right[name], err_msg=name)
