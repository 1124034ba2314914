"""Options that combine with strategies: the noise that is drawn, what is simulated, what is refused."""

from types import SimpleNamespace

import numpy as np
import pytest

from sb3_mcbs import BeamSettings, CEMSettings, SearchSettings, TreeSettings
from sb3_mcbs.agents.hyperparameters import convert_older
from sb3_mcbs.search import PRESETS, check_dynamics, draw_noise, make_settings
from sb3_mcbs.search.cem import draw_plan_noise
from sb3_mcbs.search.proposals import best, draw_normal, preselect
from sb3_mcbs.search.settings import _warn_of_old_name
from sb3_mcbs.search.tree import draw_tree_noise
from tests.fake_model import LineWorld
from tests.test_search import critics, search


def rng():
    return np.random.default_rng(0)


def test_proposing_as_many_as_are_simulated_changes_nothing():
    plain = BeamSettings(6, 3, 2, beam_noise=0.4)
    chosen = BeamSettings(6, 3, 2, beam_noise=0.4, n_proposals=6)
    roots = [0.3, -1.2]
    noise = draw_noise(rng(), plain, 2, 1)
    same = draw_noise(rng(), chosen, 2, 1)
    np.testing.assert_array_equal(noise.beam, same.beam)
    np.testing.assert_array_equal(noise.rollout, same.rollout)
    expected = search(LineWorld(1.3), roots, plain, noise)
    result = search(LineWorld(1.3), roots, chosen, same)
    np.testing.assert_array_equal(result.values, expected.values)
    np.testing.assert_array_equal(result.actions, expected.actions)


@pytest.mark.parametrize("include", [False, True])
def test_the_critics_choose_what_is_simulated(include):
    settings = BeamSettings(
        3, 2, 1, beam_noise=0.4, n_proposals=50, include_policy_action=include, rollout_noise=0.0
    )
    noise, model = draw_noise(rng(), settings, 1, 1), LineWorld()
    assert noise.beam.shape == (1, 50, 1) and noise.rollout.shape == (2, 1, 3, 1, 1)
    result = search(model, [1.5], settings, noise)
    all_proposals = search(
        LineWorld(),
        [1.5],
        BeamSettings(50, 1, 1, include_policy_action=include),
        noise._replace(rollout=np.zeros((1, 1, 50, 1, 1), dtype=np.float32)),
    ).candidates[0]
    by_critics = sorted(all_proposals[include:], key=lambda action: -min(critics(np.array([1.5]), action)))
    expected = {float(action[0]) for action in by_critics[: 3 - include]}
    if include:
        expected.add(float(all_proposals[0, 0]))
    assert set(result.candidates[0, :, 0].tolist()) == expected
    assert model.steps_taken == 6


def test_critics_that_are_not_finite_choose_nothing():
    values = np.array([[np.nan, 1.0, np.inf, 3.0, -np.inf, 2.0]])
    np.testing.assert_array_equal(preselect(values, 3, always=0), [[1, 3, 5]])
    np.testing.assert_array_equal(preselect(values, 3, always=1), [[0, 3, 5]])
    np.testing.assert_array_equal(best(np.array([[1.0, 2.0, 2.0, 2.0]]), 2), [[1, 2]])


@pytest.mark.parametrize("count", [1, 2, 5, 6])
def test_antithetic_pairs_cancel(count):
    sizes = dict(beam_width=count, rollout_depth=3, n_simulations=count, antithetic=True, noise_clip=0.15)
    noise = draw_noise(rng(), BeamSettings(**sizes), 2, 3)
    tree = draw_tree_noise(rng(), TreeSettings(branching=count, **sizes), 2, 3)
    plans = draw_plan_noise(rng(), CEMSettings(**{**sizes, "beam_width": max(count, 2)}), 2, 3)[:, :, :count]
    for drawn, axis in ((noise.beam, 1), (noise.rollout, 3), (tree.later, 3), (plans, 2)):
        assert drawn.shape[axis] == count
        if count > 1:
            np.testing.assert_array_equal(drawn.sum(axis=axis, dtype=np.float64), 0)
            assert (np.take(drawn, [0], axis=axis) == 0).all() == (count % 2 == 1)
        assert drawn.any()
    assert np.abs(noise.rollout).max() <= np.float32(0.15)
    assert tree.roots.shape == (2, 1, count * count, 3)


