"""Saving and loading, as in SB3, with the search's settings."""

import numpy as np
import pytest
from stable_baselines3 import TD3
from stable_baselines3.common.env_util import make_vec_env

from sb3_mcbs import MCBSTD3
from tests.conftest import assert_same_parameters


def test_settings_and_networks_survive(make_agent, tmp_path):
    agent = make_agent(beam_width=4, rollout_noise=0.05, include_policy_action=True).learn(40)
    agent.save(tmp_path / "agent")
    loaded = MCBSTD3.load(tmp_path / "agent", env=make_vec_env("Pendulum-v1", 1), device="cpu")
    assert loaded.search_settings == agent.search_settings
    assert loaded.n_decisions == agent.n_decisions == 20
    assert_same_parameters(agent, loaded)
    loaded.learn(40, reset_num_timesteps=False)
    assert loaded.n_decisions == 60  # the warm-up is over


def test_load_without_environment_predicts(make_agent, tmp_path):
    agent = make_agent().learn(30)
    agent.save(tmp_path / "agent")
    loaded = MCBSTD3.load(tmp_path / "agent", device="cpu")
    observation = np.array([[0.1, 0.2, 0.3]], dtype=np.float32)
    np.testing.assert_array_equal(loaded.predict(observation)[0], agent.predict(observation)[0])
    loaded.set_env(make_vec_env("Pendulum-v1", 1))
    loaded.learn(30)


def test_settings_can_be_changed_when_loading(make_agent, tmp_path):
    make_agent().save(tmp_path / "agent")
    loaded = MCBSTD3.load(tmp_path / "agent", env=make_vec_env("Pendulum-v1", 1), beam_width=9, device="cpu")
    assert loaded.search_settings.beam_width == 9
    with pytest.raises(ValueError, match="beam_width must be between 1"):
        MCBSTD3.load(tmp_path / "agent", beam_width=0, device="cpu")


def test_bad_settings_are_refused_at_construction(make_agent):
    with pytest.raises(ValueError, match="rollout_depth"):
        make_agent(rollout_depth=-1)
    with pytest.raises(TypeError, match="action_noise_after_search"):
        make_agent(action_noise_after_search="yes")


def test_a_plain_td3_file_loads(make_agent, tmp_path):
    plain = make_agent(cls=TD3).learn(30)
    plain.save(tmp_path / "td3")
    agent = MCBSTD3.load(tmp_path / "td3", env=make_vec_env("Pendulum-v1", 1), beam_width=4, device="cpu")
    assert_same_parameters(plain, agent)
    agent.learn(20, reset_num_timesteps=False)
    assert agent.n_decisions == 20 and agent.beam_width == 4


def test_file_holds_no_model_of_the_environment(make_agent, tmp_path):
    agent = make_agent("HalfCheetah-v5", buffer_size=100).learn(30)
    agent.save(tmp_path / "agent")
    data = MCBSTD3.load(tmp_path / "agent", device="cpu").__dict__
    assert data["_searcher"] is None and data["_decision"] is None
