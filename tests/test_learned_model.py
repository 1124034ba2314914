"""Agents that search with a model that they learn themselves."""

from copy import deepcopy

import numpy as np
import pytest
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_mcbs import MCBSSAC, MCBSTD3, SearchPolicy, SnapshotEnvWrapper, load_agent
from sb3_mcbs.agents import observation_pipeline
from sb3_mcbs.agents.learned_model import read_transitions
from sb3_mcbs.models import ForwardModelError
from sb3_mcbs.snapshot import SnapshotUnsupportedError
from tests.checkpoint_helpers import assert_resumed_is_exact
from tests.conftest import SEARCHING, assert_same_parameters, snapshot_vec_env
from tests.linear_env import LinearEnv

pytestmark = pytest.mark.usefixtures("small_ensembles")

LEARNS = dict(
    forward_model="ensemble",
    learning_starts=100,
    model_kwargs=dict(
        ensemble_size=2, ensemble_train_freq=30, ensemble_gradient_steps=120, ensemble_max_error=0.8
    ),
)
NOISE = NormalActionNoise(np.zeros(1), 0.3 * np.ones(1))


def linear_vec_env(n_envs: int = 1, vec_env_cls=DummyVecEnv, **kwargs):
    env = vec_env_cls([lambda: LinearEnv(**kwargs)] * n_envs)
    env.seed(0)
    return env


@pytest.fixture
def no_snapshots(monkeypatch):
    def refuse(*args):
        raise AssertionError("no snapshot is wanted")

    monkeypatch.setattr(SnapshotEnvWrapper, "__init__", refuse)
    monkeypatch.setattr(observation_pipeline, "snapshot_environments", refuse)


@pytest.fixture
def learning_agent(make_agent):
    def make(env=None, **settings):
        settings["model_kwargs"] = {**LEARNS["model_kwargs"], **settings.get("model_kwargs", {})}
        return make_agent(linear_vec_env() if env is None else env, **{**LEARNS, **settings})

    return make


def test_the_environment_cannot_be_captured():
    with pytest.raises(SnapshotUnsupportedError, match="real_robot"):
        SnapshotEnvWrapper(LinearEnv())


@pytest.mark.parametrize("cls", SEARCHING)
def test_agents_search_without_snapshots(learning_agent, no_snapshots, cls):
    agent = learning_agent(cls=cls, action_noise=deepcopy(NOISE))
    assert "learned ensemble of 2 networks" in agent.planner.description
    agent.learn(160, log_interval=1000)
    logged = agent.logger.name_to_value
    assert logged["search/model_ready"] == 1 and logged["model/held_out_error"] < 0.8
    assert logged["search/model_error"] < 0.8 and logged["model/termination_error"] == 0
    # The first fit is after step 101: the actions of the 59 steps after it are searched.
    assert agent.n_decisions == 59 and agent.n_simulated_steps == 59 * (3 + 6)
    policy = SearchPolicy(agent, agent.env, seed=0, n_simulations=1)
    evaluate_policy(policy, agent.env, 1)
    assert policy.last_result.chosen[0] >= 0 and policy.last_result.simulated_steps == 6


@pytest.mark.parametrize("cls, plain", [(MCBSTD3, TD3), (MCBSSAC, SAC)])
def test_it_changes_nothing_until_it_is_used(learning_agent, make_agent, cls, plain):
    never = dict(model_kwargs=dict(ensemble_max_error=0.0, ensemble_gradient_steps=3))
    faithful = dict(fast_update=False) if cls is MCBSTD3 else {}
    noise = dict(action_noise=deepcopy(NOISE)) if cls is MCBSTD3 else {}
    ours = learning_agent(cls=cls, **never, **faithful, **deepcopy(noise))
    ours.learn(160, log_interval=None)
    theirs = make_agent(linear_vec_env(), cls=plain, learning_starts=100, **deepcopy(noise)).learn(160)
    assert ours.learned_model._fitted_at == 131 and ours.n_decisions == 0
    assert ours.logger.name_to_value["search/model_ready"] == 0
    assert_same_parameters(ours, theirs)
    for name in ("observations", "actions", "rewards", "dones"):
        np.testing.assert_array_equal(getattr(ours.replay_buffer, name), getattr(theirs.replay_buffer, name))


def test_it_is_put_aside_while_its_error_is_too_high(learning_agent):
    agent = learning_agent()
    agent.learn(140)
    assert agent.n_decisions == 39
    agent.learned_model.ensemble.held_out_error = 0.81
    assert not agent.planner.ready
    policy = SearchPolicy(agent, agent.env)
    observation = agent.env.reset()
    actions, _ = policy.predict(observation)
    np.testing.assert_allclose(actions, agent.predict(observation, deterministic=True)[0], rtol=1e-5)
    assert (policy.last_result.chosen, policy.last_result.simulated_steps) == (-1, 0)
    agent.learned_model.ensemble.held_out_error = 0.79
    policy.predict(observation)
    assert policy.last_result.chosen[0] >= 0


