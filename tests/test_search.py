"""The batched search alone, against the plain transcription of Algorithm 1."""

import numpy as np
import pytest

from sb3_mcbs.search import (
    BeamSettings,
    Noise,
    PolicyFunctions,
    Roots,
    beam_search,
    draw_noise,
    make_settings,
)
from tests.fake_model import LineWorld
from tests.reference_search import Reference

GAMMA = 0.9


def policy(observations):
    return np.tanh(-0.4 * observations).astype(np.float32)


def critics(observation, action):
    return [-(float(observation[0]) ** 2) - float(action[0]), -abs(float(observation[0])) + 0.1]


def value(observations, actions):
    return np.minimum(-(observations[:, 0] ** 2) - actions[:, 0], -np.abs(observations[:, 0]) + 0.1)


AGENT = PolicyFunctions(
    policy,
    value,
    GAMMA,
    unscale_action=lambda action: action,
    scale_reward=lambda reward: reward,
    act_dim=1,
)


def search(model, roots, settings, noise, agent=AGENT):
    observations = np.asarray(roots, dtype=float)[:, None]
    return beam_search(Roots(model, roots, observations), agent, settings, noise, np.random.default_rng(3))


def reference_values(model, root, noise, env):
    world = {}

    def restore():
        world["x"] = float(root)

    def env_step(action):
        world["x"] += float(action[0])
        observation, reward, distance = np.array([world["x"]]), -(world["x"] ** 2), abs(world["x"])
        if model.stop < distance <= model.limit:  # ends like a termination, but what would follow counts
            reward += GAMMA * min(critics(observation, policy(observation)))
        return observation, reward, distance > min(model.limit, model.stop)

    reference = Reference(env_step, restore, lambda obs: policy(obs), critics, GAMMA)
    return reference.choose(np.array([float(root)]), noise.beam[env], noise.rollout[:, env])


LIMITS = {
    "endless": {},
    "terminates": dict(limit=1.4),
    "terminates-at-once": dict(limit=0.5),
    "stops": dict(stop=1.2),
    "stops-at-once": dict(stop=0.5),
    "stops-or-terminates": dict(limit=1.6, stop=1.2),
}


@pytest.mark.parametrize("world", LIMITS.values(), ids=LIMITS)
@pytest.mark.parametrize("width, depth, sims", [(1, 1, 1), (6, 3, 5), (4, 1, 3), (3, 7, 2)])
def test_equals_the_reference(width, depth, sims, world):
    model = LineWorld(**world)
    settings = BeamSettings(width, depth, sims, beam_noise=0.5)
    roots = [0.3, -1.2, 1.0]
    noise = draw_noise(np.random.default_rng(0), settings, len(roots), 1)
    result = search(model, roots, settings, noise)
    for env, root in enumerate(roots):
        chosen, values, _ = reference_values(model, root, noise, env)
        np.testing.assert_allclose(result.values[env], values, rtol=1e-6, atol=1e-7)
        assert result.chosen[env] == chosen
        np.testing.assert_array_equal(result.actions[env], result.candidates[env, chosen])


def test_several_environments_equal_single_searches():
    settings = BeamSettings(5, 4, 3, beam_noise=0.4)
    roots = [0.3, -1.2, 1.0, 0.0]
    noise = draw_noise(np.random.default_rng(1), settings, len(roots), 1)
    together = search(LineWorld(1.3), roots, settings, noise)
    for env, root in enumerate(roots):
        alone = search(LineWorld(1.3), [root], settings, Noise(noise.beam[[env]], noise.rollout[:, [env]]))
        np.testing.assert_array_equal(together.values[env], alone.values[0])
        np.testing.assert_array_equal(together.actions[env], alone.actions[0])


def test_first_step_is_simulated_once_only_if_deterministic():
    settings = BeamSettings(6, 3, 5)
    noise = draw_noise(np.random.default_rng(0), settings, 1, 1)
    deterministic, random = LineWorld(), LineWorld(spread=0.1)
    assert search(deterministic, [0.0], settings, noise).simulated_steps == 66 == deterministic.steps_taken
    assert search(random, [0.0], settings, noise).simulated_steps == 90 == random.steps_taken


def test_equal_simulations_run_once():
    settings = BeamSettings(6, 3, 5, rollout_noise=0.0)
    noise = draw_noise(np.random.default_rng(0), settings, 1, 1)
    result = search(LineWorld(), [0.5], settings, noise)
    assert result.simulated_steps == 18
    np.testing.assert_allclose(result.values[0], reference_values(LineWorld(), 0.5, noise, 0)[1])


def test_diverged_candidates_are_never_chosen():
    settings = BeamSettings(8, 2, 3, beam_noise=0.5)
    noise = draw_noise(np.random.default_rng(0), settings, 1, 1)
    free = search(LineWorld(), [-2.0], settings, noise)
    limit = float(free.actions[0, 0]) - 1e-3  # forbids what would be best
    result = search(LineWorld(bad_action=limit), [-2.0], settings, noise)
    assert result.candidates[0, result.chosen[0], 0] <= limit
    assert np.isneginf(result.values[0, free.chosen[0]])
    assert result.invalid_rollouts >= settings.n_simulations


