"""Held noise and low-dimensional proposals, against plain transcriptions and in real environments."""

import numpy as np
import pytest

from sb3_mcbs import MCBSTD3, BeamSettings, CEMSettings, SearchPolicy, TreeSettings
from sb3_mcbs.agents.planner import Planner
from sb3_mcbs.search import (
    RecentActions,
    Roots,
    WarmStart,
    beam_search,
    deadline_search,
    draw_noise,
    make_settings,
    search,
)
from sb3_mcbs.search.cem import cem_search, draw_plan_noise, first_spread
from sb3_mcbs.search.deadline import LatencyForecast
from sb3_mcbs.search.proposals import ENOUGH, RECENT, low_dimensional
from sb3_mcbs.search.tree import draw_tree_noise, tree_search
from tests import reference_strategies
from tests.checkpoint_helpers import assert_resumed_is_exact
from tests.conftest import SMALL, snapshot_vec_env
from tests.fake_model import LineWorld
from tests.reference_strategies import ReferenceBeam, ReferenceCEM, ReferenceTree
from tests.test_reference import reference_for, walk
from tests.test_search import AGENT
from tests.test_strategies import ROOTS, WORLDS, assert_agree, identify, line_reference

OBSERVATIONS = np.array(ROOTS)[:, None]
BEAMS = [
    dict(beam_width=4, rollout_depth=1, noise_hold=3, n_simulations=3),
    dict(beam_width=5, rollout_depth=2, noise_hold=2, n_simulations=1, include_policy_action=True),
    dict(beam_width=3, rollout_depth=3, noise_hold=2, n_simulations=3, antithetic=True),
    dict(beam_width=3, rollout_depth=2, noise_hold=3, n_simulations=2),
    dict(beam_width=4, rollout_depth=2, noise_hold=4, n_simulations=5, rollout_noise=0.0, noise_clip=0.4),
]
TREES = [
    dict(beam_width=3, branching=2, rollout_depth=3, noise_hold=2),
    dict(beam_width=2, branching=3, rollout_depth=2, noise_hold=4, include_policy_action=True),
    dict(beam_width=3, branching=2, rollout_depth=3, noise_hold=2, n_proposals=15),
]
PLANS = [
    dict(beam_width=4, n_rounds=3, rollout_depth=2, noise_hold=2, n_elites=2),
    dict(
        beam_width=5, n_rounds=2, rollout_depth=1, noise_hold=4, include_policy_action=True, antithetic=True
    ),
    dict(beam_width=4, n_rounds=2, rollout_depth=3, noise_hold=2, n_proposals=12, min_noise=0.3),
]
worlds = pytest.mark.parametrize("world", WORLDS.values(), ids=WORLDS)


def tree_of(reference, settings) -> ReferenceTree:
    sizes = settings.beam_width, settings.branching, settings.include_policy_action
    return ReferenceTree(reference, *sizes, settings.noise_hold)


def cem_of(reference, settings, directions=None) -> ReferenceCEM:
    spreads = first_spread(settings)[:, 0].tolist()
    sizes = settings.beam_width, settings.effective_n_elites, spreads, settings.min_noise
    return ReferenceCEM(reference, *sizes, settings.include_policy_action, settings.noise_hold, directions)


@worlds
@pytest.mark.parametrize("changes", BEAMS, ids=identify)
@pytest.mark.parametrize("deterministic", [True, False], ids=["deterministic", "random"])
def test_a_beam_that_holds_noise_equals_the_reference(changes, world, deterministic):
    settings, model = BeamSettings(**{"beam_noise": 0.5, **changes}), LineWorld(**world)
    model.deterministic = deterministic
    rng = np.random.default_rng(0)
    noise = draw_noise(rng, settings, len(ROOTS), 1)
    result = beam_search(Roots(model, ROOTS, OBSERVATIONS), AGENT, settings, noise, rng)
    distinct = settings.distinct_simulations(deterministic)
    steps = 0
    for env, root in enumerate(ROOTS):
        beam = ReferenceBeam(line_reference(model, root), *sizes_of(settings))
        rollout_noise = noise.rollout[:, env, :, :distinct]
        outcome = beam.choose(np.array([root]), noise.beam[env], rollout_noise, deterministic)
        assert_agree(result, env, outcome)
        steps += outcome.steps
    assert result.simulated_steps == model.steps_taken == steps


def sizes_of(settings) -> tuple[int, int, bool]:
    return settings.rollout_depth, settings.noise_hold, settings.include_policy_action


