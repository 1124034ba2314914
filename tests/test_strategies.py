"""Tree and cross-entropy method against their plain transcriptions, and what all strategies promise."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_mcbs import MCBSTD3, CEMSettings, SearchPolicy, SearchSettings, TreeSettings
from sb3_mcbs.agents.planner import Planner
from sb3_mcbs.agents.roots import EnvironmentStep, Prediction
from sb3_mcbs.search import Roots, check_dynamics, make_settings, search
from sb3_mcbs.search.cem import cem_search, draw_plan_noise, first_spread
from sb3_mcbs.search.tree import draw_tree_noise, tree_search
from tests.conftest import SMALL, snapshot_vec_env
from tests.fake_model import LineWorld
from tests.reference_search import Reference
from tests.reference_strategies import Outcome, ReferenceCEM, ReferenceTree
from tests.test_reference import reference_for, walk
from tests.test_search import AGENT, GAMMA, critics, policy

ROOTS = [0.3, -1.2, 1.0]


def line_reference(model: LineWorld, root: float) -> Reference:
    world = {}

    def restore():
        world["x"] = float(root)

    def env_step(action):
        world["x"] += float(action[0])
        observation, distance = np.array([world["x"]]), abs(world["x"])
        reward = -(world["x"] ** 2) if action[0] <= model.bad_action else np.nan
        terminated, stopped = distance > model.limit, distance > model.stop
        if stopped and not terminated:  # ends like a termination, but what would follow counts
            reward += GAMMA * min(critics(observation, policy(observation)))
        return observation, reward, terminated or stopped

    return Reference(env_step, restore, policy, critics, GAMMA)


def on_line(model, settings, seed=0, roots=ROOTS, rng=None):
    """Search from points of a line through the one interface."""
    observations = np.asarray(roots, dtype=float)[:, None]
    rng = rng or np.random.default_rng(seed)
    return search(Roots(model, roots, observations), AGENT, settings, rng)


def tree_of(reference: Reference, settings: SearchSettings) -> ReferenceTree:
    return ReferenceTree(
        reference,
        settings.beam_width,
        settings.branching,
        settings.include_policy_action,
    )


def cem_of(reference: Reference, settings: SearchSettings) -> ReferenceCEM:
    return ReferenceCEM(
        reference,
        settings.beam_width,
        settings.effective_n_elites,
        first_spread(settings)[:, 0].tolist(),
        settings.min_noise,
        settings.include_policy_action,
        clip_at=np.inf if settings.noise_clip is None else settings.noise_clip,
    )


def assert_agree(result, env: int, outcome: Outcome) -> None:
    np.testing.assert_allclose(result.candidates[env], outcome.candidates, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(result.values[env], outcome.values, rtol=1e-5, atol=1e-5)
    if outcome.action is None:
        assert result.chosen[env] == -1
    else:
        np.testing.assert_allclose(result.actions[env], outcome.action, rtol=1e-5, atol=1e-6)


WORLDS = {
    "endless": dict(),
    "terminates": dict(limit=1.4),
    "terminates-at-once": dict(limit=0.5),
    "terminates-everywhere": dict(limit=0.0),
    "diverges": dict(bad_action=0.2),
    "both": dict(limit=1.3, bad_action=0.4),
    "stops": dict(stop=1.1),
    "stops-at-once": dict(stop=0.5),
    "stops-everywhere": dict(stop=0.0),
    "all": dict(limit=1.5, bad_action=0.4, stop=1.1),
    "hopeless": dict(bad_action=-2.0),
}
TREES = [
    dict(beam_width=1, branching=1, rollout_depth=1),
    dict(beam_width=3, branching=2, rollout_depth=4),
    dict(beam_width=2, branching=4, rollout_depth=3, include_policy_action=True),
    dict(beam_width=4, branching=3, rollout_depth=3),
    dict(beam_width=3, branching=2, rollout_depth=3, rollout_noise=0.2, noise_clip=0.4, n_proposals=15),
    dict(beam_width=3, branching=3, rollout_depth=3, antithetic=True),
    dict(beam_width=2, branching=2, rollout_depth=3, include_policy_action=True, n_proposals=12),
]
PLANS = [
    dict(beam_width=2, n_rounds=1, rollout_depth=1),
    dict(beam_width=8, n_rounds=3, rollout_depth=3, n_elites=3),
    dict(beam_width=6, n_rounds=3, rollout_depth=4, include_policy_action=True, rollout_noise=0.1),
    dict(beam_width=6, n_rounds=4, rollout_depth=3, n_elites=2, noise_clip=0.3),
    dict(beam_width=5, n_rounds=2, rollout_depth=3, antithetic=True, n_proposals=12, n_elites=5),
    dict(beam_width=4, n_rounds=3, rollout_depth=2, rollout_noise=0.1, min_noise=1.0),
    dict(beam_width=3, n_rounds=1, rollout_depth=2, n_proposals=60, include_policy_action=True),
    dict(beam_width=4, n_rounds=4, rollout_depth=2, min_noise=0.3, include_policy_action=True, n_proposals=4),
]


def identify(changes):
    return "-".join(f"{name}={value}" for name, value in changes.items())


@pytest.mark.parametrize("world", WORLDS.values(), ids=WORLDS)
@pytest.mark.parametrize("changes", TREES, ids=identify)
def test_tree_equals_the_reference(changes, world):
    settings = TreeSettings(**{"beam_noise": 0.5, **changes})
    model = LineWorld(**world)
    noise = draw_tree_noise(np.random.default_rng(0), settings, len(ROOTS), 1)
    result = on_line(model, settings)
    outcomes = [
        tree_of(line_reference(model, root), settings).choose(
            np.array([root]), noise.roots[env, 0], noise.later[:, env]
        )
        for env, root in enumerate(ROOTS)
    ]
    for env, outcome in enumerate(outcomes):
        assert_agree(result, env, outcome)
    assert result.surviving_roots.tolist() == [outcome.surviving_roots for outcome in outcomes]
    assert result.simulated_steps == model.steps_taken == sum(outcome.steps for outcome in outcomes)


@pytest.mark.parametrize("world", WORLDS.values(), ids=WORLDS)
@pytest.mark.parametrize("changes", PLANS, ids=identify)
@pytest.mark.parametrize("warm", [False, True], ids=["cold", "warm"])
def test_the_cross_entropy_method_equals_the_reference(changes, world, warm):
    settings = CEMSettings(**{"beam_noise": 0.5, **changes})
    model = LineWorld(**world)
    rng = np.random.default_rng(0)
    noise = draw_plan_noise(rng, settings, len(ROOTS), 1)
    remembered = np.zeros((len(ROOTS), settings.rollout_depth, 1), dtype=np.float32)
    if warm:
        remembered[1:] = rng.normal(scale=0.3, size=remembered[1:].shape)
    observations = np.array(ROOTS)[:, None]
    result = cem_search(Roots(model, ROOTS, observations), AGENT, settings, noise, rng, remembered)
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
    assert result.rounds == settings.n_rounds


REAL = [
    ("Pendulum-v1", {}, "pool", 5),
    ("InvertedPendulum-v5", {}, "mujoco", 4),
    ("HalfCheetah-v5", {}, "mujoco", 5),
    ("Hopper-v5", dict(healthy_angle_range=(-0.02, 0.02)), "mujoco", 3),
]


@pytest.mark.parametrize("env_id, kwargs, kind, steps", REAL, ids=[case[0] for case in REAL])
def test_real_environments(env_id, kwargs, kind, steps):
    """The strategies in batches and pools against ``env.step`` in a copy of the environment."""
    vec_env = DummyVecEnv([lambda: gym.make(env_id, **kwargs)])
    vec_env.seed(3)
    act_dim = vec_env.action_space.shape[0]
    options = dict(beam_noise=0.4, n_threads=1, forward_model=kind)
    tree = TreeSettings(3, 3, 1, branching=2, **options)
    cem = CEMSettings(4, 3, 1, n_rounds=2, n_elites=2, **options)
    agent = MCBSTD3("MlpPolicy", vec_env, seed=1, rollout_depth=0, **SMALL)
    planner = Planner(agent, vec_env, tree)
    rng = np.random.default_rng(0)
    fewer_steps = False
    for trial in range(3):
        observations = walk(vec_env, steps + trial, rng)
        reference = reference_for(agent, vec_env.envs[0])
        given = Roots(planner.model, planner.model.read_roots([0]), observations), planner.functions()

        noise = draw_tree_noise(rng, tree, 1, act_dim)
        result = tree_search(*given, tree, noise, rng)
        outcome = tree_of(reference, tree).choose(observations[0], noise.roots[0, 0], noise.later[:, 0])
        assert_agree(result, 0, outcome)
        assert result.simulated_steps == outcome.steps
        fewer_steps |= outcome.steps < tree.simulated_steps()

        noise = draw_plan_noise(rng, cem, 1, act_dim)
        remembered = rng.normal(scale=0.2, size=(1, 3, act_dim)).astype(np.float32)
        result = cem_search(*given, cem, noise, rng, remembered)
        outcome = cem_of(reference, cem).choose(observations[0], noise[:, 0], remembered[0])
        assert_agree(result, 0, outcome)
        np.testing.assert_allclose(result.plans[0], outcome.plan, rtol=1e-4, atol=1e-6)
        assert result.simulated_steps == outcome.steps
    assert fewer_steps == (env_id in ("InvertedPendulum-v5", "Hopper-v5"))


EVERY = [
    dict(strategy="beam", rollout_depth=3),
    dict(strategy="beam", search_kwargs=dict(n_proposals=20, antithetic=True)),
    dict(strategy="tree", search_kwargs=dict(branching=3)),
    dict(strategy="tree", search_kwargs=dict(branching=2, n_proposals=24)),
    dict(strategy="cem"),
    dict(strategy="cem", search_kwargs=dict(n_proposals=15, antithetic=True, include_policy_action=True)),
]


def settings_of(changes) -> SearchSettings:
    return make_settings(**{"beam_width": 6, "n_simulations": 2, "beam_noise": 0.4, **changes})


@pytest.mark.parametrize("changes", EVERY, ids=identify)
def test_the_executed_action_was_evaluated(changes):
    settings = settings_of(changes)
    result = on_line(LineWorld(limit=1.4), settings)
    for env, root in enumerate(ROOTS):
        np.testing.assert_array_equal(result.actions[env], result.candidates[env, result.chosen[env]])
        assert result.first_step.observations[env, 0] == np.float64(root) + result.actions[env, 0]
        assert result.first_step.rewards[env] == -(result.first_step.observations[env, 0] ** 2)
    assert np.abs(result.candidates).max() <= 1
    assert result.critic_evaluations > 0


@pytest.mark.parametrize("changes", EVERY, ids=identify)
@pytest.mark.parametrize("spread", [0.0, 1e-9], ids=["deterministic", "random"])
def test_simulated_steps_are_known_beforehand(changes, spread):
    settings, model = settings_of(changes), LineWorld(spread=spread)
    result = on_line(model, settings)
    expected = len(ROOTS) * settings.simulated_steps(deterministic=spread == 0)
    assert result.simulated_steps == model.steps_taken == expected


@pytest.mark.parametrize("changes", EVERY, ids=identify)
def test_several_environments_equal_single_searches(changes):
    """All but the noise is the same, so it is made the same for all environments."""
    settings = settings_of(changes)

    class SameForAll(np.random.Generator):
        """What it draws is the same in every environment, however many there are."""

        def standard_normal(self, shape, dtype):
            axis = 0 if len(shape) < 5 else 1  # arrays of a whole rollout, tree or of plans have 5 axes
            alone = (*shape[:axis], 1, *shape[axis + 1 :])
            return np.repeat(super().standard_normal(alone, dtype=dtype), shape[axis], axis=axis)

    def decide(roots):
        rng = SameForAll(np.random.PCG64(5))
        return on_line(LineWorld(1.3, 0.5), settings, roots=roots, rng=rng)

    together = decide(ROOTS)
    for env, root in enumerate(ROOTS):
        alone = decide([root])
        np.testing.assert_array_equal(together.values[env], alone.values[0])
        np.testing.assert_array_equal(together.actions[env], alone.actions[0])


@pytest.mark.parametrize("changes", [c for c in EVERY if c["strategy"] != "beam"], ids=identify)
def test_simulations_of_a_random_world_without_spread_are_all_the_same(changes):
    """With several rows per node or plan, in other words, every row is where it belongs."""
    settings = settings_of({**changes, "n_simulations": 3})
    model = LineWorld(1.3, 0.5)
    expected = on_line(model, settings)
    model.deterministic = False
    result = on_line(model, settings)
    np.testing.assert_allclose(result.values, expected.values, rtol=1e-12)
    np.testing.assert_array_equal(result.actions, expected.actions)
    assert result.simulated_steps == 3 * expected.simulated_steps
    assert result.invalid_rollouts == 3 * expected.invalid_rollouts


def test_a_tree_in_a_random_world_follows_the_mean():
    """One root action, whose nodes' values are means over many draws: nearly that of a world without."""
    settings = TreeSettings(2, 3, 20_000, beam_noise=0.3, branching=2)
    value = on_line(LineWorld(spread=0.05), settings, roots=[0.5]).values.max()
    certain = on_line(LineWorld(), settings, roots=[0.5]).values.max()
    # Later rewards are -x^2, whose mean is lower by the variance of x.
    variance = 0.05**2
    expected = certain - variance * (1 + 2 * GAMMA + 3 * GAMMA**2)
    assert value == pytest.approx(expected, abs=0.03)
    single = TreeSettings(2, 3, 1)
    with pytest.raises(ValueError, match="n_simulations of 2 or more"):
        check_dynamics(single, deterministic=False)
    check_dynamics(single, deterministic=True)


