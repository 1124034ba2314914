"""Rollouts in compiled code give what the loop over depths gives, for any number of threads."""

import logging
from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_mcbs import MCBSDDPG, MCBSSAC, MCBSTD3, MCBSCrossQ
from sb3_mcbs.agents import expanded_buffer
from sb3_mcbs.agents.compiled_policy import CompiledPolicy
from sb3_mcbs.agents.planner import Planner
from sb3_mcbs.models.compiled_networks import actions_of, values_of
from sb3_mcbs.networks import mlp
from sb3_mcbs.networks.functions import policy_function, value_function
from sb3_mcbs.search import BeamSettings, CEMSettings, Roots, search

SMALL = dict(policy_kwargs=dict(net_arch=[17, 9]), buffer_size=500, learning_starts=10)


def make_planner(settings, env_id="Hopper-v5", normalized=False, cls=MCBSTD3, **kwargs) -> Planner:
    vec_env = DummyVecEnv([lambda: gym.make(env_id, **kwargs)])
    vec_env.seed(3)
    if normalized:
        vec_env = VecNormalize(vec_env)
    agent = cls("MlpPolicy", vec_env, seed=1, rollout_depth=0, **deepcopy(SMALL))
    planner = Planner(agent, vec_env, settings)
    vec_env.reset()
    for step in range(6):
        vec_env.step(np.full((1, *vec_env.action_space.shape), 0.1 * step, dtype=np.float32))
    return planner


def roots_of(planner: Planner) -> Roots:
    return Roots(planner.model, planner.model.read_roots([0]), planner.source.view.base.buf_obs[None].copy())