@worlds
@pytest.mark.parametrize("changes", TREES, ids=identify)
def test_a_tree_that_holds_noise_equals_the_reference(changes, world):
    settings = TreeSettings(**{"beam_noise": 0.5, **changes})
    model, rng = LineWorld(**world), np.random.default_rng(0)
    noise = draw_tree_noise(rng, settings, len(ROOTS), 1)
    result = tree_search(Roots(model, ROOTS, OBSERVATIONS), AGENT, settings, noise, rng)
    steps = 0
    for env, root in enumerate(ROOTS):
        tree = tree_of(line_reference(model, root), settings)
        outcome = tree.choose(np.array([root]), noise.roots[env, 0], noise.later[:, env])
        assert_agree(result, env, outcome)
        assert result.surviving_roots[env] == outcome.surviving_roots
        steps += outcome.steps
    assert result.simulated_steps == model.steps_taken == steps


@worlds
@pytest.mark.parametrize("changes", PLANS, ids=identify)
def test_the_cross_entropy_method_with_held_noise_equals_the_reference(changes, world):
    settings = CEMSettings(**{"beam_noise": 0.5, **changes})
    model, rng = LineWorld(**world), np.random.default_rng(0)
    noise = draw_plan_noise(rng, settings, len(ROOTS), 1)
    remembered = rng.normal(scale=0.3, size=(len(ROOTS), settings.rollout_depth, 1)).astype(np.float32)
    result = cem_search(Roots(model, ROOTS, OBSERVATIONS), AGENT, settings, noise, rng, remembered)
    plans = result.plans
    steps = 0
    for env, root in enumerate(ROOTS):
        reference = cem_of(line_reference(model, root), settings)
        outcome = reference.choose(np.array([root]), noise[:, env], remembered[env])
        assert_agree(result, env, outcome)
        expected = np.zeros_like(plans[env]) if outcome.plan is None else outcome.plan
        np.testing.assert_allclose(plans[env], expected, rtol=1e-4, atol=1e-6)
        steps += outcome.steps
    assert result.simulated_steps == model.steps_taken == steps


KINDS = ((BeamSettings, BEAMS), (TreeSettings, TREES), (CEMSettings, PLANS))
EVERY = [cls(**{"n_simulations": 2, "beam_noise": 0.4, **changes}) for cls, kind in KINDS for changes in kind]


@pytest.mark.parametrize("settings", EVERY, ids=str)
@pytest.mark.parametrize("spread", [0.0, 1e-9], ids=["deterministic", "random"])
def test_simulated_steps_are_known_beforehand(settings, spread):
    model = LineWorld(spread=spread)
    rng = np.random.default_rng(0)
    result = search(Roots(model, ROOTS, OBSERVATIONS), AGENT, settings, rng)
    expected = len(ROOTS) * settings.simulated_steps(deterministic=spread == 0)
    assert result.simulated_steps == model.steps_taken == expected


def test_what_is_left_of_a_plan_is_the_mean_of_what_it_held():
    """Macro-steps begin anew at every decision, so those of the last plan lie across them."""
    settings = CEMSettings(8, 2, beam_noise=0.3, noise_hold=2)
    memory, rng, x = WarmStart(1, 4, 1), np.random.default_rng(0), np.array([[1.0]])
    memory.keep(np.float32([[[0.1], [0.1], [0.4], [0.4]]]), [0], [(1, 0)])
    for moment, expected in (((1, 0), 0.1), ((1, 1), 0.25), ((1, 2), 0.4), ((1, 3), 0.2), ((2, 0), 0.0)):
        before = memory.state([moment])
        plans = memory.recall([0], [moment], settings.noise_hold)
        result = search(Roots(LineWorld(), [1.0], x), AGENT, settings, rng, plans=plans)
        memory.keep(result.plans, [0], [moment])
        mean = result.candidates[0, 0, 0] - AGENT.policy(x)[0, 0]
        assert mean == pytest.approx(expected, abs=1e-6)
        kept = memory.recall([0], [moment])[0, :, 0]
        assert kept[0] == kept[1] and kept[2] == kept[3]
        memory.set_state(before, [moment])


