"""The preset for training: what it sets, what overrides it, and where value expansion is left out."""

from copy import deepcopy

import numpy as np
import pytest
import yaml
from stable_baselines3.common.env_util import make_vec_env

from sb3_mcbs import MCBSTD3, SearchPolicy
from sb3_mcbs.agents.hyperparameters import SETTINGS
from sb3_mcbs.models import ForwardModelError
from sb3_mcbs.search import SearchSettings
from sb3_mcbs.zoo.paths import hyperparams_path
from tests.conftest import SEARCHING, SMALL, snapshot_vec_env

BATCHED, OTHER = "InvertedPendulum-v5", "Pendulum-v1"
LEFT_OUT = "value expansion is left out: it needs batched MuJoCo"


def make(env=BATCHED, cls=MCBSTD3, **settings):
    settings = {"preset": "train", "learning_starts": 20, "seed": 0, **settings}
    return cls("MlpPolicy", env, model_kwargs=dict(n_threads=1), **deepcopy(SMALL), **settings)


def expansion(agent) -> tuple[int, int]:
    return agent.value_expansion, agent.branch_length


def test_it_is_the_recipe_of_the_hyperparameter_file():
    file = yaml.safe_load(hyperparams_path("mcbs_crossq").read_text())["HalfCheetah-v5"]
    recipe = {name: value for name, value in file.items() if name in SETTINGS}
    agent = make()
    assert {name: getattr(agent, name) for name in recipe} == recipe
    others = SETTINGS.keys() - recipe.keys() - {"preset", "model_kwargs"}
    assert {name: getattr(agent, name) for name in others} == {name: SETTINGS[name] for name in others}


@pytest.mark.parametrize("cls", SEARCHING)
def test_every_agent_learns_with_it_as_with_explicit_settings(cls):
    agent = make(cls=cls).learn(60)
    explicit = {name: getattr(agent, name) for name in SETTINGS.keys() - {"preset", "model_kwargs"}}
    other = make(cls=cls, preset=None, **explicit).learn(60)
    assert agent.n_simulated_steps == other.n_simulated_steps > 0
    np.testing.assert_array_equal(agent.replay_buffer.actions, other.replay_buffer.actions)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (dict(value_expansion=0), (0, 0)),
        (dict(value_expansion=3), (3, 20)),
        (dict(branch_length=0), (2, 0)),
        (dict(branch_length=30), (2, 30)),
        (dict(value_expansion=1, branch_length=5), (1, 5)),
        (dict(rollout_depth=0), (0, 0)),
        (dict(forward_model="pool"), (0, 0)),
    ],
)
def test_explicit_settings_of_the_expansion_win(tmp_path, given, expected):
    made = make(**given)
    made.save(tmp_path / "made")
    make(preset=None).save(tmp_path / "plain")
    loaded = MCBSTD3.load(tmp_path / "made", snapshot_vec_env(BATCHED), device="cpu")
    later = MCBSTD3.load(tmp_path / "plain", snapshot_vec_env(BATCHED), device="cpu", preset="train", **given)
    assert [expansion(agent) for agent in (made, loaded, later)] == [expected] * 3


def test_explicit_settings_of_the_search_win():
    agent = make(search_share=1.0, search_unit="step", beam_width=9, search_kwargs=dict(rollout_noise=0.2))
    assert (agent.search_share, agent.search_unit) == (1.0, "step") and expansion(agent) == (2, 20)
    changes = dict(beam_width=9, search_kwargs=dict(rollout_noise=0.2), model_kwargs=dict(n_threads=1))
    assert agent.search_settings == SearchSettings.preset("efficient", **changes)


def test_where_no_states_can_be_kept_it_leaves_the_expansion_out_and_says_so(capsys, tmp_path):
    agent = make(OTHER, verbose=1)
    assert [LEFT_OUT in line for line in capsys.readouterr().out.splitlines() if "Forward" in line] == [True]
    assert expansion(agent) == (0, 0) and agent.search_share == 0.5
    agent.learn(40)
    agent.save(tmp_path / "agent")
    agent.preset = "paper"
    assert LEFT_OUT not in capsys.readouterr().out
    agent.preset = "train"
    assert LEFT_OUT in capsys.readouterr().out
    assert expansion(MCBSTD3.load(tmp_path / "agent", snapshot_vec_env(OTHER), preset="train")) == (0, 0)
    for explicit in (dict(value_expansion=2), dict(branch_length=20)):
        with pytest.raises(ForwardModelError, match="Leave value_expansion out"):
            make(OTHER, **explicit)
        with pytest.raises(ForwardModelError, match="Leave value_expansion out"):
            MCBSTD3.load(tmp_path / "agent", snapshot_vec_env(OTHER), preset="train", **explicit)
    with pytest.raises(ForwardModelError, match="Leave value_expansion out"):
        MCBSTD3.load(tmp_path / "agent", snapshot_vec_env(OTHER), value_expansion=2)
    with pytest.raises(ForwardModelError, match="Leave value_expansion out"):
        agent.value_expansion = 2
    assert expansion(agent) == (0, 0)


def test_the_expansion_follows_the_forward_model(capsys):
    agent = make(verbose=1)
    agent.forward_model = "pool"
    assert expansion(agent) == (0, 0) and LEFT_OUT in capsys.readouterr().out
    agent.forward_model = "auto"
    assert expansion(agent) == (2, 20) and LEFT_OUT not in capsys.readouterr().out
    agent.value_expansion = 3
    with pytest.raises(ForwardModelError, match="Leave value_expansion out"):
        agent.forward_model = "pool"
    assert expansion(agent) == (3, 20)


def test_it_waits_for_an_environment(tmp_path):
    make(preset=None).save(tmp_path / "agent")
    agent = MCBSTD3.load(tmp_path / "agent", device="cpu", preset="train")
    agent.set_env(snapshot_vec_env(BATCHED))
    assert expansion(agent) == (2, 20)


def test_agents_change_between_it_and_algorithm_1(tmp_path):
    agent = make(action_noise=None).learn(40)
    agent.save(tmp_path / "agent")
    agent.preset = "paper"
    loaded = MCBSTD3.load(tmp_path / "agent", snapshot_vec_env(BATCHED), device="cpu", preset="paper")
    for each in (agent, loaded):
        assert (each.search_share, each.search_unit, *expansion(each)) == (1.0, "step", 0, 0)
    simulated = agent.n_simulated_steps
    agent.learn(10, reset_num_timesteps=False)
    assert agent.n_simulated_steps - simulated <= 10 * agent.search_settings.simulated_steps()
    agent.preset = "train"
    assert (agent.search_share, agent.search_unit, *expansion(agent)) == (0.5, "episode", 2, 20)
    agent.learn(40, reset_num_timesteps=False)
    assert len(agent.branches)


def test_a_buffer_that_keeps_no_last_observations_is_refused():
    settings = dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False))
    with pytest.raises(ValueError, match="optimize_memory_usage"):
        make(**settings)
    assert make(value_expansion=0, **settings).search_share == 0.5


def test_around_a_trained_agent_it_searches_as_efficient():
    agent = make(preset=None)
    policy = SearchPolicy(agent, make_vec_env(BATCHED), preset="train")
    assert policy.settings == SearchSettings.preset("efficient")
    policy.preset = "strong"
    policy.preset = "train"
    assert policy.settings == SearchSettings.preset("efficient")