def test_a_tree_of_proposals_stops_where_every_node_has_terminated(make_agent):
    env = snapshot_vec_env("InvertedPendulum-v5")
    agent = make_agent(
        env, strategy="tree", beam_width=2, search_kwargs=dict(branching=2, n_proposals=8), rollout_depth=6
    )
    policy = SearchPolicy(agent, env, beam_noise=0.5, seed=0)
    env.reset()
    env.env_method("set_state", np.array([0.0, 0.199]), np.array([0.0, 2.0]))
    env.envs[0].last_observation = observation = env.env_method("_get_obs")[0]
    policy.predict(observation[None])
    assert policy.last_result.chosen[0] >= 0 and policy.last_result.simulated_steps == 4


def test_the_cross_entropy_method_improves_and_keeps_its_spread():
    one = CEMSettings(30, 3, n_rounds=1, beam_noise=0.3)
    many = CEMSettings(10, 3, n_rounds=3, beam_noise=0.3)
    gains = [
        on_line(LineWorld(), many, seed).values.max(axis=1)
        - on_line(LineWorld(), one, seed).values.max(axis=1)
        for seed in range(20)
    ]
    assert np.mean(gains) > 0
    collapsed = CEMSettings(4, 2, n_rounds=2, n_elites=1, min_noise=1e-30)
    rounds = on_line(LineWorld(), collapsed).candidates.reshape(len(ROOTS), 2, 4)
    assert (rounds[:, 1] == rounds[:, 1, :1]).all()
    floor = CEMSettings(4, 2, n_rounds=2, n_elites=1, min_noise=0.05)
    rounds = on_line(LineWorld(), floor).candidates.reshape(len(ROOTS), 2, 4)
    assert (rounds[:, 1].std(axis=1) > 0.01).all()


