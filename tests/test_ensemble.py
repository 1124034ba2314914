"""The learned ensemble by itself: fitting, predicting, and simulating with it."""

import pickle

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_mcbs.models import Ensemble, EnsembleModel, ForwardModelError, Transitions, make_forward_model
from tests.linear_env import MATRIX, PUSH, linear_step

pytestmark = pytest.mark.usefixtures("small_ensembles")

CPU = th.device("cpu")
OBSERVATIONS = spaces.Box(-np.inf, np.inf, (2,), np.float32)
#: Not [-1, 1], so that scaling shows.
ACTIONS = spaces.Box(-2.0, 6.0, (1,), np.float32)


def random_transitions(n: int, action_limit: float = 1.0, limit: float = np.inf) -> Transitions:
    rng = np.random.default_rng(0)
    observations = rng.uniform(-1, 1, (n, 2))
    actions = rng.uniform(-action_limit, action_limit, (n, 1))
    following, rewards = linear_step(observations, actions)
    terminated = (np.abs(following[:, 0]) > limit).astype(np.float32)
    return Transitions(observations, actions, following, rewards, terminated)


def fitted(transitions: Transitions, steps: int = 400, seed: int = 0) -> Ensemble:
    rng = np.random.default_rng(seed)
    ensemble = Ensemble(3, 2, 1, rng, CPU)
    ensemble.fit(transitions, np.arange(len(transitions.rewards)) % 10 == 9, steps, rng)
    return ensemble


@pytest.fixture(scope="module")
def linear(small_ensembles) -> Ensemble:
    return fitted(random_transitions(2000))


def test_a_linear_system_is_learned(linear):
    fresh = random_transitions(500)
    assert linear.held_out_error < 0.07
    assert linear.error(fresh) == pytest.approx(linear.held_out_error, abs=0.02)
    predicted = linear.predict(fresh.observations, fresh.actions)
    np.testing.assert_allclose(predicted.next_observations, fresh.next_observations, atol=0.05)
    assert not linear.predicts_termination and not predicted.terminated.any()
    assert linear.termination_error == 0


def test_the_error_is_1_for_who_predicts_the_mean():
    transitions = random_transitions(2000)
    ensemble = fitted(transitions, steps=1)
    flat = ensemble.parameters
    with th.no_grad():
        flat.zero_()
    assert ensemble.error(transitions) == pytest.approx(1, abs=0.02)
    assert Ensemble(2, 2, 1, np.random.default_rng(0), CPU).held_out_error == np.inf


def test_constants_are_predicted_and_do_not_count_as_errors():
    transitions = random_transitions(1000)
    constant = np.full((1000, 1), 1e4)
    with_constant = transitions._replace(
        observations=np.hstack([transitions.observations, constant]),
        next_observations=np.hstack([transitions.next_observations, constant]),
    )
    rng = np.random.default_rng(0)
    ensemble = Ensemble(2, 3, 1, rng, CPU)
    ensemble.fit(with_constant, np.arange(1000) % 10 == 9, 300, rng)
    assert ensemble.held_out_error < 0.2
    predicted = ensemble.predict(with_constant.observations, with_constant.actions)
    np.testing.assert_allclose(predicted.next_observations[:, 2], 1e4, atol=0.1)


def test_terminations_are_learned_if_there_are_any():
    transitions = random_transitions(2000, limit=0.5)
    ensemble = fitted(transitions)
    assert ensemble.predicts_termination and ensemble.termination_error < 0.06
    predicted = ensemble.predict(transitions.observations, transitions.actions).terminated
    assert (predicted == (transitions.terminated > 0)).mean() > 0.94


def test_a_fit_never_makes_the_held_out_error_worse_and_is_reproducible(linear):
    transitions = random_transitions(2000)
    held_out = np.arange(2000) % 10 == 9
    again = fitted(transitions)
    np.testing.assert_array_equal(*(e.parameters.detach() for e in (linear, again)))
    for step in range(3):
        before = again.held_out_error
        again.fit(transitions, held_out, 7, np.random.default_rng(step))
        assert again.held_out_error <= before


def test_held_out_transitions_are_never_fitted():
    transitions = random_transitions(1000)
    held_out = np.arange(1000) % 10 == 9
    spoilt = transitions._replace(rewards=np.where(held_out, np.nan, transitions.rewards))
    rng = np.random.default_rng(0)
    ensemble = Ensemble(2, 2, 1, rng, CPU)
    # NaN would spread to whatever is fitted to it, and to the statistics.
    ensemble.fit(spoilt, held_out, 20, rng)
    assert np.isfinite(ensemble.predict(transitions.observations, transitions.actions).rewards).all()


def test_the_caller_finds_the_global_generators_as_they_were():
    np.random.seed(1)
    th.manual_seed(1)
    before = np.random.get_state()[1].copy(), th.get_rng_state()
    fitted(random_transitions(600), steps=5)
    np.testing.assert_array_equal(before[0], np.random.get_state()[1])
    assert th.equal(before[1], th.get_rng_state())