def test_an_agent_without_noise_explores_until_the_model_is_ready(learning_agent):
    agent = learning_agent(model_kwargs=dict(ensemble_max_error=0.0), beam_noise=0.2).learn(101)
    assert agent._noise_without_search._sigma == pytest.approx(0.2)


def test_time_limits_are_no_terminations():
    spaces = LinearEnv.observation_space, LinearEnv.action_space
    buffer = ReplayBuffer(40, *spaces, device="cpu", n_envs=2)
    rng = np.random.default_rng(0)
    np.random.seed(3)
    before = np.random.get_state()[1].copy()
    ends = {4: "time limit", 9: "termination", 13: "both over"}
    for step in range(25):  # more than it holds: the first rows are overwritten
        infos: list[dict] = [{}, {"TimeLimit.truncated": ends.get(step - 5) == "time limit"}]
        done = np.array([False, step - 5 in ends])
        buffer.add(*rng.normal(size=(2, 2, 2)), rng.normal(size=(2, 1)), rng.normal(size=2), done, infos)
    transitions, held_out = read_transitions(buffer)
    assert len(held_out) == 40 and held_out.reshape(20, 2).all(axis=1).nonzero()[0].tolist() == [9, 19]
    terminated = transitions.terminated.reshape(20, 2)
    assert np.argwhere(terminated).tolist() == [[14, 1], [18, 1]]
    np.testing.assert_array_equal(transitions.rewards.reshape(20, 2), buffer.rewards)
    np.testing.assert_array_equal(transitions.next_observations[7], buffer.next_observations[3, 1])
    np.testing.assert_array_equal(np.random.get_state()[1], before)


def test_terminations_reach_the_model_and_time_limits_do_not(learning_agent):
    agent = learning_agent(linear_vec_env(2, length=5)).learn(160)
    assert not agent.learned_model.ensemble.predicts_termination
    assert agent.replay_buffer.dones.sum() > 20
    agent = learning_agent(linear_vec_env(2, limit=0.8)).learn(160)
    assert agent.learned_model.ensemble.predicts_termination and agent.n_decisions > 20


def test_normalised_environments(learning_agent, no_snapshots):
    env = VecNormalize(VecMonitor(linear_vec_env(2, length=7)), gamma=0.9)
    agent = learning_agent(env).learn(160)
    model = agent.learned_model.ensemble
    # In the environment's own units: the first target's mean is that of the raw rewards.
    transitions, held_out = read_transitions(agent.replay_buffer)
    assert model._target_mean[-1] == pytest.approx(transitions.rewards[~held_out].mean(), abs=0.1)
    assert agent.logger.name_to_value["search/model_error"] < 0.8 and agent.n_decisions > 20
    acting = VecNormalize(linear_vec_env(3), training=False, norm_reward=False)
    acting.obs_rms = env.obs_rms
    policy = SearchPolicy(agent, acting)
    policy.predict(acting.reset())
    with pytest.raises(ValueError, match="VecNormalize gave last"):
        policy.predict(np.ones((3, 2), np.float32))


def test_vectorized_wrappers_that_no_other_model_knows(learning_agent, no_snapshots):
    agent = learning_agent(
        VecFrameStack(linear_vec_env(), 3), model_kwargs=dict(ensemble_max_error=10)
    ).learn(130)
    assert agent.n_decisions > 0


@pytest.mark.slow
def test_worker_processes_need_no_wrapper(learning_agent, no_snapshots):
    agent = learning_agent(linear_vec_env(2, SubprocVecEnv), model_kwargs=dict(ensemble_max_error=10)).learn(
        130
    )
    assert agent.n_decisions > 0
    agent.env.close()


@pytest.mark.parametrize(
    "settings",
    [
        dict(strategy="tree", search_kwargs=dict(branching=2)),
        dict(strategy="cem", n_simulations=1),
        dict(search_kwargs=dict(time_budget=0.01)),
        dict(search_share=0.5),
    ],
)
def test_other_searches(learning_agent, settings):
    agent = learning_agent(linear_vec_env(2), **settings).learn(140)
    assert 0 < agent.n_decisions <= 40


