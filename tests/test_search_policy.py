"""Acting with search with any trained agent."""

import gc

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import RescaleAction, TransformObservation
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecNormalize,
    VecTransposeImage,
    sync_envs_normalization,
)

from sb3_mcbs import MCBSTD3, BeamSettings, SearchPolicy, SearchSettings, SnapshotEnvWrapper
from sb3_mcbs.models.copies import _COPIES
from tests.conftest import SEARCHING, SMALL_SEARCH, snapshot_vec_env


@pytest.mark.parametrize("cls", [TD3, DDPG, SAC, TQC, CrossQ, *SEARCHING])
def test_every_agent(make_agent, cls):
    agent = make_agent(cls=cls).learn(40)
    env = make_vec_env("Pendulum-v1", 1, seed=1)
    policy = SearchPolicy(agent, env, seed=0, **SMALL_SEARCH)
    mean, _ = evaluate_policy(policy, env, n_eval_episodes=1)
    assert -2000 < mean < 0
    assert policy.last_result.simulated_steps == 3 + 6


@pytest.mark.parametrize("cls", [TD3, SAC, TQC, CrossQ])
def test_critics_and_actor_are_the_agents(make_agent, cls):
    """Depth 0 ranks by the critic: compare with the networks asked directly."""
    import torch as th

    agent = make_agent(cls=cls)
    env = make_vec_env("Pendulum-v1", 1, seed=1)
    policy = SearchPolicy(agent, env, seed=0, beam_width=5, rollout_depth=0)
    observation = env.reset()
    policy.predict(observation)
    result = policy.last_result
    with th.no_grad():
        repeated = th.as_tensor(np.repeat(observation, 5, axis=0))
        estimates = agent.critic(repeated, th.as_tensor(result.candidates[0]))
        minimum = cls is not TQC
        expected = th.cat(estimates, dim=1).min(dim=1).values if minimum else estimates.mean(dim=(1, 2))
    np.testing.assert_allclose(result.values[0], expected.numpy(), rtol=1e-5)
    mean_action = agent.predict(observation, deterministic=True)[0] / 2
    np.testing.assert_allclose(result.candidates[0].mean(), mean_action.item(), atol=0.2)


def test_search_beats_a_bad_actor():
    """With a known reward even an untrained agent acts better by looking ahead."""
    env = make_vec_env("HalfCheetah-v5", 1, seed=0, env_kwargs=dict(max_episode_steps=200))
    agent = TD3("MlpPolicy", env, seed=0, policy_kwargs=dict(net_arch=[16]), device="cpu", buffer_size=10)
    plain, _ = evaluate_policy(agent, env, n_eval_episodes=1)
    settings = dict(beam_width=24, rollout_depth=4, n_simulations=1, beam_noise=0.6)
    searched, _ = evaluate_policy(SearchPolicy(agent, env, seed=0, **settings), env, n_eval_episodes=1)
    assert searched > plain + 20


def test_seed_decides_the_actions(make_agent):
    agent = make_agent()

    def actions(seed):
        env = make_vec_env("Pendulum-v1", 1, seed=3)
        policy = SearchPolicy(agent, env, seed=seed)
        observation, taken = env.reset(), []
        for _ in range(5):
            action, _ = policy.predict(observation, deterministic=True)
            observation, *_ = env.step(action)
            taken.append(action)
        return np.array(taken)

    np.testing.assert_array_equal(actions(1), actions(1))
    assert not np.array_equal(actions(1), actions(2))


def test_several_environments_and_worker_processes(make_agent):
    agent = make_agent("HalfCheetah-v5")
    taken = []
    for vec_env_cls in (None, SubprocVecEnv):
        env = snapshot_vec_env("HalfCheetah-v5", 2, vec_env_cls=vec_env_cls)
        policy = SearchPolicy(agent, env, seed=0)
        observation = env.reset()
        action, _ = policy.predict(observation)
        assert action.shape == (2, 6)
        observation, *_ = env.step(action)
        taken.append(policy.predict(observation)[0])
        env.close()
    np.testing.assert_array_equal(*taken)


def test_settings_default_to_the_agents(make_agent):
    env = make_vec_env("Pendulum-v1", 1)
    agent = make_agent(beam_width=5)
    assert SearchPolicy(agent, env).settings == agent.search_settings
    assert SearchPolicy(agent, env, rollout_depth=1).settings.beam_width == 5
    assert SearchPolicy(make_agent(cls=TD3), env).settings == BeamSettings()
    with pytest.raises(TypeError, match="beam_with"):
        SearchPolicy(agent, env, beam_with=3)


