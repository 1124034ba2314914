"""Saving and loading, as in SB3, with the search's settings."""

from copy import deepcopy

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

from sb3_mcbs import MCBSTD3
from sb3_mcbs.search import BeamSettings, SearchSettings
from tests.conftest import SEARCHING, SMALL, WITHOUT_SEARCH, assert_same_parameters, snapshot_vec_env


@pytest.mark.parametrize("cls", SEARCHING)
def test_settings_and_networks_survive(make_agent, tmp_path, cls):
    agent = make_agent(
        cls=cls, beam_width=4, search_kwargs=dict(rollout_noise=0.05, include_policy_action=True)
    ).learn(40)
    agent.save(tmp_path / "agent")
    loaded = cls.load(tmp_path / "agent", env=make_vec_env("Pendulum-v1", 1), device="cpu")
    assert loaded.search_settings == agent.search_settings
    assert loaded.n_decisions == agent.n_decisions == 20
    assert_same_parameters(agent, loaded)
    loaded.learn(40, reset_num_timesteps=False)
    assert loaded.n_decisions == 60  # the warm-up is over


@pytest.mark.parametrize("cls", SEARCHING)
def test_load_without_environment_predicts(make_agent, tmp_path, cls):
    agent = make_agent(cls=cls).learn(30)
    agent.save(tmp_path / "agent")
    loaded = cls.load(tmp_path / "agent", device="cpu")
    observation = np.array([[0.1, 0.2, 0.3]], dtype=np.float32)
    actions = (which.predict(observation, deterministic=True)[0] for which in (loaded, agent))
    np.testing.assert_array_equal(*actions)
    loaded.set_env(make_vec_env("Pendulum-v1", 1))
    loaded.learn(30)


def test_settings_can_be_changed_when_loading(make_agent, tmp_path):
    make_agent().save(tmp_path / "agent")
    loaded = MCBSTD3.load(tmp_path / "agent", env=make_vec_env("Pendulum-v1", 1), beam_width=9, device="cpu")
    assert loaded.search_settings.beam_width == 9
    with pytest.raises(ValueError, match="beam_width must be between 1"):
        MCBSTD3.load(tmp_path / "agent", beam_width=0, device="cpu")


@pytest.mark.parametrize("cls", SEARCHING)
def test_bad_settings_are_refused_at_construction(make_agent, cls):
    with pytest.raises(ValueError, match="rollout_depth"):
        make_agent(cls=cls, rollout_depth=-1)
    for name in ("search_share", "value_expansion", "action_noise_after_search"):
        with pytest.raises(TypeError, match=f"{name} must be"):
            make_agent(cls=cls, **{name: "much"})
    with pytest.raises(TypeError, match="action_noise_after_search"):
        make_agent(cls=cls, action_noise_after_search="yes")
    with pytest.raises(TypeError, match=rf"{cls.__name__}.* unexpected keyword argument 'beam'"):
        make_agent(cls=cls, beam=6)


@pytest.mark.parametrize("cls", SEARCHING)
def test_a_file_of_the_agent_without_search_loads(make_agent, tmp_path, cls):
    plain = make_agent(cls=WITHOUT_SEARCH[cls]).learn(30)
    plain.save(tmp_path / "plain")
    agent = cls.load(tmp_path / "plain", env=make_vec_env("Pendulum-v1", 1), beam_width=4, device="cpu")
    assert_same_parameters(plain, agent)
    agent.learn(20, reset_num_timesteps=False)
    assert agent.n_decisions == 20 and agent.beam_width == 4


@pytest.mark.parametrize("cls", SEARCHING)
def test_presets_are_where_settings_start_from(tmp_path, cls):
    def make(**settings):
        return cls(
            "MlpPolicy",
            snapshot_vec_env("Pendulum-v1"),
            model_kwargs=dict(n_threads=1),
            **deepcopy(SMALL),
            **settings,
        )

    agent = make(preset="balanced", beam_width=5)
    assert agent.search_settings == SearchSettings.preset(
        "balanced", beam_width=5, model_kwargs=dict(n_threads=1)
    )
    agent.save(tmp_path / "agent")
    loaded = cls.load(tmp_path / "agent", env=snapshot_vec_env("Pendulum-v1"), device="cpu")
    assert (loaded.preset, loaded.search_settings) == ("balanced", agent.search_settings)
    assert make(preset=None).search_settings == BeamSettings(n_threads=1)
    for unknown in ("quick", 3, ["paper"]):
        with pytest.raises(ValueError, match=r"There is no preset .*; known are paper, efficient"):
            make(preset=unknown)
    changed = cls.load(tmp_path / "agent", device="cpu", preset="strong")
    assert changed.search_settings == SearchSettings.preset("strong", model_kwargs=dict(n_threads=1))


def test_file_holds_no_model_of_the_environment(make_agent, tmp_path):
    agent = make_agent("HalfCheetah-v5", buffer_size=100).learn(30)
    agent.save(tmp_path / "agent")
    data = MCBSTD3.load(tmp_path / "agent", device="cpu").__dict__
    assert data["planner"] is None and data["_prediction"] is None
