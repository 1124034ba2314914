"""Settings that are set as attributes of an agent, or given to ``load``: they hold, or are refused."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from gymnasium.wrappers import TransformReward
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs import MCBSSAC, MCBSTD3, MCBSTQC, SearchPolicy
from sb3_mcbs.agents.hyperparameters import SETTINGS
from sb3_mcbs.agents.schedule import ScheduleSettings
from sb3_mcbs.models import ForwardModelError
from sb3_mcbs.search import PRESETS, CEMSettings, SearchSettings, TreeSettings
from tests.checkpoint_helpers import assert_resumed_is_exact
from tests.conftest import SEARCHING, SMALL, SMALL_SEARCH, assert_same_parameters, snapshot_vec_env

CHANGES = [
    (MCBSTD3, dict(beam_width=5)),
    (MCBSTD3, dict(rollout_depth=0)),
    (
        MCBSTD3,
        dict(
            rollout_depth=3,
            n_simulations=1,
            beam_noise=0.3,
            search_kwargs=dict(rollout_noise=0.0, noise_clip=0.4),
        ),
    ),
    (MCBSTD3, dict(strategy="cem", rollout_depth=3)),
    (MCBSTD3, dict(strategy="tree", search_kwargs=dict(branching=2))),
    (MCBSTD3, dict(search_kwargs=dict(include_policy_action=True, antithetic=True))),
    (MCBSTD3, dict(model_kwargs=dict(n_threads=2), forward_model="pool", matmul_precision="high")),
    (MCBSTD3, dict(search_kwargs=dict(proposal_dims=1, n_proposals=6, noise_hold=2))),
    (MCBSTD3, dict(search_share=0.5, search_unit="episode")),
    (
        MCBSTD3,
        dict(
            search_schedule="saturation", schedule_kwargs=dict(final_search_share=0.1, saturation_window=20)
        ),
    ),
    (
        MCBSTD3,
        dict(search_schedule="anneal", schedule_kwargs=dict(final_beam_width=1, final_rollout_depth=1)),
    ),
    (MCBSSAC, dict(strategy="tree", search_kwargs=dict(branching=2))),
    (MCBSTQC, dict(beam_width=5)),
]


def change(agent, changes: dict) -> None:
    if "search_schedule" in changes:  # which has no meaning without the others, nor they without it
        own = changes["schedule_kwargs"]
        agent.schedule_settings = ScheduleSettings(search_schedule=changes["search_schedule"], **own)
        return
    for name, value in changes.items():
        setattr(agent, name, value)


def trained(agent, steps: int = 60, **kwargs):
    """Train an agent, whatever has drawn from the global generators since it was made."""
    agent.set_random_seed(3)
    return agent.learn(steps, **kwargs)


class SetsAttributes(BaseCallback):
    """Sets attributes of the agent at some step, as a user's callback does."""

    not_checkpointed = ("changes",)

    def __init__(self, step: int, changes: dict) -> None:
        super().__init__()
        self.step = step
        self.changes = changes

    def _on_step(self) -> bool:
        if self.num_timesteps == self.step:
            change(self.model, self.changes)
        return True


def assert_same_training(left, right) -> None:
    assert_same_parameters(left, right)
    for name in ("observations", "actions", "rewards"):
        np.testing.assert_array_equal(
            *(getattr(agent.replay_buffer, name) for agent in (left, right)), err_msg=name
        )
    assert left.n_simulated_steps == right.n_simulated_steps and left.n_decisions == right.n_decisions


@pytest.mark.parametrize(("cls", "changes"), CHANGES)
def test_set_later_is_as_set_at_construction(make_agent, cls, changes):
    made, changed = make_agent(cls=cls, **changes), make_agent(cls=cls)
    change(changed, changes)
    assert changed.search_settings == made.search_settings
    assert_same_training(trained(made), trained(changed))
    assert changed.logger.name_to_value.keys() == made.logger.name_to_value.keys()


@pytest.mark.parametrize(("cls", "changes"), CHANGES)
def test_a_callback_may_change_settings_while_training(make_agent, cls, changes):
    agent = trained(make_agent(cls=cls), callback=SetsAttributes(40, changes))
    assert agent.search_settings == make_agent(cls=cls, **changes).search_settings
    untouched = trained(make_agent(cls=cls))
    rows = [each.replay_buffer.actions[:60] for each in (agent, untouched)]
    np.testing.assert_array_equal(rows[0][:40], rows[1][:40])
    assert np.array_equal(*rows) == ("model_kwargs" in changes)


