"""The whole search on real environments against Algorithm 1 done with ``env.step`` and loops."""

from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_mcbs import MCBSDDPG, MCBSSAC, MCBSTD3, MCBSTQC, BeamSettings, MCBSCrossQ
from sb3_mcbs.agents.planner import Planner
from sb3_mcbs.networks.functions import STOCHASTIC
from sb3_mcbs.search import Roots, beam_search, draw_noise
from tests.conftest import SMALL
from tests.reference_search import Reference


def reference_for(agent, env):
    """Algorithm 1 in a copy of the environment, with one network call at a time."""
    agent.policy.set_training_mode(False)
    simulator = env.clone()
    root = env.snapshot()

    def tensor(observation):
        return th.as_tensor(np.asarray(observation, dtype=np.float64)[None])

    def policy(observation):
        with th.no_grad():
            how = dict(deterministic=True) if isinstance(agent, STOCHASTIC) else {}
            return agent.actor(tensor(observation), **how).numpy()[0]

    def critics(observation, action):
        with th.no_grad():
            estimates = agent.critic(tensor(observation), th.as_tensor(action[None]))
            if isinstance(agent, TQC):
                return [float(np.mean(estimates.flatten().tolist()))]  # of all critics
            return [float(q) for q in estimates]

    def env_step(action):
        observation, reward, terminated, _, _ = simulator.step(agent.policy.unscale_action(action))
        return observation, reward, terminated

    return Reference(env_step, lambda: simulator.restore(root), policy, critics, agent.gamma)


def walk(vec_env, steps, rng):
    observations = vec_env.reset()
    for _ in range(steps):
        low, high = vec_env.action_space.low, vec_env.action_space.high
        observations, *_ = vec_env.step([rng.uniform(low, high).astype(np.float32)])
    return observations


CASES = [
    ("HalfCheetah-v5", {}, "mujoco", 5),
    ("Walker2d-v5", {}, "mujoco", 5),
    ("Swimmer-v5", {}, "mujoco", 5),
    ("Ant-v5", {}, "mujoco", 5),
    ("Hopper-v5", dict(healthy_angle_range=(-0.02, 0.02)), "mujoco", 3),  # terminates inside rollouts
    ("InvertedPendulum-v5", {}, "pool", 4),  # terminates too
    ("Pendulum-v1", {}, "pool", 5),
]


@pytest.mark.parametrize("env_id, kwargs, kind, steps", CASES, ids=[f"{case[0]}-{case[2]}" for case in CASES])
def test_same_values_and_choice(env_id, kwargs, kind, steps):
    assert_same_values_and_choice(MCBSTD3, SMALL, env_id, kwargs, kind, steps)


AGENTS = [
    (MCBSTD3, dict(policy_kwargs=dict(net_arch=[16, 16], n_critics=3))),
    (MCBSTD3, dict(policy_kwargs=dict(net_arch=[16, 16], n_critics=1))),
    (MCBSDDPG, {}),
    (MCBSSAC, {}),
    (MCBSSAC, dict(policy_kwargs=dict(net_arch=[16, 16], n_critics=5))),
    (MCBSSAC, dict(use_sde=True)),
    (MCBSTQC, {}),
    (MCBSTQC, dict(policy_kwargs=dict(net_arch=[16, 16], n_critics=3, n_quantiles=7))),
    (MCBSTQC, dict(use_sde=True)),
    (MCBSCrossQ, {}),
    (MCBSCrossQ, dict(use_sde=True)),
]


@pytest.mark.parametrize("cls, settings", AGENTS)
def test_same_values_and_choice_with_every_agent(cls, settings):
    settings = {**deepcopy(SMALL), **settings}
    assert_same_values_and_choice(cls, settings, "Swimmer-v5", {}, "mujoco", 5)
    assert_same_values_and_choice(cls, settings, "InvertedPendulum-v5", {}, "pool", 4)