@pytest.mark.parametrize("cls", [TD3, DDPG, SAC, TQC, CrossQ, *SEARCHING])
def test_a_preset_takes_the_place_of_the_agents_settings(make_agent, cls):
    env, agent = make_vec_env("Pendulum-v1", 1), make_agent(cls=cls)
    policy = SearchPolicy(agent, env, preset="balanced", beam_width=5)
    assert policy.settings == SearchSettings.preset("balanced", beam_width=5)
    policy.predict(env.reset())
    with pytest.raises(ValueError, match="There is no preset 'quick'"):
        SearchPolicy(agent, env, preset="quick")


def test_gym_environment(make_agent):
    agent = make_agent()
    with pytest.raises(TypeError, match="SnapshotEnvWrapper outermost"):
        SearchPolicy(agent, gym.make("Pendulum-v1"))
    env = SnapshotEnvWrapper(gym.make("Pendulum-v1"))
    policy = SearchPolicy(agent, env, seed=0)
    observation, _ = env.reset(seed=0)
    action, _ = policy.predict(observation)
    assert action.shape == (1,)
    env.step(action)


class Pictures(gym.Env):
    """Observations are images with the channels last, which SB3 transposes."""

    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self, keyed=False):
        self.keyed, image = keyed, spaces.Box(0, 255, (40, 40, 3), np.uint8)
        self.observation_space = (
            spaces.Dict({"image": image, "age": spaces.Box(0, 9, (1,))}) if keyed else image
        )

    def observe(self):
        image = np.zeros((40, 40, 3), np.uint8)
        image[self.age, :, self.age % 3] = 200
        return {"image": image, "age": np.array([self.age], np.float32)} if self.keyed else image

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.age = 0
        return self.observe(), {}

    def step(self, action):
        self.age += 1
        return self.observe(), float(action[0]), False, self.age >= 5, {}


@pytest.mark.parametrize("keyed", [False, True], ids=["image", "dict"])
def test_images_as_sb3_takes_them(keyed):
    policy = "MultiInputPolicy" if keyed else "CnnPolicy"
    extractor = dict(cnn_output_dim=8) if keyed else dict(features_dim=8)
    networks = dict(net_arch=[8], features_extractor_kwargs=extractor)
    agent = TD3(policy, Pictures(keyed), seed=0, buffer_size=10, device="cpu", policy_kwargs=networks)
    chosen = []
    for wrap in (lambda env: env, VecTransposeImage):
        env = wrap(DummyVecEnv([lambda: Pictures(keyed)]))
        searching = SearchPolicy(agent, env, seed=0, **SMALL_SEARCH)
        observations = env.reset()  # the channels last, or first
        for _ in range(2):
            actions, _ = searching.predict(observations)
            chosen.append(actions)
            predicted = searching.last_result.first_step.observations
            observations, *_ = env.step(actions)
        image = predicted["image"] if keyed else predicted
        assert image.shape == (1, 40, 40, 3)
        mean, _ = evaluate_policy(searching, env, n_eval_episodes=1, warn=False)
        assert -5 <= mean <= 5
    np.testing.assert_array_equal(chosen[:2], chosen[2:])


@pytest.mark.parametrize("env_id, n_entries", [("MountainCarContinuous-v0", 2), ("InvertedPendulum-v5", 4)])
def test_other_observations_are_refused(make_agent, env_id, n_entries):
    spaces_in_words = rf"observation space Box\(.*\(3,\).* and vec_env has Box\(.*\({n_entries},\)"
    with pytest.raises(ValueError, match=rf"trained with the {spaces_in_words}.*same id, arguments and wrap"):
        SearchPolicy(make_agent(), make_vec_env(env_id, 1))


def test_other_actions_are_refused(make_agent):
    narrow = make_vec_env(
        "Pendulum-v1", 1, wrapper_class=RescaleAction, wrapper_kwargs=dict(min_action=-1, max_action=1)
    )
    with pytest.raises(ValueError, match=r"action space Box\(-2.* and vec_env has Box\(-1"):
        SearchPolicy(make_agent(), narrow)
    keyed = DummyVecEnv([lambda: Pictures(keyed=True)])
    with pytest.raises(ValueError, match="observation space"):
        SearchPolicy(make_agent(), keyed)


def test_bounds_of_observations_do_not_matter(make_agent):
    wide = DummyVecEnv(
        [lambda: TransformObservation(gym.make("Pendulum-v1"), abs, spaces.Box(-99, 99, (3,)))]
    )
    assert SearchPolicy(make_agent(), wide, seed=0).predict(wide.reset())[0].shape == (1, 1)


