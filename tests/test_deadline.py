"""Search until a deadline, on a clock that the tests move."""

import numpy as np
import pytest

from sb3_mcbs import MCBSTD3, BeamSettings, SearchPolicy
from sb3_mcbs.search import LatencyForecast, PolicyFunctions, Roots, beam_search, deadline_search
from sb3_mcbs.search.beam import Noise
from tests.conftest import snapshot_vec_env
from tests.fake_model import LineWorld


class Clock:
    """Seconds that pass only when the world is stepped."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


class SlowWorld(LineWorld):
    """Every row of every step takes its time."""

    def __init__(self, clock, seconds_per_row=1.0, overhead=0.0, **kwargs):
        super().__init__(**kwargs)
        self.clock, self.seconds_per_row, self.overhead = clock, seconds_per_row, overhead

    def step(self, actions):
        self.clock.now += self.overhead + self.seconds_per_row * len(actions)
        return super().step(actions)


AGENT = PolicyFunctions(
    policy=lambda observations: np.zeros((len(observations), 1), dtype=np.float32),
    value=lambda observations, actions: -np.abs(observations[:, 0]).astype(np.float32),
    gamma=0.9,
    unscale_action=lambda actions: actions,
    scale_reward=lambda rewards: rewards,
    act_dim=1,
)


def settings(**changes):
    return BeamSettings(
        **{**dict(beam_width=8, rollout_depth=1, n_simulations=1, time_budget=1.0), **changes}
    )


def decide(world, pace, budget, seed=0, n_envs=1, **changes):
    roots = list(np.linspace(1.0, 2.0, n_envs))
    observations = np.array(roots)[:, None]
    deadline = pace.clock() + budget
    rng = np.random.default_rng(seed)
    start = Roots(world, roots, observations)
    return deadline_search(start, AGENT, settings(**changes), deadline, pace, rng)


def test_rounds_are_added_while_there_is_time():
    clock = Clock()
    world, pace = SlowWorld(clock), LatencyForecast(clock)
    assert decide(world, pace, 0.5).rounds == 1, "the first decision knows nothing yet, and is late"
    for _ in range(100):
        decide(world, pace, 5.0)
    for budget, most in ((0.5, 0), (1.5, 1), (3.5, 3), (7.5, 7), (100.0, 8)):
        start = clock.now
        assert decide(world, pace, budget).values.shape[1] == most
        assert clock.now - start <= budget


def test_the_best_of_all_rounds_is_chosen_and_matches_one_beam():
    clock = Clock()
    world, pace = SlowWorld(clock), LatencyForecast(clock)
    for _ in range(3):
        decide(world, pace, 40.0, n_envs=3)
    result = decide(world, pace, 40.0, seed=3, n_envs=3)
    assert result.rounds > 1 and result.values.shape == (3, 8) == result.candidates.shape[:2]
    np.testing.assert_array_equal(result.chosen, result.values.argmax(axis=1))
    noise = Noise(result.candidates, np.zeros((1, 3, 8, 1, 1), dtype=np.float32))
    roots = list(np.linspace(1.0, 2.0, 3))
    one_beam = beam_search(
        Roots(LineWorld(), roots, np.array(roots)[:, None]),
        AGENT,
        BeamSettings(8, 1, 1),
        noise,
        np.random.default_rng(0),
    )
    # With depth 1 the value is that of the first step and of the state after it, whatever the later noise.
    np.testing.assert_allclose(result.values, one_beam.values, rtol=1e-6)
    np.testing.assert_array_equal(result.actions, one_beam.actions)
    np.testing.assert_array_equal(result.first_step.rewards, one_beam.first_step.rewards)
    np.testing.assert_array_equal(result.first_step.observations, one_beam.first_step.observations)


def test_unfinished_rounds_do_not_count():
    clock = Clock()
    world, pace = SlowWorld(clock), LatencyForecast(clock)
    result = decide(world, pace, 1.5, rollout_depth=5)
    assert result.rounds == 0 and result.chosen[0] == -1 and result.first_step is None
    assert result.actions[0] == 0.0, "the policy's own action"
    assert result.simulated_steps == world.steps_taken == 2, "given up at the first step after the deadline"
    # Once the steps are known, one that would end after the deadline is not begun.
    for number in range(60):
        start = clock.now
        assert decide(world, pace, 1.5, rollout_depth=5).rounds == 0
        assert clock.now - start <= 1.5 or number < 15
    assert decide(world, pace, 5.5, rollout_depth=5).rounds == 1


def rounds_of(world, pace, n_decisions):
    """How many rounds decisions do that want one candidate within a second."""
    return [decide(world, pace, 1.0, beam_width=1).rounds for _ in range(n_decisions)]


def test_one_hiccup_does_not_end_searching():
    clock = Clock()
    world, pace = SlowWorld(clock, seconds_per_row=0.1), LatencyForecast(clock)
    assert rounds_of(world, pace, 40) == [1] * 40
    start, world.seconds_per_row = clock.now, 10.0
    assert rounds_of(world, pace, 1) == [1]
    assert clock.now - start == 10.0, "late, and known to be"
    world.seconds_per_row = 0.1
    assert rounds_of(world, pace, 60) == [1] * 60


def test_searching_begins_again_when_the_machine_is_quick_again():
    clock = Clock()
    world, pace = SlowWorld(clock, seconds_per_row=2.0), LatencyForecast(clock)
    assert rounds_of(world, pace, 20)[-5:] == [0] * 5, "no round is expected to end in time"
    world.seconds_per_row = 0.1
    results = rounds_of(world, pace, 400)
    assert results[0] == 0 and results[-100:] == [1] * 100


def test_more_candidates_than_the_beam_if_wanted():
    clock = Clock()
    world, pace = SlowWorld(clock), LatencyForecast(clock)
    for _ in range(4):
        result = decide(world, pace, 100.0, max_beam_width=30)
    assert result.values.shape[1] == 30


def test_the_policys_action_is_among_the_candidates_once():
    clock = Clock()
    world, pace = SlowWorld(clock), LatencyForecast(clock)
    for _ in range(3):
        result = decide(world, pace, 12.0, include_policy_action=True)
    assert result.rounds > 1
    assert (result.candidates[0, :, 0] == 0.0).sum() == 1


def test_wide_rounds_leave_half_of_the_time():
    pace = LatencyForecast(Clock())
    for width in 10 * (1, 2, 4, 8):
        pace.note_round(width, float(width))
    assert pace.affordable(7.0, 100) == 2
    assert pace.affordable(1.5, 100) == 1
    assert pace.affordable(0.5, 100) == 0
    assert pace.affordable(1000.0, 5) == 5
    pace.ending.note(1.0)
    assert pace.affordable(1.5, 100) == 0


def test_settings_are_checked():
    for bad, match in (
        (dict(time_budget=0.0), "above 0"),
        (dict(time_budget=float("nan")), "finite"),
        (dict(time_budget=0.1, rollout_depth=0), "rollout_depth"),
        (dict(max_beam_width=20, time_budget=None), "needs a time_budget"),
        (dict(max_beam_width=3), "max_beam_width"),
    ):
        with pytest.raises(ValueError, match=match):
            settings(**bad)
    for bad, match in (
        (dict(time_budget="fast"), "time_budget"),
        (dict(max_beam_width="0"), "max_beam_width"),
    ):
        with pytest.raises(TypeError, match=match):
            settings(**bad)


def test_an_agent_trains_and_acts_with_a_budget(make_agent, tmp_path):
    agent = make_agent(search_kwargs=dict(time_budget=30.0, max_beam_width=12))
    agent.learn(60)
    assert agent.n_decisions == 40 and agent.n_simulated_steps > 0
    agent.save(tmp_path / "agent")
    loaded = MCBSTD3.load(tmp_path / "agent", device="cpu")
    assert loaded.search_kwargs == dict(time_budget=30.0, max_beam_width=12)
    env = snapshot_vec_env("Pendulum-v1")
    policy = SearchPolicy(loaded, env, seed=0)
    observations = env.reset()
    for _ in range(3):
        actions, _ = policy.predict(observations)
        observations, *_ = env.step(actions)
    assert policy.last_result.rounds >= 1  # in 30 seconds, on any machine
    assert policy.last_result.values.shape[1] <= 12


def test_the_critics_answers_are_counted():
    clock = Clock()
    world, pace = SlowWorld(clock), LatencyForecast(clock)
    for _ in range(3):
        result = decide(world, pace, 40.0)
    assert result.critic_evaluations == 8 == result.values.size


def test_searches_of_some_environments_do_not_spoil_the_forecasts_of_all():
    agent = MCBSTD3(
        "MlpPolicy",
        snapshot_vec_env("HalfCheetah-v5", 3),
        search_kwargs=dict(time_budget=0.05),
        seed=0,
        device="cpu",
    )
    agent._setup_learn(1)
    planner = agent.planner
    for envs in ([0], [0, 1, 2], [2]):
        planner.plan(agent._last_obs, agent.search_rng, envs)
    assert {n_envs for n_envs, _ in planner._forecasts} == {1, 3}