def assert_same_values_and_choice(cls, agent_settings, env_id, kwargs, kind, steps):
    vec_env = DummyVecEnv([lambda: gym.make(env_id, **kwargs)])
    vec_env.seed(3)
    settings = BeamSettings(4, 3, 3, beam_noise=0.4, n_threads=1, forward_model=kind)
    agent = cls("MlpPolicy", vec_env, seed=1, rollout_depth=0, **agent_settings)
    planner = Planner(agent, vec_env, settings)
    rng = np.random.default_rng(0)
    terminated_inside = False
    for trial in range(4):
        observations = walk(vec_env, steps + trial, rng)
        roots = Roots(planner.model, planner.model.read_roots([0]), observations)
        noise = draw_noise(rng, settings, 1, vec_env.action_space.shape[0])
        result = beam_search(roots, planner.functions(), settings, noise, rng)
        reference = reference_for(agent, vec_env.envs[0])
        chosen, values, rewards = reference.choose(observations[0], noise.beam[0], noise.rollout[:, 0])
        np.testing.assert_allclose(result.values[0], values, rtol=1e-5, atol=1e-5)
        assert result.chosen[0] == chosen
        # The first actions may differ by the rounding of the networks.
        expected = rewards[chosen * settings.n_simulations][0]
        assert result.first_step.rewards[0] == pytest.approx(expected, rel=1e-5, abs=1e-6)
        terminated_inside |= any(len(seen) < settings.rollout_depth for seen in rewards)
    assert terminated_inside == (env_id in ("Hopper-v5", "InvertedPendulum-v5"))


@pytest.mark.parametrize("compiled", [True, False])
def test_rewards_are_exact(compiled):
    """With critics of zero a candidate's value is nothing but its rewards: equal to the last bit."""
    vec_env = DummyVecEnv([lambda: gym.make("Walker2d-v5")])
    vec_env.seed(0)
    settings = BeamSettings(4, 4, 1, beam_noise=0.3, n_threads=2, forward_model="mujoco")
    agent = MCBSTD3("MlpPolicy", vec_env, seed=1, rollout_depth=0, **SMALL)
    planner = Planner(agent, vec_env, settings)
    rng = np.random.default_rng(5)
    observations = walk(vec_env, 6, rng)
    # A policy that is the same constant in both makes the actions bit-identical, whatever the batch size.
    constant = np.zeros((1, vec_env.action_space.shape[0]), dtype=np.float32)
    with th.no_grad():
        for network in (agent.actor.mu, *agent.critic.q_networks):
            last = [layer for layer in network if isinstance(layer, th.nn.Linear)][-1]
            last.weight[...], last.bias[...] = 0, 0
    functions = planner.functions()
    assert functions.rollout is not None
    if not compiled:
        functions = functions._replace(rollout=None)
    roots = Roots(planner.model, planner.model.read_roots([0]), observations)
    noise = draw_noise(rng, settings, 1, constant.shape[1])
    result = beam_search(roots, functions, settings, noise, rng)
    reference = reference_for(agent, vec_env.envs[0])
    reference.policy, reference.critics = lambda obs: constant[0], lambda obs, action: [0.0]
    chosen, values, _ = reference.choose(observations[0], noise.beam[0], noise.rollout[:, 0])
    np.testing.assert_array_equal(result.values[0], values)
    assert result.chosen[0] == chosen


def test_normalised_observations_and_rewards():
    """VecNormalize: networks see what they saw in training, returns have the critics' scale."""
    vec_env = VecNormalize(DummyVecEnv([lambda: gym.make("Hopper-v5")]), gamma=0.99)
    vec_env.seed(0)
    agent = MCBSTD3("MlpPolicy", vec_env, seed=1, rollout_depth=0, **SMALL)
    settings = BeamSettings(3, 2, 2, beam_noise=0.3, n_threads=1)
    planner = Planner(agent, vec_env, settings, normalize_reward=True)
    rng = np.random.default_rng(2)
    walk(vec_env, 9, rng)
    statistics = vec_env.obs_rms.mean.copy(), vec_env.ret_rms.var, vec_env.returns.copy()
    observations = vec_env.get_original_obs()
    roots = Roots(planner.model, planner.model.read_roots([0]), observations)
    noise = draw_noise(rng, settings, 1, 3)
    result = beam_search(roots, planner.functions(), settings, noise, rng)

    reference = reference_for(agent, vec_env.venv.envs[0])
    plain_step = reference.env_step

    def normalised_step(action):
        observation, reward, done = plain_step(action)
        return vec_env.normalize_obs(observation), vec_env.normalize_reward(np.array([reward]))[0], done

    reference.env_step = normalised_step
    chosen, values, _ = reference.choose(
        vec_env.normalize_obs(observations[0]), noise.beam[0], noise.rollout[:, 0]
    )
    np.testing.assert_allclose(result.values[0], values, rtol=1e-5)
    assert result.chosen[0] == chosen
    np.testing.assert_array_equal(vec_env.obs_rms.mean, statistics[0])
    assert vec_env.ret_rms.var == statistics[1]
    np.testing.assert_array_equal(vec_env.returns, statistics[2])