def test_torch_threads_are_put_back(make_agent, monkeypatch):
    import torch as th

    env = make_vec_env("Pendulum-v1", 1)
    policy = SearchPolicy(make_agent(), env, seed=0)
    observation = env.reset()
    seen = []
    actor = policy.model.actor.forward
    monkeypatch.setattr(
        policy.model.actor, "forward", lambda obs: seen.append(th.get_num_threads()) or actor(obs)
    )
    th.set_num_threads(2)
    try:
        policy.predict(observation)
        assert th.get_num_threads() == 2
        monkeypatch.setattr(policy.model.actor, "forward", lambda obs: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            policy.predict(observation)
        assert th.get_num_threads() == 2
    finally:
        th.set_num_threads(1)
    assert set(seen) == {1}


def test_agents_without_critics_are_refused():
    env = make_vec_env("Pendulum-v1", 1)
    with pytest.raises(TypeError, match="PPO"):
        SearchPolicy(PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu"), env)


def test_can_be_made_in_the_middle_of_an_episode(make_agent):
    for env_id in ("HalfCheetah-v5", "Pendulum-v1"):
        env = make_vec_env(env_id, 2, seed=0)
        env.reset()
        observation, *_ = env.step(np.zeros((2, *env.action_space.shape), dtype=np.float32))
        policy = SearchPolicy(make_agent(env_id), env, seed=0)
        assert policy.planner.model.kind == ("mujoco" if env_id == "HalfCheetah-v5" else "pool")
        policy.predict(observation)
        assert (policy.last_result.chosen >= 0).all()


def test_observations_of_another_moment_are_refused(make_agent):
    env = make_vec_env("Pendulum-v1", 1)
    policy = SearchPolicy(make_agent(), env)
    observation = env.reset()
    env.step(np.zeros((1, 1), dtype=np.float32))
    with pytest.raises(ValueError, match="present states"):
        policy.predict(observation)


def test_search_leaves_the_environment_alone(make_agent):
    env = make_vec_env("Hopper-v5", 1, seed=0)
    agent = make_agent("Hopper-v5")
    policy = SearchPolicy(agent, env, seed=0)
    observation = env.reset()
    before = env.envs[0].snapshot()
    action, _ = policy.predict(observation)
    plain = [env.step(action) for _ in range(3)]
    env.envs[0].restore(before)
    again = [env.step(action) for _ in range(3)]
    for left, right in zip(plain, again, strict=True):
        np.testing.assert_array_equal(left[0], right[0])
        np.testing.assert_array_equal(left[1], right[1])


def test_forgotten_policies_leave_nothing_in_the_environment(make_agent):
    env, agent = make_vec_env("Pendulum-v1", 1), make_agent()
    for _ in range(2):
        policy = SearchPolicy(agent, env, seed=0)
        policy.predict(env.reset())
        del policy
        gc.collect()
        assert not _COPIES.get(env.envs[0])


class TestRewardScale:
    """The critics' scale on an evaluation environment whose ``norm_reward`` is off."""

    def envs(self):
        training, evaluation = (VecNormalize(make_vec_env("Hopper-v5", 1, seed=0)) for _ in range(2))
        evaluation.training = evaluation.norm_reward = False
        return training, evaluation

    def test_is_that_of_the_training_environment(self, make_agent):
        training, evaluation = self.envs()
        agent = make_agent(training).learn(40)
        sync_envs_normalization(training, evaluation)
        policy = SearchPolicy(agent, evaluation)
        assert policy.planner.source.view.reward_normalizer is training
        scaled = policy.planner.source.view.scale_reward(np.array([1.0]))
        assert scaled[0] == pytest.approx(1 / np.sqrt(training.ret_rms.var + training.epsilon))
        assert training.norm_reward and not evaluation.norm_reward

    def test_is_assumed_from_statistics_and_said(self, make_agent, tmp_path):
        training, evaluation = self.envs()
        agent = make_agent(training).learn(40)
        agent.save(tmp_path / "agent")
        sync_envs_normalization(training, evaluation)
        alone = MCBSTD3.load(tmp_path / "agent", device="cpu")
        with pytest.warns(UserWarning, match="normalize_reward=True or False"):
            policy = SearchPolicy(alone, evaluation)
        assert policy.planner.source.view.reward_normalizer is evaluation
        assert (
            SearchPolicy(alone, evaluation, normalize_reward=False).planner.source.view.reward_normalizer
            is None
        )

    def test_raw_rewards_stay_raw(self, make_agent):
        env = VecNormalize(make_vec_env("Hopper-v5", 1, seed=0), norm_reward=False)
        agent = make_agent(env).learn(40)
        assert agent.planner.source.view.reward_normalizer is None
        agent.set_env(env)
        assert agent.planner.source.view.reward_normalizer is None


def test_search_draws_nothing_from_global_generators(make_agent):
    import random

    import torch as th

    env = make_vec_env("Hopper-v5", 1, seed=0)
    agent = make_agent("Hopper-v5", cls=SAC)
    observation = env.reset()

    def generators():
        state = np.random.get_state()
        return (
            random.getstate(),
            [np.asarray(part).tobytes() for part in state[1:]],
            th.get_rng_state().numpy().tobytes(),
        )

    before = generators()
    policy = SearchPolicy(agent, env, seed=0)
    policy.predict(observation)
    assert generators() == before
