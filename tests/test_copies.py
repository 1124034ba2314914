"""Copies of agents, and of what acts with search: with networks and environments of their own."""

import copy
import os
import pickle

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_mcbs import MCBSSAC, MCBSTD3, SearchPolicy, SnapshotEnvWrapper
from sb3_mcbs.networks import torch_settings
from tests.conftest import SEARCHING, assert_same_parameters, snapshot_vec_env

COPIES = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda original: pickle.loads(pickle.dumps(original)),
    "cloudpickle": lambda original: cloudpickle.loads(cloudpickle.dumps(original)),
}
every_way = pytest.mark.parametrize("make_copy", COPIES.values(), ids=COPIES)


def go_on(agent, steps: int = 30):
    """Train further with random numbers that do not depend on who has trained before."""
    th.manual_seed(0)
    np.random.seed(0)
    agent.learn(steps, reset_num_timesteps=False)
    return agent


def assert_same_future(original, other, steps: int = 30) -> None:
    before = original.num_timesteps
    for agent in (original, other):
        go_on(agent, steps)
    assert original.num_timesteps == other.num_timesteps > before
    assert_same_parameters(original, other)
    for name in ("observations", "actions", "rewards", "dones"):
        left, right = (getattr(agent.replay_buffer, name) for agent in (original, other))
        np.testing.assert_array_equal(left, right, err_msg=name)
    assert original.n_decisions == other.n_decisions > 0
    assert original.n_simulated_steps == other.n_simulated_steps
    assert original.search_rng.random() == other.search_rng.random()


@every_way
@pytest.mark.parametrize("cls", SEARCHING)
def test_a_copy_goes_on_as_the_original_does(make_agent, cls, make_copy):
    original = make_agent(cls=cls).learn(45)  # in the middle of an episode
    other = make_copy(original)
    assert other.env is not original.env and other.planner.agent is other
    assert_same_future(original, other)
    assert other.planner.source.environments.wrappers[0] is other.env.envs[0] is not original.env.envs[0]


HANDLERS = {
    "batched MuJoCo": dict(env="HalfCheetah-v5"),
    "copies of MuJoCo": dict(env="InvertedPendulum-v5", forward_model="pool"),
    "two environments": dict(env=lambda: snapshot_vec_env("Pendulum-v1", 2)),
    "efficient": dict(preset="efficient"),
    "value expansion": dict(env="Hopper-v5", value_expansion=2),
    "value expansion of SAC": dict(env="Hopper-v5", value_expansion=2, cls=MCBSSAC),
    "plans": dict(strategy="cem", search_kwargs=dict(n_rounds=2)),
    "directions": dict(env="HalfCheetah-v5", search_kwargs=dict(proposal_dims=2)),
    "no simulation": dict(rollout_depth=0),
    "half of the steps": dict(search_share=0.5),
}


@pytest.mark.parametrize("kind", HANDLERS)
def test_every_kind_of_search_goes_on(make_agent, kind):
    settings = dict(HANDLERS[kind])
    env = settings.get("env", "Pendulum-v1")
    original = make_agent(**{**settings, "env": env() if callable(env) else env}).learn(44)
    other = COPIES["pickle"](original)
    if isinstance(original.env.envs[0].unwrapped, gym.utils.EzPickle):  # Gymnasium makes those anew
        other.env.envs[0].restore(original.env.envs[0].snapshot())
    assert_same_future(original, other)


@pytest.mark.usefixtures("small_ensembles")
@every_way
def test_a_learned_model_goes_on(make_agent, make_copy):
    learned = dict(ensemble_size=2, ensemble_train_freq=50)
    learned |= dict(ensemble_gradient_steps=20, ensemble_max_error=100.0)
    original = make_agent(forward_model="ensemble", model_kwargs=learned).learn(150)
    other = make_copy(original)
    assert_same_future(original, other, 60)
    assert other.planner.model.ensemble is other.learned_model.ensemble
    assert other.learned_model.ensemble is not original.learned_model.ensemble


@every_way
def test_normalized_environments_are_given_to_a_copy_as_with_sb3(make_agent, make_copy):
    """VecNormalize leaves what it wraps out of copies."""
    env = VecNormalize(snapshot_vec_env("Pendulum-v1"))
    original = make_agent(env).learn(45)
    other = make_copy(original)
    observations = np.ones((1, 3), np.float32)
    np.testing.assert_array_equal(other.predict(observations)[0], original.predict(observations)[0])
    for do in (lambda: other.learn(10, reset_num_timesteps=False), lambda: other.planner.model):
        with pytest.raises(ValueError, match=r"no environments in this VecNormalize.*set_venv"):
            do()
    other = make_copy(original)
    other.env.set_venv(make_copy(env.venv))
    other.env.returns = env.returns.copy()
    assert_same_future(original, other)
    np.testing.assert_array_equal(original.env.obs_rms.mean, other.env.obs_rms.mean)
    third = make_copy(original)
    third.set_env(VecNormalize(snapshot_vec_env("Pendulum-v1")))
    assert go_on(third).num_timesteps == original.num_timesteps + 30


def search_around(policy, action: float) -> None:
    """Have an actor answer the same always."""
    with th.no_grad():
        for parameter in policy.model.actor.mu[-2].parameters():
            parameter.fill_(0)
        policy.model.actor.mu[-2].bias.fill_(np.arctanh(action))