SETTINGS = {
    "paper": BeamSettings(5, 4, 3, beam_noise=0.5, n_threads=2),
    "held noise": BeamSettings(4, 3, 3, beam_noise=0.5, noise_hold=2, n_threads=2),
    "one simulation": BeamSettings(7, 3, 1, beam_noise=0.5, rollout_noise=0.0, n_threads=2),
    "pre-selection": BeamSettings(3, 3, 2, beam_noise=0.5, n_proposals=9, n_threads=2),
    "cem": CEMSettings(6, 3, beam_noise=0.5, n_threads=2),
}


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.parametrize("normalized", [False, True])
def test_compiled_rollouts_are_those_of_the_loop_over_depths(name: str, normalized: bool) -> None:
    """In an environment where some rollouts end early."""
    kwargs = {} if name == "cem" else {"healthy_angle_range": (-0.02, 0.02)}
    planner = make_planner(SETTINGS[name], normalized=normalized, **kwargs)
    roots, functions = roots_of(planner), planner.functions()
    assert functions.rollout is not None
    ways = functions, functions._replace(rollout=None)
    compiled, by_step = (search(roots, way, SETTINGS[name], np.random.default_rng(2)) for way in ways)
    np.testing.assert_allclose(compiled.values, by_step.values, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(compiled.first_step.observations, by_step.first_step.observations, rtol=1e-5)
    np.testing.assert_array_equal(compiled.chosen, by_step.chosen)
    for count in ("simulated_steps", "critic_evaluations", "invalid_rollouts"):
        assert getattr(compiled, count) == getattr(by_step, count)
    if name in ("paper", "held noise", "one simulation"):
        rollouts = SETTINGS[name].beam_width * SETTINGS[name].n_simulations
        assert 0 < compiled.critic_evaluations < rollouts, "no rollout ended early, or all did"


def test_the_number_of_threads_changes_nothing() -> None:
    results = []
    for n_threads in (1, 2, 3, 5):
        settings = BeamSettings(7, 3, 3, beam_noise=0.3, n_threads=n_threads)
        planner = make_planner(settings, "HalfCheetah-v5")
        result = search(roots_of(planner), planner.functions(), settings, np.random.default_rng(0))
        results.append(result.values.tobytes())
        planner.close()
    assert len(set(results)) == 1


@pytest.mark.parametrize("cls", [MCBSTD3, MCBSCrossQ])
def test_a_rows_actions_and_values_do_not_depend_on_its_neighbours(cls: type) -> None:
    planner = make_planner(SETTINGS["paper"], cls=cls, normalized=True)
    compiled = CompiledPolicy(planner.agent, planner.model, planner.source.view)
    arrays = compiled._arrays
    rng = np.random.default_rng(0)
    observations, actions = rng.normal(size=(13, 11)), rng.normal(size=(13, 3)).astype(np.float32)
    acted, valued = actions_of(arrays, observations, 3), values_of(arrays, observations, actions)
    for first in range(12):
        part = slice(first, first + 5)
        assert actions_of(arrays, observations[part], 3).tobytes() == acted[part].tobytes()
        assert values_of(arrays, observations[part], actions[part]).tobytes() == valued[part].tobytes()
    seen = planner.source.view.observe(observations)
    np.testing.assert_allclose(acted, policy_function(planner.agent)(seen), rtol=1e-4, atol=1e-6)
    expected = value_function(planner.agent)(seen, actions)
    np.testing.assert_allclose(valued, expected, rtol=1e-4, atol=1e-6)


def test_only_the_rollout_that_diverges_is_invalid(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log file
    planner = make_planner(SETTINGS["paper"], "HalfCheetah-v5")
    noise = np.zeros((3, 4, 2, 6), dtype=np.float32)
    roots, index, actions = planner.model.read_roots([0]), np.zeros(4, int), np.zeros((4, 6), np.float32)
    roll_out = planner.functions().rollout
    undisturbed = roll_out(roots, index, actions, noise, 1)
    noise[1, 2, 1] = np.nan
    found = roll_out(roots, index, actions, noise, 1)
    expected = np.ones((4, 2), dtype=bool)
    np.testing.assert_array_equal(undisturbed.valid, expected)
    expected[2, 1] = False
    np.testing.assert_array_equal(found.valid, expected)
    np.testing.assert_array_equal(found.returns[expected], undisturbed.returns[expected])
    assert found.lengths.tolist() == [[3, 3], [3, 3], [3, 2], [3, 3]]


@pytest.mark.parametrize("cls", [MCBSTD3, MCBSCrossQ])
def test_copies_of_networks_on_a_gpu_give_the_same(cls: type, monkeypatch: pytest.MonkeyPatch) -> None:
    """Here the networks are on the CPU and taken for others."""
    planner = make_planner(SETTINGS["paper"], "HalfCheetah-v5", cls=cls, normalized=True)
    roots, generator = roots_of(planner), np.random.default_rng
    own = search(roots, planner.functions(), SETTINGS["paper"], generator(0))
    monkeypatch.setattr(mlp, "_is_host", lambda device: False)
    copied = planner.functions()
    addresses = {array.data_ptr() for array in planner.agent.policy.state_dict().values()}
    tables = copied.rollout.__self__._arrays
    used = {*tables.actor[:, :4].ravel().tolist(), *tables.critics[:, :, :4].ravel().tolist()}
    assert len(used) > 10 and not used & addresses
    found = search(roots, copied, SETTINGS["paper"], generator(0))
    assert found.values.tobytes() == own.values.tobytes()
    with th.no_grad():
        for parameter in planner.agent.actor.parameters():
            parameter *= 0.5
    after = search(roots, planner.functions(), SETTINGS["paper"], generator(0))
    assert not np.array_equal(after.values, own.values)


def test_weights_that_change_are_seen() -> None:
    planner = make_planner(SETTINGS["paper"], "HalfCheetah-v5")
    functions, observations = planner.functions(), roots_of(planner).observations
    before = functions.policy(observations)
    with th.no_grad():
        planner.agent.actor.mu[0].weight *= 2
    assert not np.allclose(functions.policy(observations), before)


@pytest.mark.parametrize("number", [0, 1])
def test_critics_that_are_nan_stay_nan(number: int) -> None:
    planner = make_planner(SETTINGS["paper"], "HalfCheetah-v5")
    with th.no_grad():
        planner.agent.critic.q_networks[number][0].weight[0] = np.nan
    observations = roots_of(planner).observations
    assert np.isnan(planner.functions().value(observations, np.zeros((1, 6), np.float32))).all()


def test_the_log_says_which_way_rollouts_go_and_why(caplog: pytest.LogCaptureFixture) -> None:
    planner = make_planner(SETTINGS["paper"], "HalfCheetah-v5")
    with caplog.at_level(logging.INFO, logger="sb3_mcbs"):
        for _ in range(2):
            planner.functions()
        assert caplog.text.count("Rollouts are compiled.") == 1
        planner.agent.actor.mu[1] = th.nn.ELU()
        assert planner.functions().rollout is None
    assert "Rollouts go step by step: ELU is not covered" in caplog.text


DRAWN = "the actor draws its actions"
TREE = "a tree chooses the branches that go on after every step"
BUDGET = "time_budget may stop them between two steps"


@pytest.mark.parametrize(
    ("cls", "settings", "says"),
    [
        (MCBSTD3, {}, "rollouts are compiled"),
        (MCBSTD3, {"strategy": "tree"}, f"rollouts go step by step: {TREE}"),
        (MCBSTD3, {"search_kwargs": {"time_budget": 0.1}}, f"rollouts go step by step: {BUDGET}"),
        (MCBSTD3, {"value_expansion": 2}, "rollouts are compiled; expanded targets are compiled"),
        (
            MCBSSAC,
            {"value_expansion": 2},
            f"rollouts are compiled; expanded targets go step by step: {DRAWN}",
        ),
        (MCBSTD3, {"forward_model": "pool"}, "pool of environment copies (deterministic dynamics)"),
    ],
)
def test_the_first_line_says_which_way_rollouts_go_and_why(cls, settings, says, capsys, caplog) -> None:
    agent = cls("MlpPolicy", "Hopper-v5", verbose=1, seed=0, **settings, **deepcopy(SMALL))
    line = next(line for line in capsys.readouterr().out.splitlines() if "Forward model" in line)
    assert line.endswith(says)
    if "tree" in says or "budget" in says:
        with caplog.at_level(logging.INFO, logger="sb3_mcbs"):
            agent.planner.functions()
        assert "Rollouts go step by step" in caplog.text


def not_covered(agent: object, env: object) -> None:
    raise TypeError("by the test")


@pytest.mark.parametrize("cls", [MCBSTD3, MCBSDDPG])
@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("own_critics", [False, True])  # which targets do not need until they bootstrap
def test_compiled_expansion_is_that_of_the_loop(cls, normalized, own_critics, monkeypatch) -> None:
    vec_env = DummyVecEnv([lambda: gym.make("Hopper-v5")])
    if normalized:
        vec_env = VecNormalize(vec_env)
    agent = cls(
        "MlpPolicy", vec_env, seed=1, value_expansion=3, rollout_depth=1, search_share=0.0, **deepcopy(SMALL)
    )
    if own_critics:
        for critic in (*agent.critic.q_networks, *agent.critic_target.q_networks):
            critic[1] = th.nn.ELU()
    agent.learn(60)
    assert agent._expansion_in_words() == "; expanded targets are compiled"
    batches = []
    for compiled in (True, False):
        if not compiled:
            monkeypatch.setattr(expanded_buffer, "compiled_target", not_covered)
        steps = agent.n_simulated_steps
        rng = np.random.default_rng(5)
        batch = agent.replay_buffer.sample_expanded(40, rng, agent.get_vec_normalize_env())
        batches.append((*batch, agent.n_simulated_steps - steps))
    assert batches[0][-1] == batches[1][-1] > 0
    for ours, theirs in zip(batches[0][:-1], batches[1][:-1], strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)
    assert batches[0][3].any(), "no expansion ended in a termination"