def test_policy_acts_if_all_candidates_diverge():
    settings = BeamSettings(4, 2, 2)
    noise = draw_noise(np.random.default_rng(0), settings, 2, 1)
    result = search(LineWorld(bad_action=-2.0), [0.5, -0.5], settings, noise)
    assert (result.chosen == -1).all()
    assert result.invalid_rollouts == 2 * 4 * 2
    np.testing.assert_array_equal(result.actions, policy(np.array([[0.5], [-0.5]])))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_critic_that_is_not_finite_is_never_followed(bad):
    agent = AGENT._replace(value=lambda obs, actions: np.where(actions[:, 0] > 0, bad, value(obs, actions)))
    settings = BeamSettings(32, 0, 1, beam_noise=0.5)
    noise = draw_noise(np.random.default_rng(0), settings, 1, 1)
    result = beam_search(Roots(None, [], np.array([[0.0]])), agent, settings, noise, np.random.default_rng(0))
    assert result.actions[0, 0] <= 0 < result.candidates.max()
    assert np.isfinite(result.values[0, result.chosen[0]])


def test_depth_zero_ranks_by_the_critics():
    settings = BeamSettings(16, 0, 5, beam_noise=0.5)
    noise = draw_noise(np.random.default_rng(0), settings, 2, 1)
    observations = np.array([[0.7], [-0.2]])
    result = beam_search(Roots(None, [], observations), AGENT, settings, noise, np.random.default_rng(0))
    for env in range(2):
        expected = [min(critics(observations[env], action)) for action in result.candidates[env]]
        np.testing.assert_allclose(result.values[env], expected, rtol=1e-6)
    assert result.simulated_steps == 0 and result.first_step is None


def test_first_step_is_that_of_the_chosen_candidate():
    settings = BeamSettings(6, 3, 5, beam_noise=0.3)
    noise = draw_noise(np.random.default_rng(0), settings, 2, 1)
    roots = [0.4, -0.9]
    result = search(LineWorld(), roots, settings, noise)
    expected = np.asarray(roots) + result.actions[:, 0]
    np.testing.assert_array_equal(result.first_step.observations[:, 0], expected)
    np.testing.assert_array_equal(result.first_step.rewards, -(expected**2))


def test_policy_action_can_be_a_candidate():
    noise = draw_noise(np.random.default_rng(0), BeamSettings(), 1, 1)
    without = search(LineWorld(), [0.5], BeamSettings(), noise)
    included = search(LineWorld(), [0.5], BeamSettings(include_policy_action=True), noise)
    np.testing.assert_array_equal(included.candidates[0, 0], policy(np.array([0.5])))
    assert included.candidates[0, 0] != without.candidates[0, 0]
    np.testing.assert_array_equal(included.candidates[0, 1:], without.candidates[0, 1:])


def test_candidates_stay_in_the_action_space_and_noise_is_clipped():
    settings = BeamSettings(200, 2, 2, beam_noise=3.0, noise_clip=0.25)
    noise = draw_noise(np.random.default_rng(0), settings, 1, 1)
    assert np.abs(noise.beam).max() == np.abs(noise.rollout).max() == 0.25
    result = search(LineWorld(), [10.0], settings, noise)
    assert np.abs(result.candidates).max() <= 1.0


def test_noise_scales_and_seeds():
    settings = BeamSettings(50, 4, 10, beam_noise=0.3, rollout_noise=0.05)
    noise = draw_noise(np.random.default_rng(7), settings, 3, 2)
    assert noise.beam.shape == (3, 50, 2) and noise.rollout.shape == (4, 3, 50, 10, 2)
    assert noise.beam.std() == pytest.approx(0.3, rel=0.15)
    assert noise.rollout.std() == pytest.approx(0.05, rel=0.05)
    again = draw_noise(np.random.default_rng(7), settings, 3, 2)
    np.testing.assert_array_equal(noise.rollout, again.rollout)


@pytest.mark.parametrize(
    "settings, error, words",
    [
        ({"beam_width": 0}, ValueError, "beam_width"),
        ({"beam_width": 2.5}, TypeError, "beam_width"),
        ({"beam_width": True}, TypeError, "beam_width"),
        ({"rollout_depth": -1}, ValueError, "rollout_depth"),
        ({"n_simulations": 0}, ValueError, "n_simulations"),
        ({"beam_width": 1000, "n_simulations": 1000}, ValueError, "rollouts"),
        ({"beam_noise": -0.1}, ValueError, "beam_noise"),
        ({"beam_noise": float("nan")}, ValueError, "beam_noise"),
        ({"beam_noise": "0.1"}, TypeError, "beam_noise"),
        ({"search_kwargs": {"rollout_noise": float("inf")}}, ValueError, "rollout_noise"),
        ({"search_kwargs": {"noise_clip": -1.0}}, ValueError, "noise_clip"),
        ({"search_kwargs": {"include_policy_action": 1}}, TypeError, "include_policy_action"),
        ({"model_kwargs": {"n_threads": -2}}, ValueError, "n_threads"),
        ({"forward_model": "magic"}, ValueError, "forward_model"),
    ],
)
def test_bad_settings_are_named(settings, error, words):
    with pytest.raises(error, match=words):
        make_settings(**settings)


def test_numpy_numbers_are_settings_too():
    assert BeamSettings(beam_width=np.int64(4), beam_noise=np.float32(0.5)).beam_width == 4