@every_way
def test_a_copy_of_a_search_policy_acts_with_its_own_networks_and_environments(make_agent, make_copy):
    agent = make_agent(cls=TD3)
    original = SearchPolicy(
        agent, snapshot_vec_env("Pendulum-v1"), seed=0, strategy="cem", search_kwargs=dict(n_rounds=2)
    )
    observations = original.vec_env.reset()
    for _ in range(3):
        observations = original.vec_env.step(original.predict(observations)[0])[0]
    other = make_copy(original)
    assert other.vec_env is not original.vec_env and other.model is not original.model
    seen = [observations, observations]
    for _ in range(3):
        actions = [policy.predict(each)[0] for policy, each in zip((original, other), seen, strict=True)]
        np.testing.assert_array_equal(*actions)
        seen = [p.vec_env.step(a)[0] for p, a in zip((original, other), actions, strict=True)]
        np.testing.assert_array_equal(*seen)
    search_around(other, 0.9)
    other.vec_env.step(np.array([[0.0]]))  # no step of the other's environment
    original.predict(seen[0])
    assert (abs(original.last_result.candidates[:, 0] - 0.9) > 1e-6).all()
    other.predict(other.vec_env.reset())
    assert (abs(other.last_result.candidates - 0.9).min() < 1e-6).all()


@every_way
def test_the_networks_of_a_copy_are_trained_and_searched_with(make_agent, make_copy):
    original = make_agent().learn(30)
    before = copy.deepcopy(original.policy.state_dict())
    other = make_copy(original)
    with th.no_grad():
        for parameter in other.policy.parameters():
            parameter += 1
    changed = copy.deepcopy(other.policy.state_dict())
    go_on(other, 10)
    for name, value in original.policy.state_dict().items():
        assert th.equal(value, before[name]), name
    assert not any(
        th.equal(value, changed[name])
        for name, value in other.policy.state_dict().items()
        if "weight" in name
    )
    go_on(original, 10)


class Copies(BaseCallback):
    """Copies the agent after a step of the environment that is not stored yet."""

    def _on_step(self) -> bool:
        if self.num_timesteps == 45:
            self.copy = copy.deepcopy(self.model)
        return True


def test_a_copy_that_a_callback_makes_goes_on_from_where_the_environment_is(make_agent):
    callback = Copies()
    original = make_agent().learn(50, callback)
    other, third = callback.copy, copy.deepcopy(callback.copy)
    np.testing.assert_array_equal(other.replay_buffer.next_observations[43], other._last_obs)
    go_on(other, 20)
    buffer = other.replay_buffer
    assert buffer.pos == 44 + 20 and buffer.dones[43] == 1, "the step is left out"
    np.testing.assert_array_equal(buffer.observations[44], original.replay_buffer.observations[45])
    third.learn(20)
    after_reset = third.replay_buffer.observations[44]
    assert not np.array_equal(after_reset, original.replay_buffer.observations[45])


def test_a_copy_is_no_fork(make_agent, monkeypatch):
    """It may have been pickled in another process, whose threads it never had."""
    original = make_agent().learn(25)
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(os, "getpid", lambda: -1)
        content = pickle.dumps(original)
    warned = []
    monkeypatch.setattr(torch_settings.logger, "warning", lambda *args: warned.append(args))
    monkeypatch.setattr(th, "get_num_threads", lambda: 2)
    monkeypatch.setattr(th, "set_num_threads", lambda n_threads: None)
    go_on(pickle.loads(content), 3)
    assert not warned
    copy.deepcopy(original)  # which was itself somewhere else, before it came here by a fork
    assert "forked" in warned[0][0]


def test_what_was_noticed_of_environments_stays_known(make_agent):
    original = make_agent("InvertedPendulum-v5").learn(25)
    memory = {**original.planner.memory, "kind": "pool", "deterministic": False}
    original.planner.memory = memory
    other = copy.deepcopy(original)
    assert (other.planner.model.kind, other.planner.model.deterministic) == ("pool", False)
    third = copy.deepcopy(copy.deepcopy(original))
    assert (third.planner.model.kind, third.planner.model.deterministic) == ("pool", False)
    copy.deepcopy(original).planner.close()
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        other.planner.nothing  # noqa: B018


def test_other_processes_are_refused_as_by_sb3(make_agent):
    for cls in (TD3, MCBSTD3):
        env = snapshot_vec_env("Pendulum-v1", 1, vec_env_cls=SubprocVecEnv)
        agent = make_agent(env, cls=cls).learn(25)
        with pytest.raises(TypeError, match="AuthenticationString"):
            pickle.dumps(agent)
        agent.learn(5)
        env.close()


def test_a_saved_agent_has_no_more_in_it_than_before(make_agent, tmp_path):
    agent = make_agent().learn(25)
    other = copy.deepcopy(agent)
    other.save(tmp_path / "agent")
    loaded = MCBSTD3.load(tmp_path / "agent", snapshot_vec_env("Pendulum-v1"))
    assert_same_parameters(agent, loaded)
    assert isinstance(loaded.env.envs[0], SnapshotEnvWrapper)