class Gusts(gym.ActionWrapper):
    """A random force on top of every action."""

    def action(self, action):
        return (action + self.np_random.normal(scale=0.1, size=action.shape)).astype(np.float32)


@pytest.mark.parametrize("strategy", ["tree", "cem"])
def test_a_real_environment_with_random_dynamics(make_agent, strategy):
    agent = make_agent(rollout_depth=0, n_simulations=1)
    env = DummyVecEnv([lambda: Gusts(gym.make("Pendulum-v1"))])
    own = dict(branching=2) if strategy == "tree" else dict(n_rounds=2)
    settings = dict(strategy=strategy, beam_width=3, rollout_depth=2, search_kwargs=own, seed=0)
    with pytest.raises(ValueError, match="n_simulations of 2 or more"):
        SearchPolicy(agent, env, n_simulations=1, **settings)
    policy = SearchPolicy(agent, env, n_simulations=3, **settings)
    policy.predict(env.reset())
    assert policy.last_result.simulated_steps == policy.settings.simulated_steps(deterministic=False)
    assert np.isfinite(policy.last_result.values).all()
    policy.close()


def test_dynamics_that_turn_out_to_be_random_end_a_search_of_single_simulations(make_agent):
    agent = make_agent(rollout_depth=0, n_simulations=1)
    env = snapshot_vec_env("Pendulum-v1")
    policy = SearchPolicy(agent, env, strategy="tree", rollout_depth=2, n_simulations=1)
    actions, _ = policy.predict(env.reset())
    observations, rewards, _, infos = env.step(actions)
    happened = EnvironmentStep(observations + 1, rewards, infos)
    error = policy.planner.verify(Prediction([0], actions, policy.last_result.first_step), happened)
    assert error == pytest.approx(1)
    with pytest.warns(UserWarning, match="random"), pytest.raises(ValueError, match="luckiest"):
        policy.planner.resync(error)
    policy.close()