def test_a_changed_width_holds_from_the_next_decision_on(make_agent):
    agent = make_agent(beam_width=2, rollout_depth=1, n_simulations=1).learn(40)
    assert agent.n_simulated_steps == 20 * 2
    agent.beam_width = np.int64(7)
    agent.learn(10, reset_num_timesteps=False)
    assert agent.n_simulated_steps == 20 * 2 + 10 * 7
    assert agent.logger.name_to_value["search/beam_width"] == 7
    agent.search_share = 0.0
    agent.learn(10, reset_num_timesteps=False)
    assert agent.n_simulated_steps == 20 * 2 + 10 * 7
    agent.search_share = 1
    agent.learn(10, reset_num_timesteps=False)
    assert agent.n_simulated_steps == 20 * 2 + 20 * 7


@pytest.mark.parametrize("cls", SEARCHING)
def test_wrong_values_are_refused_at_once_and_change_nothing(make_agent, cls):
    agent, untouched = make_agent(cls=cls), trained(make_agent(cls=cls))
    before = agent.search_settings, agent.schedule_settings
    for name, value, error, match in (
        ("strategy", "nonsense", ValueError, "strategy must be one of"),
        ("strategy", ["tree"], ValueError, "strategy must be one of"),
        ("beam_width", 0, ValueError, "beam_width must be between 1"),
        ("beam_width", 2.5, TypeError, "beam_width must be an integer"),
        ("beam_noise", 0.0, ValueError, "beam_width above 1 needs a beam_noise above 0"),
        ("beam_noise", float("nan"), ValueError, "beam_noise must be finite"),
        ("search_kwargs", {"max_beam_width": 9}, ValueError, "max_beam_width needs a time_budget"),
        ("search_kwargs", {"proposal_dims": 2}, ValueError, "proposal_dims must be at most 1"),
        ("search_kwargs", {"branching": 2}, TypeError, "branching is for strategy='tree'"),
        ("search_kwargs", ["antithetic"], TypeError, "search_kwargs must be a dictionary or None"),
        ("search_share", 1.5, ValueError, "search_share must be finite"),
        ("schedule_kwargs", {"final_search_share": 0.5}, ValueError, "final_search_share has no meaning"),
        ("schedule_kwargs", {"window": 5}, TypeError, "search_schedule='constant' has no 'window'"),
        ("action_noise_after_search", "yes", TypeError, "action_noise_after_search"),
        ("preset", "quick", ValueError, "There is no preset 'quick'"),
        ("value_expansion", 2, ForwardModelError, "needs batched MuJoCo"),
        ("forward_model", "ensemble", ValueError, "decided when it is made or loaded"),
        ("forward_model", "mujoco", Exception, "environment 0"),
        ("model_kwargs", {"ensemble_size": 3}, TypeError, "ensemble_size is for forward_model='ensemble'"),
        ("model_kwargs", {"n_threads": -1}, ValueError, "n_threads must be between 0"),
        ("search_settings", {"beam_width": 3}, TypeError, "Expected BeamSettings"),
    ):
        with pytest.raises(error, match=match):
            setattr(agent, name, value)
    assert (agent.search_settings, agent.schedule_settings) == before and agent.preset is None
    assert_same_training(trained(agent), untouched)


@pytest.mark.parametrize("before", [0, 1])
def test_value_expansion_is_changed_and_switched_on(make_agent, before):
    agent = make_agent("InvertedPendulum-v5", value_expansion=before, expanded_share=0.5)
    agent.value_expansion, agent.expanded_share = 2, 0.25
    made = make_agent("InvertedPendulum-v5", value_expansion=2, expanded_share=0.25)
    assert_same_training(trained(agent), trained(made))