def test_pickled_and_moved(linear):
    copy = pickle.loads(pickle.dumps(linear))
    copy.to(CPU)
    observations, actions = np.ones((4, 2)), np.zeros((4, 1))
    for ours, theirs in zip(
        linear.predict(observations, actions), copy.predict(observations, actions), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
    assert copy.shape == linear.shape == (3, 2, 1)
    copy.fit(random_transitions(600), np.arange(600) % 10 == 9, 5, np.random.default_rng(0))


def unscaled(actions: np.ndarray) -> np.ndarray:
    return (2.0 + 4.0 * actions).astype(np.float32)


def test_rollouts_follow_the_system(linear):
    model = EnsembleModel(linear, OBSERVATIONS, ACTIONS, pessimism=0.0)
    roots = [np.array([0.3, -0.2], np.float32), np.array([-0.5, 0.1], np.float32)]
    model.set_roots(roots, np.array([0, 1, 1]), np.random.default_rng())
    expected = np.array(roots)[[0, 1, 1]].astype(np.float64)
    for step in range(3):
        actions = np.array([[0.4], [-0.3], [0.1]]) * (step + 1) / 3
        expected, rewards = linear_step(expected, actions)
        result = model.step(unscaled(actions))
        np.testing.assert_allclose(result.observations, expected, atol=0.1)
        np.testing.assert_allclose(result.rewards, rewards, atol=0.1)
        assert result.observations.dtype == np.float32 and result.valid.all() and not result.terminated.any()
    model.select(np.array([1, 1, 2, 2]))
    assert model.n_rows == 4
    with pytest.raises(ValueError, match="one action for each of 4 rows"):
        model.step(np.zeros((3, 1), np.float32))


def test_pessimism_lowers_rewards_where_the_members_disagree():
    narrow = fitted(random_transitions(2000, action_limit=0.2))
    actions = np.linspace(-1, 1, 21)[:, None]
    near = np.abs(actions[:, 0]) <= 0.2
    root = [np.zeros(2)]

    def rewards(pessimism: float) -> np.ndarray:
        model = EnsembleModel(narrow, OBSERVATIONS, ACTIONS, pessimism)
        model.set_roots(root, np.zeros(21, int), np.random.default_rng())
        return model.step(unscaled(actions)).rewards

    disagreement = narrow.predict(np.zeros((21, 2)), actions).disagreement
    assert disagreement[[0, -1]].min() > 3 * disagreement[near].max()
    lowered = rewards(0.0) - rewards(2.0)
    np.testing.assert_allclose(lowered, 2.0 * narrow.reward_scale * disagreement, rtol=1e-3)


def test_rows_that_are_not_finite_are_invalid(linear):
    model = EnsembleModel(linear, OBSERVATIONS, ACTIONS)
    model.set_roots([np.zeros(2), np.array([np.nan, 0.0])], np.array([0, 1]), np.random.default_rng())
    assert model.step(np.zeros((2, 1), np.float32)).valid.tolist() == [True, False]


@pytest.mark.parametrize(
    "space", [spaces.Dict({"a": OBSERVATIONS}), spaces.Box(0, 255, (36, 36, 3), np.uint8), spaces.Discrete(3)]
)
def test_other_observations_are_refused(linear, space):
    with pytest.raises(ForwardModelError, match="floating-point numbers"):
        EnsembleModel(linear, space, ACTIONS)


def test_it_reads_no_environment(linear):
    with pytest.raises(ForwardModelError, match="roots are"):
        EnsembleModel(linear, OBSERVATIONS, ACTIONS).read_roots([0])
    with pytest.raises(ValueError, match="learned by an agent"):
        make_forward_model(None, "ensemble")


def test_the_linear_system_is_stable():
    assert np.abs(np.linalg.eigvals(MATRIX)).max() < 1 and PUSH.any()


@pytest.mark.parametrize("seed", range(4))
def test_terminations_that_come_late_are_not_predicted_at_random(seed):
    """Weights from before there were any know nothing of them, however good they are otherwise."""
    rng = np.random.default_rng(seed)

    def noisy(n, limit):
        observations, actions = rng.standard_normal((n, 2)), rng.uniform(-1, 1, (n, 1))
        following = 0.5 * observations + 0.3 * actions + 0.2 * rng.standard_normal((n, 2))
        rewards = observations[:, 0] + 0.3 * rng.standard_normal(n)
        return Transitions(observations, actions, following, rewards, np.float32(following[:, 0] > limit))

    def fit(transitions):
        ensemble.fit(transitions, np.arange(len(transitions.rewards)) % 10 == 9, 500, rng)

    ensemble = Ensemble(3, 2, 1, rng, CPU)
    endless = noisy(3000, np.inf)
    for _ in range(3):
        fit(endless)
    both = Transitions(*(np.concatenate(parts) for parts in zip(endless, noisy(600, 1.1), strict=True)))
    share = both.terminated.mean()
    assert 0 < share < 0.02
    fit(both)
    predicted = ensemble.predict(both.observations, both.actions).terminated.mean()
    assert predicted <= 2 * share and ensemble.termination_error <= 2 * share