def test_saved_and_loaded(learning_agent, tmp_path):
    agent = learning_agent().learn(140)
    agent.save(tmp_path / "agent")
    env = linear_vec_env()
    loaded = MCBSTD3.load(tmp_path / "agent", env=env, device="cpu")
    observation = env.reset()
    actions = [SearchPolicy(each, env, seed=3).predict(observation)[0] for each in (agent, loaded)]
    np.testing.assert_array_equal(*actions)
    assert loaded.learned_model.ensemble.held_out_error == agent.learned_model.ensemble.held_out_error
    loaded.learn(140, reset_num_timesteps=False)
    assert loaded.n_decisions > agent.n_decisions
    with pytest.raises(ValueError, match="ensemble_size is 3, and this agent has learned a model of 2"):
        MCBSTD3.load(tmp_path / "agent", model_kwargs=dict(ensemble_size=3), device="cpu")
    with pytest.raises(TypeError, match="ensemble_size is for forward_model='ensemble'"):
        MCBSTD3.load(tmp_path / "agent", forward_model="auto")
    other = MCBSTD3.load(tmp_path / "agent", forward_model="auto", model_kwargs=None, device="cpu")
    assert other.learned_model is None
    read = load_agent(tmp_path / "agent.zip", env)
    with pytest.raises(ValueError, match="load_agent reads no learned model"):
        SearchPolicy(read, env)


def test_agents_without_a_learned_model(make_agent, tmp_path):
    plain = make_agent(linear_vec_env(), cls=TD3)
    with pytest.raises(ValueError, match="This TD3 has no learned model"):
        SearchPolicy(plain, plain.env, forward_model="ensemble")
    plain.save(tmp_path / "plain")
    loaded = MCBSTD3.load(tmp_path / "plain", env=linear_vec_env(), **LEARNS)
    loaded.learn(120)
    assert loaded.n_decisions > 0


@pytest.mark.parametrize("n_envs, crash_at", [(1, 95), (1, 145), (2, 130)])
def test_a_resumed_run_is_exact(make_agent, tmp_path, n_envs, crash_at):
    def make_env(folder):
        return snapshot_vec_env("Pendulum-v1", n_envs)

    def make(folder):
        learned = {**LEARNS["model_kwargs"], "ensemble_max_error": 1.5}
        settings = {**LEARNS, "model_kwargs": learned, "action_noise": deepcopy(NOISE)}
        return make_agent(make_env(folder), **settings)

    whole, resumed = assert_resumed_is_exact(make, tmp_path, 200, crash_at, make_env=make_env)
    assert whole.n_decisions == resumed.n_decisions > 0
    ours, theirs = whole.learned_model, resumed.learned_model
    assert ours.rng.bit_generator.state == theirs.rng.bit_generator.state
    assert ours._fitted_at == theirs._fitted_at > crash_at
    for name, value in vars(ours.ensemble).items():
        if name == "parameters":
            value, other = (e.parameters.detach() for e in (ours.ensemble, theirs.ensemble))
        else:
            other = vars(theirs.ensemble)[name]
        np.testing.assert_array_equal(value, other, err_msg=name)


@pytest.mark.parametrize(
    "settings, error, words",
    [
        (
            dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)),
            ValueError,
            "optimize_memory_usage",
        ),
        (dict(rollout_depth=0), ValueError, "rollout_depth of 1 or more"),
        (dict(model_kwargs=dict(ensemble_size=1)), ValueError, "ensemble_size"),
        (dict(model_kwargs=dict(ensemble_train_freq=0)), ValueError, "ensemble_train_freq"),
        (dict(model_kwargs=dict(ensemble_gradient_steps=1.5)), TypeError, "ensemble_gradient_steps"),
        (dict(model_kwargs=dict(ensemble_max_error=-0.1)), ValueError, "ensemble_max_error"),
        (dict(model_kwargs=dict(ensemble_pessimism=np.nan)), ValueError, "ensemble_pessimism"),
    ],
)
def test_what_makes_no_sense_is_refused(learning_agent, settings, error, words):
    with pytest.raises(error, match=words):
        learning_agent(**settings)


def test_a_replay_buffer_that_never_holds_enough_is_for_acting_only(learning_agent, tmp_path):
    """RL Zoo loads agents to look at with room for one transition."""
    with pytest.raises(ValueError, match=r"buffer_size of 100 or more.*there is room for 99"):
        learning_agent(linear_vec_env(3), buffer_size=101).learn(1)
    agent = learning_agent().learn(140)
    agent.save(tmp_path / "agent")
    loaded = MCBSTD3.load(tmp_path / "agent", buffer_size=1, device="cpu")
    policy = SearchPolicy(loaded, linear_vec_env())
    policy.predict(policy.vec_env.reset())
    assert policy.last_result.chosen[0] >= 0
    critics_alone = SearchPolicy(loaded, linear_vec_env(), rollout_depth=0, n_simulations=1)
    critics_alone.predict(critics_alone.vec_env.reset())
    assert critics_alone.last_result.simulated_steps == 0


def test_dict_observations_are_refused(learning_agent, make_dict_env):
    env = make_vec_env(make_dict_env)
    with pytest.raises(ForwardModelError, match="FlattenObservation"):
        learning_agent(env, policy="MultiInputPolicy")