@pytest.mark.parametrize("dims", [1, 2, 5])
def test_directions_are_principal_components(dims):
    rng = np.random.default_rng(0)
    mixed = rng.normal(size=(5, 5))
    actions = np.tanh(rng.normal(size=(300, 5)) @ mixed * 0.2 + 0.3).astype(np.float32)
    memory = RecentActions(5)
    memory.note(actions[: ENOUGH - 1])
    assert memory.directions(dims) is None, "too few"
    for start in range(ENOUGH - 1, 300, 7):
        memory.note(actions[start : start + 7])
    found, expected = memory.directions(dims), reference_strategies.principal_directions(actions, dims)
    np.testing.assert_allclose(np.abs((found * expected).sum(axis=1)), 1, rtol=1e-5)  # but for signs

    noise = rng.normal(size=(20_000, 5)).astype(np.float32)
    narrow = low_dimensional(noise, found)
    expected = reference_strategies.low_dimensional(noise[:50], found)
    np.testing.assert_allclose(narrow[:50], expected, rtol=1e-4, atol=1e-5)
    assert np.linalg.matrix_rank(narrow[:50], tol=1e-3) == dims
    assert narrow.var(axis=0).mean() == pytest.approx(1.0, rel=0.05), "the total variance stays"


def test_old_actions_are_forgotten_and_few_directions_are_none():
    memory = RecentActions(2)
    memory.note(np.tile(np.float32([[1, 0], [-1, 0]]), (RECENT, 1)))
    np.testing.assert_allclose(np.abs(memory.directions(1)), [[1, 0]], atol=1e-6)
    assert memory.directions(2) is None and len(memory) == RECENT
    other = RecentActions(2)
    other.set_state(memory.state())
    for one in (memory, other):
        one.note(np.tile(np.float32([[0, 1], [0, -1]]), (RECENT // 2 - 5, 1)))
    both = memory.directions(2)
    np.testing.assert_array_equal(both, other.directions(2))
    memory.note(np.float32([[0, 1]] * 10))
    np.testing.assert_allclose(np.abs(memory.directions(1)), [[0, 1]], atol=1e-6)


HIERARCHICAL = [
    BeamSettings(5, 2, 2, noise_hold=2, proposal_dims=2, beam_noise=0.3, n_threads=1),
    TreeSettings(3, 2, branching=2, noise_hold=2, proposal_dims=2, n_threads=1),
    CEMSettings(6, 2, noise_hold=2, proposal_dims=2, n_elites=3, n_threads=1),
    CEMSettings(6, 3, proposal_dims=1, include_policy_action=True, n_threads=1),
]


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Hopper-v5"])
@pytest.mark.parametrize("settings", HIERARCHICAL, ids=lambda settings: settings.strategy)
def test_real_environments(env_id, settings):
    """Batches against ``env.step`` in a copy of the environment."""
    vec_env = snapshot_vec_env(env_id, 1)
    act_dim = vec_env.action_space.shape[0]
    agent = MCBSTD3("MlpPolicy", vec_env, seed=1, rollout_depth=0, **SMALL)
    rng = np.random.default_rng(0)
    recent = rng.normal(size=(ENOUGH, act_dim)).astype(np.float32)
    directions = reference_strategies.principal_directions(recent, settings.proposal_dims)
    directions = directions.astype(np.float32)
    planner = Planner(agent, vec_env, settings)
    observations = walk(vec_env, 5, rng)
    reference = reference_for(agent, vec_env.envs[0])
    roots = Roots(planner.model, planner.model.read_roots([0]), observations)
    given = roots, planner.functions(), settings
    if settings.strategy == "beam":
        noise = draw_noise(rng, settings, 1, act_dim, directions=directions)
        result = beam_search(*given, noise, rng)
        beam = ReferenceBeam(reference, *sizes_of(settings))
        outcome = beam.choose(observations[0], noise.beam[0], noise.rollout[:, 0], shared=True)
    elif settings.strategy == "tree":
        noise = draw_tree_noise(rng, settings, 1, act_dim, directions)
        result = tree_search(*given, noise, rng)
        outcome = tree_of(reference, settings).choose(observations[0], noise.roots[0, 0], noise.later[:, 0])
    else:
        noise = draw_plan_noise(rng, settings, 1, act_dim)
        remembered = rng.normal(scale=0.2, size=(1, settings.rollout_depth, act_dim)).astype(np.float32)
        result = cem_search(*given, noise, rng, remembered, directions)
        outcome = cem_of(reference, settings, directions).choose(observations[0], noise[:, 0], remembered[0])
        np.testing.assert_allclose(result.plans[0], outcome.plan, rtol=1e-4, atol=1e-6)
    assert_agree(result, 0, outcome)
    assert result.simulated_steps == outcome.steps
    planner.close()


def test_candidates_lie_in_the_learned_directions():
    vec_env = snapshot_vec_env("HalfCheetah-v5", 2)
    agent = MCBSTD3("MlpPolicy", vec_env, seed=1, rollout_depth=0, **SMALL)
    settings = dict(
        beam_width=8,
        rollout_depth=1,
        beam_noise=0.02,
        search_kwargs=dict(proposal_dims=2),
        model_kwargs=dict(n_threads=1),
    )
    policy = SearchPolicy(agent, vec_env, seed=0, **settings)
    observations, ranks = vec_env.reset(), []
    for _ in range(ENOUGH // 2 + 1):
        actions, _ = policy.predict(observations)
        candidates = policy.last_result.candidates[0]
        ranks.append(np.linalg.matrix_rank(candidates - candidates[0], tol=1e-5))
        observations, *_ = vec_env.step(actions)
    assert ranks == [6] * (ENOUGH // 2) + [2]
    vec_env.reset()
    assert policy.planner.recent_actions.directions(2) is not None, "an episode's end forgets nothing"
    policy.close()
    with pytest.raises(ValueError, match="proposal_dims must be at most 6"):
        SearchPolicy(agent, vec_env, search_kwargs=dict(proposal_dims=7))


def test_a_deadline_searches_in_the_directions_and_holds_noise():
    settings = BeamSettings(
        4, 2, 2, time_budget=10, noise_hold=3, include_policy_action=True, proposal_dims=1
    )
    model, pace, rng = LineWorld(), LatencyForecast(), np.random.default_rng(0)
    deadline = pace.clock() + 10
    result = deadline_search(
        Roots(model, ROOTS, OBSERVATIONS), AGENT, settings, deadline, pace, rng, np.float32([[0.0]])
    )
    assert result.simulated_steps == len(ROOTS) * settings.simulated_steps()
    np.testing.assert_array_equal(result.candidates[:, 1:], result.candidates[:, :1].repeat(3, axis=1))


REFUSED = [
    (dict(search_kwargs=dict(noise_hold=2), rollout_depth=0), "noise_hold needs a rollout_depth"),
    (dict(search_kwargs=dict(noise_hold=2), beam_noise=0.0, beam_width=1), "noise_hold holds noise"),
    (dict(search_kwargs=dict(noise_hold=2, noise_clip=0), beam_width=1), "noise_hold holds noise"),
    (
        dict(search_kwargs=dict(proposal_dims=2), beam_noise=0.0, beam_width=1),
        "proposal_dims needs a beam_noise",
    ),
    (
        dict(beam_width=1000, rollout_depth=100, search_kwargs=dict(noise_hold=100)),
        r"rollout_depth \* noise_hold is",
    ),
]


@pytest.mark.parametrize("changes, words", REFUSED, ids=[words for _, words in REFUSED])
def test_what_makes_no_sense_is_refused(changes, words):
    with pytest.raises(ValueError, match=words):
        make_settings(**changes)


TRAINED = dict(
    strategy="cem",
    beam_width=4,
    rollout_depth=2,
    n_simulations=1,
    search_kwargs=dict(n_rounds=1, noise_hold=2, proposal_dims=1),
    model_kwargs=dict(n_threads=1),
)


def test_an_agent_remembers_its_actions_when_it_is_loaded(make_agent, tmp_path):
    agent = make_agent("Pendulum-v1", **TRAINED).learn(130)
    assert len(agent.recent_actions) == 110, "the random actions before learning are left out"
    stored = agent.replay_buffer.actions[20:130, 0]
    np.testing.assert_array_equal(agent.recent_actions.state()["actions"][:110], stored)
    agent.save(tmp_path / "agent")
    loaded = MCBSTD3.load(tmp_path / "agent", env=snapshot_vec_env("Pendulum-v1"))
    state = agent.recent_actions.state()
    np.testing.assert_array_equal(loaded.recent_actions.state()["actions"], state["actions"])
    assert loaded.planner.recent_actions is loaded.recent_actions
    policy = SearchPolicy(loaded, snapshot_vec_env("Pendulum-v1"), seed=0)
    policy.predict(policy.vec_env.reset())
    assert len(policy.planner.recent_actions) == 111 and len(loaded.recent_actions) == 110
    loaded.learn(5, reset_num_timesteps=False)
    assert len(loaded.recent_actions) == 115


def test_a_run_that_is_resumed_remembers_its_actions(make_agent, tmp_path):
    def make(folder):
        env = snapshot_vec_env("Pendulum-v1", 2)
        return make_agent(env, **{**TRAINED, "buffer_size": 200})

    both = assert_resumed_is_exact(
        make, tmp_path, 150, 105, make_env=lambda folder: snapshot_vec_env("Pendulum-v1", 2)
    )
    states = [agent.planner.recent_actions.state() for agent in both]
    np.testing.assert_array_equal(states[0]["actions"], states[1]["actions"])
    assert states[0]["count"] == states[1]["count"] == 130
    assert all(agent.planner.recent_actions is agent.recent_actions for agent in both)
