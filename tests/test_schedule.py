"""When to search: shares of steps and episodes, the paper's saturation rule, and anneals."""

from collections import deque

import numpy as np
import pytest
from sb3_contrib import CrossQ
from stable_baselines3 import TD3
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_mcbs import MCBSSAC, MCBSTD3, MCBSTQC, MCBSCrossQ
from sb3_mcbs.agents.schedule import ScheduleSettings, SearchSchedule
from sb3_mcbs.search import BeamSettings, draw_noise
from sb3_mcbs.search.random_streams import spawn_rng
from tests.checkpoint_helpers import assert_resumed_is_exact
from tests.conftest import SEARCHING, WITHOUT_SEARCH, assert_same_parameters, snapshot_vec_env

EPISODE = 100
GSDE = dict(use_sde=True, use_sde_at_warmup=True, sde_sample_freq=4)
WINDOW = 1000


def simulate(return_of, settings: ScheduleSettings, n_steps: int, n_envs: int = 1, noise: float = 0.0):
    """Run a schedule on made-up returns.

    :param return_of: gives an episode's return at a step, and what search adds to it.
    :return: the schedule, and ``[step, is_reduced]`` of every change.
    """
    schedule, rng = SearchSchedule(settings, seed=0), np.random.default_rng(1)
    schedule.begin_episodes(n_envs, 0)
    changes, searched = [], deque([np.zeros(n_envs)], maxlen=EPISODE)
    for step in range(n_envs, n_steps, n_envs):
        before = schedule.saturation.is_reduced
        if step > WINDOW:
            searched.append(schedule.draw(step / n_steps, step))
        rewards, ends = np.zeros(n_envs), np.full(n_envs, (step // n_envs) % EPISODE == 0)
        if ends.all():
            total, bonus = return_of(step)
            rewards = total + bonus * np.mean(searched, axis=0) + noise * rng.normal(size=n_envs)
        schedule.record_rewards(rewards, ends, step)
        if schedule.saturation.is_reduced != before:
            changes.append((step, schedule.saturation.is_reduced))
    return schedule, changes


def rising_flat_falling(step: int) -> float:
    return float(np.interp(step, [0, 10_000, 30_000, 40_000], [-200, 3000, 3000, 500]))


SATURATION = dict(search_schedule="saturation", saturation_window=WINDOW)


@pytest.mark.parametrize("unit", ["step", "episode"])
@pytest.mark.parametrize("noise", [0.0, 30.0])
@pytest.mark.parametrize("n_envs", [1, 4])
def test_a_rising_flat_and_falling_return_gives_one_decrease_and_one_recovery(unit, noise, n_envs):
    settings = ScheduleSettings(**SATURATION, search_unit=unit)
    _, changes = simulate(lambda step: (rising_flat_falling(step), 0), settings, 40_000, n_envs, noise)
    assert [reduced for _, reduced in changes] == [True, False]
    decrease, recovery = (step for step, _ in changes)
    assert 10_000 < decrease < 14_000 and 30_000 < recovery < 34_000


@pytest.mark.parametrize("unit", ["step", "episode"])
@pytest.mark.parametrize("bonus", [500.0, 2000.0])
def test_what_search_adds_to_the_return_gives_no_cycling(unit, bonus):
    """A running mean would read its own reduction as a fall of the return, and go to and fro."""
    settings = ScheduleSettings(**SATURATION, search_unit=unit)

    def flat(step):
        return float(np.interp(step, [0, 10_000], [-200, 3000])), bonus

    _, changes = simulate(flat, settings, 100_000, noise=20.0)
    assert [reduced for _, reduced in changes] == [True]


@pytest.mark.parametrize("unit", ["step", "episode"])
@pytest.mark.parametrize("noise", [320.0, 480.0, 960.0])
def test_noisy_returns_give_no_cycling(unit, noise):
    """Over a hundred windows some are low by chance, and the best is high by chance."""
    settings = ScheduleSettings(**SATURATION, search_unit=unit)

    def flat(step):
        return float(np.interp(step, [0, 10_000], [-200, 3000])), 500.0

    _, changes = simulate(flat, settings, 100_000, noise=noise)
    assert [reduced for _, reduced in changes] == [True]


@pytest.mark.parametrize("noise", [160.0, 320.0, 480.0])
def test_a_fall_of_noisy_returns_is_noticed(noise):
    settings = ScheduleSettings(**SATURATION)
    _, changes = simulate(lambda step: (rising_flat_falling(step), 0), settings, 36_000, 1, noise)
    assert [reduced for _, reduced in changes][:2] == [True, False]
    assert 30_000 < changes[1][0] < 35_000


def test_a_return_that_never_improved_is_not_saturated():
    _, changes = simulate(lambda step: (-200.0, 0), ScheduleSettings(**SATURATION), 60_000, noise=50.0)
    assert changes == []


def test_nothing_changes_within_two_windows_of_a_change_or_without_two_episodes():
    settings = ScheduleSettings(**SATURATION)
    _, changes = simulate(
        lambda step: (3000.0 * (step > 3 * WINDOW) * (step < 8 * WINDOW), 0), settings, 20_000
    )
    assert len(changes) == 2 and changes[1][0] - changes[0][0] >= 2 * WINDOW
    short = ScheduleSettings(search_schedule="saturation", saturation_window=EPISODE)
    assert simulate(lambda step: (rising_flat_falling(step), 0), short, 40_000)[1] == []


@pytest.mark.parametrize("seed", range(3))
def test_a_moderate_fall_that_lasts_is_noticed_and_a_rare_failure_is_not(seed):
    """Some episodes end early: the mean falls by less than single returns vary."""
    for share, is_fall in ((0.4, True), (0.03, False)):
        rng = np.random.default_rng(seed)

        def failing(step, share=share, rng=rng):
            level = float(np.interp(step, [0, 10_000], [0, 3000]))
            return (-200.0 if step > 30_000 and rng.random() < share else level), 0.0

        _, changes = simulate(failing, ScheduleSettings(**SATURATION), 50_000)
        assert changes[0][1] and changes[0][0] < 20_000
        assert (len(changes) > 1 and 30_000 < changes[1][0] < 42_000) == is_fall


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_shares_of_steps_and_of_episodes(share):
    for unit in ("step", "episode"):
        schedule = SearchSchedule(ScheduleSettings(search_share=share, search_unit=unit), seed=3)
        schedule.begin_episodes(5, 0)
        drawn = []
        for step in range(4000):
            drawn.append(schedule.draw(0.0, step))
            schedule.record_rewards(np.zeros(5), np.full(5, step % 10 == 9), step)
        searched = np.array(drawn).reshape(400, 10, 5)
        assert abs(searched.mean() - share) < 0.03
        if unit == "episode":
            assert (searched == searched[:, :1]).all(), "an episode is searched as a whole or not at all"
            assert share in (0, 1) or not (searched == searched[:, :, :1]).all(), "each environment draws"
        # The generator moved equally far whatever the settings are.
        other = SearchSchedule(ScheduleSettings(), seed=3)
        other.begin_episodes(5, 0)
        for step in range(4000):
            other.draw(0.0, step)
        assert schedule.rng.bit_generator.state == other.rng.bit_generator.state


def test_anneals():
    settings = ScheduleSettings(
        "anneal", search_share=1.0, final_search_share=0.2, final_beam_width=2, final_rollout_depth=5
    )
    schedule, search = SearchSchedule(settings, 0), BeamSettings(10, 3)
    assert [round(schedule.share(p), 3) for p in (0.0, 0.5, 1.0)] == [1.0, 0.6, 0.2]
    efforts = [schedule.settings_at(search, p) for p in (0.0, 0.5, 1.0)]
    assert [(e.beam_width, e.rollout_depth) for e in efforts] == [(10, 3), (6, 4), (2, 5)]
    constant = SearchSchedule(ScheduleSettings(search_share=0.4), 0)
    assert constant.share(0.9) == 0.4 and constant.settings_at(search, 0.9) is search


@pytest.mark.parametrize(
    "settings, search, words",
    [
        (dict(search_schedule="sometimes"), {}, "search_schedule must be one of"),
        (dict(search_share=1.5), {}, "search_share must be .* at most 1"),
        (dict(search_share=np.nan), {}, "search_share"),
        (dict(search_unit="epoch"), {}, "search_unit"),
        (dict(schedule_kwargs=dict(final_search_share=0.5)), {}, "final_search_share has no meaning"),
        (
            dict(schedule_kwargs=dict(final_beam_width=3), search_schedule="saturation"),
            {},
            "final_beam_width has no meaning",
        ),
        (
            dict(search_schedule="saturation", schedule_kwargs=dict(final_search_share=1.0)),
            {},
            "below search_share",
        ),
        (dict(search_schedule="saturation", search_share=0.0), {}, "below search_share"),
        (
            dict(search_schedule="saturation", schedule_kwargs=dict(recovery_tolerance=0.01)),
            {},
            "recovery_tolerance must be above",
        ),
        (dict(schedule_kwargs=dict(saturation_window=0)), {}, "saturation_window"),
        (
            dict(search_schedule="anneal", schedule_kwargs=dict(final_rollout_depth=0)),
            {},
            "both be 0 or both be 1",
        ),
        (dict(search_schedule="anneal"), {}, "needs something to end at"),
        (
            dict(search_schedule="anneal", schedule_kwargs=dict(final_beam_width=3)),
            dict(search_kwargs=dict(time_budget=1.0, max_beam_width=50)),
            "no meaning with max_beam_width",
        ),
        (
            dict(
                search_schedule="anneal", schedule_kwargs=dict(final_beam_width=5, final_rollout_depth=5000)
            ),
            dict(beam_width=20_000, rollout_depth=5, n_simulations=1),
            "widest and deepest search of the anneal",
        ),
        (
            dict(search_schedule="anneal", schedule_kwargs=dict(final_rollout_depth=2)),
            dict(strategy="cem"),
            "strategy='cem'",
        ),
        (
            dict(search_schedule="anneal", schedule_kwargs=dict(final_beam_width=3)),
            dict(strategy="tree", beam_width=4, search_kwargs=dict(n_proposals=24)),
            "n_proposals of a tree",
        ),
        (
            dict(search_schedule="anneal", schedule_kwargs=dict(final_beam_width=2)),
            dict(strategy="cem", search_kwargs=dict(n_elites=3)),
            "At the end of the anneal",
        ),
    ],
)
def test_settings_without_a_meaning_are_refused(make_agent, settings, search, words):
    with pytest.raises(ValueError, match=words):
        make_agent(**settings, **search)


@pytest.mark.parametrize(
    "cls, settings", [*((cls, {}) for cls in SEARCHING), (MCBSSAC, GSDE), (MCBSTQC, GSDE), (MCBSCrossQ, GSDE)]
)
def test_without_searched_steps_an_agent_is_the_one_without_search(make_agent, cls, settings):
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.3 * np.ones(1))
    agents = [
        make_agent(snapshot_vec_env("Pendulum-v1", 2), cls=each, action_noise=noise, **settings, **share)
        for each, share in (
            (
                cls,
                dict(search_share=0.0, **(dict(fast_update=False) if issubclass(cls, TD3 | CrossQ) else {})),
            ),
            (WITHOUT_SEARCH[cls], {}),
        )
    ]
    for agent in agents:
        agent.set_random_seed(5)
        agent.learn(100)
    ours, plain = agents
    assert ours.n_decisions == 0
    np.testing.assert_array_equal(ours.replay_buffer.actions, plain.replay_buffer.actions)
    np.testing.assert_array_equal(ours.replay_buffer.observations, plain.replay_buffer.observations)
    assert_same_parameters(ours, plain)


@pytest.mark.parametrize("cls", SEARCHING)
def test_streams_do_not_depend_on_the_schedule(make_agent, cls):
    """What is not searched is the same whatever else is, until something searched changes the world."""
    first_unsearched = {}
    for share in (0.0, 0.5):
        agent = make_agent(
            snapshot_vec_env("Pendulum-v1", 4),
            cls=cls,
            search_share=share,
            action_noise=NormalActionNoise(np.zeros(1), 0.2 * np.ones(1)),
            seed=1,
        )
        agent.learn(24)  # the first step after 20 random ones
        first_unsearched[share] = agent.replay_buffer.actions[5]
        searched = [] if agent._prediction is None else list(agent._prediction.envs)
    kept = [env for env in range(4) if env not in searched]
    assert searched and kept, "some of each"
    same = first_unsearched[0.0] == first_unsearched[0.5]
    assert same[kept].all() and not same[searched].any()


class Draws:
    """The noise of a search, given out environment by environment."""

    def __init__(self, noise):
        self.noise = noise

    def of(self, envs):
        return self.noise._replace(beam=self.noise.beam[envs], rollout=self.noise.rollout[:, envs])


@pytest.mark.parametrize("env_id", ["Hopper-v5", "Pendulum-v1"])
@pytest.mark.parametrize("vec_env_cls", [None, SubprocVecEnv])
def test_only_searched_rows_are_read_and_simulated(make_agent, monkeypatch, env_id, vec_env_cls):
    """Four environments of which some are searched equal single searches with the same noise."""
    agent = make_agent(snapshot_vec_env(env_id, 4, vec_env_cls=vec_env_cls), learning_starts=8)
    agent.learn(8)
    planner, rng = agent.planner, np.random.default_rng(0)
    noise = Draws(
        draw_noise(np.random.default_rng(2), planner.settings, 4, int(np.prod(agent.action_space.shape)))
    )
    read = []
    read_roots = planner.model.read_roots
    monkeypatch.setattr(planner.model, "read_roots", lambda envs: read.append(list(envs)) or read_roots(envs))

    def search(envs):
        monkeypatch.setattr("sb3_mcbs.search.strategies.draw_noise", lambda *args, **kwargs: noise.of(envs))
        return planner.plan(agent._last_obs, rng, envs)

    some = search([1, 3])
    assert read == [[1, 3]] and some.actions.shape[0] == 2
    singles = [search([env]) for env in (1, 3)]
    assert some.simulated_steps == sum(single.simulated_steps for single in singles)
    for row, single in enumerate(singles):
        np.testing.assert_allclose(some.values[row], single.values[0], rtol=1e-6)
        np.testing.assert_allclose(some.actions[row], single.actions[0], rtol=1e-5)
        assert some.chosen[row] == single.chosen[0]
    agent.env.close()


def test_searched_rows_are_executed_as_they_were_simulated(make_agent):
    """Also beside noise of another dtype: the forward model stays exact."""
    agent = make_agent(
        snapshot_vec_env("HalfCheetah-v5", 3),
        search_share=0.5,
        action_noise=NormalActionNoise(np.zeros(6), 0.1 * np.ones(6), dtype=np.float64),
    )
    errors = []
    agent._setup_learn(1)
    verify = agent.planner.verify
    agent.planner.verify = lambda *step: errors.append(verify(*step)) or errors[-1]
    agent.learn(150)
    assert len(errors) > 20 and set(errors) == {0.0}
    assert 30 < agent.n_decisions < 110


@pytest.mark.parametrize("cls", SEARCHING)
def test_noise_after_the_search_needs_noise(make_agent, cls):
    for share in (1, 0.5):
        with pytest.raises(ValueError, match="pass an action_noise"):
            make_agent(cls=cls, action_noise_after_search=True, search_share=share).learn(1)


def test_a_deterministic_actor_without_noise_explores_by_the_beams(make_agent, capsys):
    agent = make_agent(search_share=0.5, verbose=1)
    agent.learn(60)
    assert "Gaussian noise of beam_noise=0.1" in capsys.readouterr().out
    given = make_agent(search_share=0.5, action_noise=NormalActionNoise(np.zeros(1), np.full(1, 0.1)))
    assert_same_parameters(agent, given.learn(60))
    for other in (make_agent(verbose=1), make_agent(cls=MCBSSAC, search_share=0.5, verbose=1)):
        other.learn(30)
        assert "Gaussian noise" not in capsys.readouterr().out


def test_noise_for_what_is_not_searched_is_not_saved(make_agent, tmp_path):
    """An agent that was given none goes on with other environments, and with another beam_noise."""
    make_agent(snapshot_vec_env("Pendulum-v1", 2), search_share=0.0).learn(60).save(tmp_path / "agent")
    for n_envs in (1, 3):
        agent = MCBSTD3.load(tmp_path / "agent", snapshot_vec_env("Pendulum-v1", n_envs), beam_noise=0.4)
        drawn = agent.learn(60)._noise_without_search()
        assert agent.action_noise is None and drawn.size == n_envs
        assert 0.1 < np.std([agent._noise_without_search() for _ in range(200)]) < 0.6


def test_what_is_logged(make_agent):
    agent = make_agent(
        search_schedule="anneal",
        schedule_kwargs=dict(final_search_share=0.5, final_beam_width=1, final_rollout_depth=1),
    )
    agent.learn(100)
    logged = agent.logger.name_to_value
    assert 0.5 <= logged["search/frequency"] < 0.52
    assert (logged["search/beam_width"], logged["search/rollout_depth"]) == (1, 1)


@pytest.mark.parametrize("widths", [(6, 1), (2, 6)])
def test_a_rollout_beyond_the_end_of_the_training_stays_at_the_end_of_the_anneal(make_agent, widths):
    agent = make_agent(
        search_schedule="anneal",
        beam_width=widths[0],
        schedule_kwargs=dict(final_beam_width=widths[1], final_search_share=0.5),
        train_freq=(1, "episode"),
    )
    agent.learn(250)
    assert agent.num_timesteps == 400
    logged = agent.logger.name_to_value
    assert (logged["search/frequency"], logged["search/beam_width"]) == (0.5, widths[1])


def test_a_second_training_begins_at_the_beginning_of_the_anneal(make_agent):
    agent = make_agent(search_schedule="anneal", schedule_kwargs=dict(final_beam_width=1))
    agent.learn(60)
    agent.learning_starts = 0
    agent.learn(1)
    assert agent._schedule is not None and agent.logger.name_to_value["search/beam_width"] == 3


def test_generators_have_nothing_in_common(make_agent):
    """A schedule that draws what an environment draws would search where the environment is kind."""
    agent = make_agent(seed=7)
    rngs = [agent.search_rng, agent._schedule.rng, agent.rollout_rng, spawn_rng(7, "learned model")]
    drawn = [tuple(rng.random(3)) for rng in rngs]
    assert len(set(drawn)) == 4
    environment = tuple(np.random.default_rng(7).random(3))
    assert environment not in drawn[1:]
    agent.set_random_seed(7)
    rngs = [agent.search_rng, agent._schedule.rng, agent.rollout_rng]
    assert [tuple(rng.random(3)) for rng in rngs] == drawn[:3]


@pytest.mark.parametrize("cls", SEARCHING)
def test_generators_go_on_where_a_saved_agent_left_them(make_agent, tmp_path, cls):
    agent = make_agent(cls=cls, search_share=0.5)
    agent.learn(60)
    agent.save(tmp_path / "agent")

    def states(agent):
        rngs = agent.search_rng, agent._schedule.rng, agent.rollout_rng
        return [rng.bit_generator.state["state"]["state"] for rng in rngs]

    assert states(cls.load(tmp_path / "agent")) == states(agent)
    reseeded = cls.load(tmp_path / "agent", custom_objects={"seed": 3})
    assert states(reseeded) == states(make_agent(cls=cls, seed=3))


@pytest.mark.parametrize("cls, unit", [(MCBSTD3, "step"), *((cls, "episode") for cls in SEARCHING)])
def test_a_resumed_run_keeps_its_schedule(make_agent, tmp_path, cls, unit):
    def make_env(folder):
        return VecNormalize(snapshot_vec_env("Pendulum-v1", 2, env_kwargs=dict(max_episode_steps=50)))

    def make(folder):
        settings = ScheduleSettings("saturation", 0.8, unit, saturation_window=20)
        return make_agent(make_env(folder), cls=cls, **settings.grouped())

    whole, resumed = assert_resumed_is_exact(make, tmp_path, 330, 276, make_env=make_env, save_freq=120)
    assert whole.n_decisions == resumed.n_decisions > 120
    ours, theirs = whole._schedule, resumed._schedule
    assert ours.settings == theirs.settings
    assert ours.rng.bit_generator.state == theirs.rng.bit_generator.state
    assert len(ours.saturation._episodes) > 0
    np.testing.assert_equal(vars(ours.saturation), vars(theirs.saturation))
    for name in ("_flags", "_starts", "_returns"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


@pytest.mark.parametrize("cls", SEARCHING)
def test_a_saved_agent_keeps_its_schedule_and_takes_new_settings(make_agent, tmp_path, cls):
    agent = make_agent(cls=cls, **ScheduleSettings(**SATURATION).grouped())
    agent.learn(300)
    agent._schedule.saturation.is_reduced = True
    agent.save(tmp_path / "agent")
    loaded = cls.load(tmp_path / "agent", env=snapshot_vec_env("Pendulum-v1"))
    assert loaded._schedule.saturation.is_reduced and loaded._schedule.share(0.5) == 0.2
    changed = cls.load(
        tmp_path / "agent", custom_objects={"search_schedule": "constant", "search_share": 0.25}
    )
    assert changed._schedule.share(0.5) == 0.25
    with pytest.raises(ValueError, match="search_share"):
        cls.load(tmp_path / "agent", custom_objects={"search_share": -1})