@pytest.mark.parametrize("branch_length", [0, 4])
def test_value_expansion_is_switched_off_and_on_while_training(make_agent, branch_length):
    agent = make_agent("InvertedPendulum-v5", search_share=0.0)
    simulated = {}

    class Notes(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls in (30, 60):
                self.model.value_expansion = 2
                self.model.branch_length = branch_length
            if self.n_calls == 45:
                self.model.branch_length = 0
                self.model.value_expansion = 0
            simulated[self.n_calls] = self.model.n_simulated_steps
            return True

    agent.learn(80, callback=Notes())
    assert simulated[30] == 0 < simulated[46] == simulated[60] < simulated[80]
    held = agent.replay_buffer.expansion_held[:80, 0]
    assert not held[:29].any() and not held[45:59].any() and held[31:44].any() and held[61:80].any()
    agent.branch_length = agent.value_expansion = 0
    assert agent.branches is None
    agent.learn(20, reset_num_timesteps=False)
    assert not hasattr(agent.replay_buffer, "expansion_held")


def test_all_settings_change_at_once(make_agent):
    agent = make_agent(beam_width=1, beam_noise=0.0, search_kwargs=dict(rollout_noise=0.1), search_share=0.5)
    with pytest.raises(ValueError, match="beam_noise above 0"):
        agent.strategy = "cem"
    agent.search_settings = CEMSettings(beam_width=4, rollout_depth=2, n_simulations=2, n_threads=1)
    agent.schedule_settings = ScheduleSettings(search_share=0.25)
    assert (agent.strategy, agent.beam_width, agent.search_share) == ("cem", 4, 0.25)
    agent.learn(60)
    assert 0 < agent.n_decisions < 40


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_can_be_set_later_and_when_loading(tmp_path, preset):
    expected = SearchSettings.preset(preset, model_kwargs=dict(n_threads=1))
    before = "paper" if preset == "strong" else "strong"
    env = snapshot_vec_env("Pendulum-v1")
    agent = MCBSTD3(
        "MlpPolicy", env, preset=before, search_share=0.5, model_kwargs=dict(n_threads=1), **SMALL
    )
    agent.save(tmp_path / "agent")
    agent.preset = preset
    loaded = MCBSTD3.load(tmp_path / "agent", snapshot_vec_env("Pendulum-v1"), device="cpu", preset=preset)
    for each in (agent, loaded):
        assert (each.preset, each.search_settings) == (preset, expected)
        assert each.search_share == (1.0 if preset == "paper" else 0.5)  # Algorithm 1 is at every step
        assert each.search_unit == ("episode" if preset == "train" else "step")
    changed = MCBSTD3.load(tmp_path / "agent", device="cpu", preset=preset, beam_width=9)
    assert changed.search_settings == replace(expected, beam_width=9)
    without = MCBSTD3.load(tmp_path / "agent", device="cpu", preset=None)
    assert without.preset is None
    loaded.learn(110)


def test_changed_settings_are_saved(make_agent, tmp_path):
    agent = make_agent()
    agent.beam_width, agent.search_share = 8, 0.5
    agent.save(tmp_path / "agent")
    loaded = MCBSTD3.load(tmp_path / "agent", snapshot_vec_env("Pendulum-v1"), device="cpu")
    assert (loaded.beam_width, loaded.search_share) == (8, 0.5)
    loaded.strategy = "tree"
    assert loaded.learn(40).search_settings.strategy == "tree"


def test_where_the_schedule_starts_to_leave_the_search_out_the_actor_explores(make_agent):
    agent = make_agent(gradient_steps=0, train_freq=1000)
    agent.learn(60, callback=SetsAttributes(30, dict(search_share=0.0)))
    observations, actions = agent.replay_buffer.observations[31:60, 0], agent.replay_buffer.actions[31:60, 0]
    noise = actions - agent.policy.scale_action(agent.predict(observations)[0])
    assert agent.n_decisions == 10 and 0.02 < noise.std() < 0.3


@pytest.mark.parametrize(
    "changes",
    [
        dict(beam_width=5),
        dict(strategy="cem"),
        dict(search_kwargs=dict(antithetic=True)),
        dict(search_share=0.3),
        dict(value_expansion=2, branch_length=4),
    ],
)
def test_a_resumed_run_goes_on_with_the_changed_settings(tmp_path, changes):
    def make(folder):
        env = snapshot_vec_env("InvertedPendulum-v5")
        return MCBSTD3("MlpPolicy", env, seed=0, learning_starts=20, **SMALL, **SMALL_SEARCH)

    def more(folder):
        return [SetsAttributes(50, changes)]

    agents = assert_resumed_is_exact(make, tmp_path, more=more)
    for agent in agents:
        assert {name: getattr(agent, name) for name in changes} == changes
        assert agent.planner.settings == agent.search_settings


def test_what_is_changed_within_a_dictionary_holds_from_the_next_decision_on(make_agent, tmp_path):
    given = dict(noise_clip=0.5)
    agent = make_agent(search_kwargs=given).learn(30)
    given["noise_clip"] = 0.1
    assert agent.search_settings.noise_clip == 0.5, "it is the caller's own"
    agent.search_kwargs["noise_clip"] = 0.2
    agent.learn(10, reset_num_timesteps=False)
    assert agent.planner.settings.noise_clip == 0.2
    agent.save(tmp_path / "agent")
    assert MCBSTD3.load(tmp_path / "agent").search_kwargs == {"noise_clip": 0.2}
    other = copy.copy(agent)
    other.search_kwargs["branching"] = 2
    with pytest.raises(TypeError, match="branching is for strategy='tree'"):
        other.learn(10)
    agent.learn(30)
    policy = SearchPolicy(agent, agent.get_env(), seed=0)
    with pytest.raises(TypeError, match="does not support item assignment"):
        policy.search_kwargs["noise_clip"] = 0.3
    policy.search_kwargs = {**policy.search_kwargs, "antithetic": True}
    assert (policy.settings.noise_clip, policy.settings.antithetic) == (0.2, True)


def test_what_was_taken_from_a_preset_does_not_come_back(tmp_path):
    """An agent is made again from its attributes, the preset among them."""
    for changes in ({"search_kwargs": None}, {"search_kwargs": {"n_rounds": 2}}, {"strategy": "tree"}):
        agent = MCBSTD3("MlpPolicy", "Pendulum-v1", preset="strong", strategy="beam", **SMALL)
        agent.preset = "strong"
        if "strategy" in changes:
            agent.search_kwargs = {"antithetic": True}
        for name, value in changes.items():
            setattr(agent, name, value)
        again = {name: getattr(agent, name) for name in SETTINGS}
        assert agent.preset is None
        assert MCBSTD3("MlpPolicy", "Pendulum-v1", **again, **SMALL).search_settings == agent.search_settings
    agent = MCBSTD3("MlpPolicy", "Pendulum-v1", preset="strong", **SMALL)
    agent.beam_width, agent.search_kwargs = 8, {**agent.search_kwargs, "n_rounds": 2}
    assert agent.preset == "strong" and agent.search_settings.n_elites == 4


def test_settings_of_a_search_policy_are_attributes(make_agent):
    agent = make_agent()
    env = agent.get_env()
    policy = SearchPolicy(agent, env, seed=0, beam_width=2)
    observation = env.reset()

    def simulated() -> int:
        policy.predict(observation)
        return policy.last_result.simulated_steps

    assert (policy.beam_width, agent.beam_width, simulated()) == (2, 3, 2 + 2 * 2)
    policy.beam_width = 5
    assert (policy.beam_width, agent.beam_width, simulated()) == (5, 3, 5 + 2 * 5)
    policy.rollout_depth = 0
    assert simulated() == 0
    policy.settings = TreeSettings(beam_width=2, branching=3, rollout_depth=2, n_threads=1)
    assert simulated() == policy.settings.simulated_steps() == 12
    policy.preset = "efficient"
    assert policy.settings == SearchSettings.preset("efficient", model_kwargs=dict(n_threads=1))
    assert simulated() == 18
    expected = SearchPolicy(agent, env, seed=1, preset="efficient", model_kwargs=dict(n_threads=1))
    policy.rng = np.random.default_rng(1)
    np.testing.assert_array_equal(policy.predict(observation)[0], expected.predict(observation)[0])


def test_what_a_search_policy_does_not_follow_is_refused(make_agent):
    agent, other = make_agent(), make_agent()
    policy = SearchPolicy(agent, agent.get_env(), seed=0)
    before = policy.settings
    for name, value, error, match in (
        ("strategy", "nonsense", ValueError, "strategy must be one of"),
        ("search_kwargs", {"proposal_dims": 2}, ValueError, "proposal_dims must be at most 1"),
        ("model_kwargs", {"ensemble_size": 3}, TypeError, "has no 'ensemble_size'"),
        ("forward_model", "mujoco", Exception, "environment 0"),
        ("settings", {"beam_width": 3}, TypeError, "Expected BeamSettings"),
        ("preset", "quick", ValueError, "There is no preset 'quick'"),
        ("vec_env", other.get_env(), AttributeError, "vec_env of a SearchPolicy cannot be exchanged"),
        ("model", other, AttributeError, "model of a SearchPolicy cannot be exchanged"),
    ):
        with pytest.raises(error, match=match):
            setattr(policy, name, value)
    assert policy.settings == before
    policy.predict(agent.get_env().reset())
    policy.gamma = 0.5
    assert agent.gamma == 0.5, "attributes of the agent are set where they are read"


def test_a_shallow_copy_has_settings_of_its_own(make_agent):
    agent = make_agent()
    other = copy.copy(agent)
    other.beam_width, other.search_share = 5, 0.0
    assert (agent.beam_width, agent.search_share) == (3, 1.0) and other.policy is agent.policy
    agent.learn(30)
    assert agent.n_simulated_steps == 10 * (3 + 3 * 2)
    policy = SearchPolicy(agent, agent.get_env(), seed=0)
    other = copy.copy(policy)
    other.beam_width = 7
    for each, width in ((policy, 3), (other, 7)):
        each.predict(agent.get_env().reset())
        assert each.last_result.values.shape[1] == each.beam_width == width


def test_noise_that_is_not_there_is_missed_at_once(make_agent):
    agent = make_agent()
    with pytest.raises(ValueError, match="there is none: pass an action_noise"):
        agent.learn(40, callback=SetsAttributes(30, dict(action_noise_after_search=True)))
    noise = NormalActionNoise(np.zeros(1), np.full(1, 0.1))
    agent = make_agent(search_share=0.0, action_noise=noise, gradient_steps=0, train_freq=1000)
    agent.learn(60, callback=SetsAttributes(30, dict(action_noise=None)))
    observations, actions = agent.replay_buffer.observations[31:60, 0], agent.replay_buffer.actions[31:60, 0]
    assert (actions - agent.policy.scale_action(agent.predict(observations)[0])).std() > 0.02


def test_rewards_are_scaled_as_the_critics_learn_them(make_agent):
    env = VecNormalize(make_vec_env("Pendulum-v1", 1, seed=0))
    agent = make_agent(env).learn(40)
    rewards = np.array([-1.0])
    for normalize in (False, True):
        env.norm_reward = normalize
        agent.learn(2, reset_num_timesteps=False)
        assert (agent.planner.source.view.scale_reward(rewards) == rewards).all() != normalize


def test_what_was_noticed_of_the_environment_is_not_forgotten(make_agent):
    agent = make_agent().learn(25)
    agent.planner.model.deterministic = False
    agent.model_kwargs = dict(n_threads=2)
    assert not agent.planner.model.deterministic
    agent.beam_width = 4
    assert not agent.planner.model.deterministic


def test_an_environment_that_cannot_be_searched_in_leaves_the_old_one(make_agent):
    agent = make_agent("InvertedPendulum-v5", forward_model="mujoco").learn(30)
    before = agent.get_env()
    with pytest.raises(ValueError, match="spaces do not match"):
        agent.set_env(make_vec_env("Pendulum-v1", 1))
    other = make_vec_env(
        "InvertedPendulum-v5", 1, wrapper_class=TransformReward, wrapper_kwargs=dict(func=abs)
    )
    with pytest.raises(Exception, match="environment 0"):
        agent.set_env(other)
    assert agent.get_env() is before
    agent.learn(10, reset_num_timesteps=False)
    assert agent.n_decisions == 20


def test_a_copy_without_environments_takes_settings(make_agent):
    agent = make_agent(VecNormalize(make_vec_env("Pendulum-v1", 1, seed=0)), strategy="cem").learn(30)
    other = copy.deepcopy(agent)
    other.beam_width, other.rollout_depth, other.search_share = 7, 3, 0.5
    other.set_env(VecNormalize(make_vec_env("Pendulum-v1", 1, seed=0)))
    assert other.learn(30).search_settings == replace(agent.search_settings, beam_width=7, rollout_depth=3)


def test_value_expansion_refuses_another_simulator_at_once(make_agent):
    agent = make_agent("InvertedPendulum-v5", value_expansion=1)
    with pytest.raises(Exception, match="needs batched MuJoCo"):
        agent.forward_model = "pool"
    agent.learn(40)


def test_a_preset_among_custom_objects(make_agent, tmp_path):
    make_agent().save(tmp_path / "agent")
    loaded = MCBSTD3.load(tmp_path / "agent", device="cpu", custom_objects={"preset": "strong"})
    assert loaded.search_settings == SearchSettings.preset("strong", model_kwargs=dict(n_threads=1))


def test_a_search_policy_says_what_is_not_its_own(make_agent):
    plain = make_agent(cls=TD3)
    policy = SearchPolicy(plain, plain.get_env(), seed=0)
    with pytest.raises(AttributeError, match="search_share is for agents that search while they train"):
        policy.search_share = 0.5
    policy.preset = "efficient"
    policy.preset = "balanced"
    assert policy.preset == "balanced" and policy.settings == SearchSettings.preset("balanced")


class Doubling(MCBSTD3):
    """A user's class that has made a property of a setting."""

    @property
    def beam_width(self):
        return 2 * self._half_width

    @beam_width.setter
    def beam_width(self, width):
        self._half_width = width


def test_a_property_of_a_class_of_the_users_is_asked(make_agent):
    agent = make_agent(cls=Doubling)
    agent.beam_width = 4
    agent.learn(30)
    assert agent.n_simulated_steps == 10 * (8 + 8 * 2)