def test_pairs_are_of_independent_draws():
    drawn = draw_normal(rng(), (4, 1000, 2), 1)
    assert drawn.dtype == np.float32
    assert len(np.unique(np.abs(drawn))) == drawn.size // 2
    assert drawn.std() == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize(
    "changes, words",
    [
        (dict(strategy="best"), "strategy must be one of"),
        (dict(strategy=["tree"]), "strategy must be one of"),
        (dict(strategy="tree", rollout_depth=0), "rollout_depth of 1"),
        (dict(strategy="cem", rollout_depth=0), "rollout_depth of 1"),
        (dict(strategy="tree", beam_noise=0.0), "beam_noise above 0"),
        (dict(strategy="cem", search_kwargs=dict(noise_clip=0.0)), "noise_clip above 0"),
        (dict(strategy="cem", beam_width=1), "beam_width of 2"),
        (dict(strategy="tree", search_kwargs=dict(rollout_noise=0.0)), "rollout_noise above 0"),
        (dict(strategy="tree", search_kwargs=dict(branching=0)), "branching"),
        (dict(search_kwargs=dict(n_proposals=6, time_budget=1.0)), "n_proposals"),
        (dict(search_kwargs=dict(antithetic=True, time_budget=1.0)), "antithetic"),
        (dict(search_kwargs=dict(n_proposals=5)), "n_proposals must be between 6"),
        (dict(search_kwargs=dict(n_proposals=29), strategy="tree"), "n_proposals must be between 30"),
        (dict(search_kwargs=dict(n_proposals=31), strategy="tree"), "multiple of beam_width=6"),
        (dict(search_kwargs=dict(n_proposals=10), rollout_depth=0), "n_proposals needs a rollout_depth"),
        (dict(strategy="cem", search_kwargs=dict(n_rounds=0)), "n_rounds must be"),
        (dict(strategy="cem", search_kwargs=dict(n_elites=7)), "n_elites must be between 1 and 6"),
        (dict(strategy="cem", search_kwargs=dict(min_noise=0.0)), "n_elites of 2 or more"),
        (dict(beam_noise=0.0), "beam_width above 1 needs a beam_noise"),
        (dict(search_kwargs=dict(noise_clip=0.0)), "beam_width above 1 needs a beam_noise"),
        (
            dict(beam_noise=0.0, search_kwargs=dict(rollout_noise=0.2)),
            "beam_width above 1 needs a beam_noise",
        ),
        (dict(forward_model="ensemble", rollout_depth=0), "rollout_depth of 1 or more"),
        (dict(strategy="cem", search_kwargs=dict(min_noise=-0.1)), "min_noise must be"),
    ],
)
def test_senseless_combinations_are_refused(changes, words):
    with pytest.raises(ValueError, match=words):
        make_settings(**changes)


@pytest.mark.parametrize("name", ["include_policy_action", "antithetic"])
def test_switches_are_booleans(name):
    with pytest.raises(TypeError, match=f"{name} must be True or False"):
        BeamSettings(**{name: 1})


def test_simulations_that_would_be_the_same_are_reduced_with_a_message(caplog):
    for settings in (BeamSettings(rollout_noise=0.0), CEMSettings()):
        caplog.clear()
        check_dynamics(settings, deterministic=True)
        assert "n_simulations=5 is reduced to 1" in caplog.text
        caplog.clear()
        check_dynamics(settings, deterministic=False)
        assert not caplog.text
    check_dynamics(BeamSettings(), deterministic=True)
    assert not caplog.text


def test_presets():
    assert SearchSettings.preset("paper") == BeamSettings()
    for name, steps in (("efficient", 20), ("balanced", 110), ("strong", 580)):
        assert 0.8 * steps < SearchSettings.preset(name).simulated_steps() <= steps
        assert set(PRESETS[name]) <= {*SearchSettings.flat, "strategy", "search_kwargs"}
    changed = SearchSettings.preset("balanced", rollout_depth=2, search_kwargs=dict(n_rounds=4))
    assert changed == CEMSettings(12, 2, 1, antithetic=True, n_rounds=4)
    assert SearchSettings.preset("strong", strategy="tree").antithetic, "and what a tree does not know is not"
    assert SearchSettings.preset("train") == SearchSettings.preset("efficient")
    for unknown in ("best", None, ["strong"]):
        with pytest.raises(ValueError, match="known are paper, efficient, balanced, strong, train"):
            SearchSettings.preset(unknown)


def test_agents_of_before_a_setting_existed_have_its_default():
    old = SimpleNamespace(beam_width=3, rollout_depth=2)
    convert_older(old)
    assert SearchSettings.of(old) == BeamSettings(3, 2)


@pytest.mark.parametrize(
    ("strategy", "key", "words"),
    [
        ("tree", "time_budget", "strategy='tree' has no 'time_budget'.* is for strategy='beam'"),
        ("cem", "time_budget", "strategy='cem' has no 'time_budget'.* is for strategy='beam'"),
        ("beam", "branching", "strategy='beam' has no 'branching'.* is for strategy='tree'"),
        ("tree", "n_rounds", "strategy='tree' has no 'n_rounds'.* is for strategy='cem'"),
        ("beam", "beam_width", "has no 'beam_width'.* is a keyword of its own"),
        ("cem", "n_round", "has no 'n_round'; known are rollout_noise, .*, min_noise[.]$"),
    ],
)
def test_settings_of_other_strategies_are_refused(strategy, key, words):
    with pytest.raises(TypeError, match=words):
        make_settings(strategy, {key: 1})


def test_what_is_no_dictionary_is_refused():
    for group in ("search_kwargs", "model_kwargs"):
        with pytest.raises(TypeError, match=f"{group} must be a dictionary or None"):
            make_settings(**{group: [("antithetic", True)]})


def test_an_old_name_is_read_with_one_warning():
    _warn_of_old_name.cache_clear()
    with pytest.warns(FutureWarning, match="write strategy='cem'") as caught:
        assert make_settings("refine") == make_settings("refine") == CEMSettings()
    assert len(caught) == 1
