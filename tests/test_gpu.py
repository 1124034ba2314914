"""Gradient steps in CUDA graphs on a real GPU: ``make check-gpu`` runs these and measures rates."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th
from sb3_contrib import CrossQ
from stable_baselines3 import SAC, TD3

from sb3_mcbs import MCBSTD3, resume
from tests.checkpoint_helpers import crash, learn
from tests.conftest import SMALL_SEARCH
from tests.graph_helpers import GRAPHED, TANH, GraphTD3, agent_with_steps, assert_alike, train

pytestmark = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
#: Adam turns rounding into steps of a fraction of the learning rate; other noise would change 0.01.
TOLERANCE = dict(rtol=5e-3, atol=5e-4)


def pair(cls, **kwargs):
    return [agent_with_steps(each, device="cuda", **deepcopy(kwargs)) for each in (cls, GRAPHED[cls])]


@pytest.mark.parametrize("cls", GRAPHED)
def test_graphs_train_as_sb3_does(cls):
    theirs, ours = pair(cls)
    train(theirs, 60), train(ours, 60)
    assert ours._graph_memory.graphs.n_captured >= 1
    assert_alike(theirs, ours, **TOLERANCE)


def test_graphs_train_as_the_same_steps_without():
    theirs, ours = (agent_with_steps(GraphTD3, device="cuda") for _ in range(2))
    theirs.cuda_graphs = False
    train(theirs, 60), train(ours, 60)
    assert theirs._graph_memory.graphs.n_captured == 0 < ours._graph_memory.graphs.n_captured
    assert_alike(theirs, ours, **TOLERANCE)


def test_crossq_past_its_warm_up():
    theirs, ours = pair(CrossQ, policy_kwargs=TANH | dict(renorm_warmup_steps=20))
    train(theirs, 60), train(ours, 60)
    assert_alike(theirs, ours, **TOLERANCE)


def test_every_replay_draws_new_noise():
    ours = agent_with_steps(GraphTD3, n_steps=1, learning_rate=0.0, target_policy_noise=0.5, device="cuda")
    found = set()
    for _ in range(30):
        ours.train(1, 16)
        ours._graph_memory.record_losses(ours.logger)
        found.add(ours.logger.name_to_value["train/critic_loss"])
    assert ours._graph_memory.graphs.n_captured == 2 and len(found) == 30


def test_changed_agents_are_captured_again():
    theirs, ours = pair(TD3)
    for agent in (theirs, ours):
        train(agent)
        agent.gamma = 0.5
        agent.set_parameters(deepcopy(agent.get_parameters()))
        train(agent)
        agent.critic.optimizer.zero_grad()
        agent.lr_schedule = lambda remaining: 1e-2
        train(agent)
    assert_alike(theirs, ours, **TOLERANCE)


@pytest.mark.parametrize("cls", [TD3, SAC, CrossQ])
def test_saved_agents_go_on_with_and_without_a_gpu(cls, tmp_path):
    ours = agent_with_steps(GRAPHED[cls], device="cuda")
    train(ours)
    ours.save(tmp_path / "agent")
    for device in ("cuda", "cpu"):
        for other in (cls, GRAPHED[cls]):
            loaded = other.load(tmp_path / "agent", device=device, custom_objects={"fast_update": True})
            loaded.replay_buffer, loaded.n_envs = deepcopy(ours.replay_buffer), 1
            loaded.replay_buffer.device = loaded.device
            loaded.set_logger(ours.logger)
            train(loaded)
            assert all(bool(th.isfinite(value).all()) for value in loaded.policy.state_dict().values())
            steps = {float(state["step"]) for state in loaded.critic.optimizer.state.values()}
            assert steps == {80.0}


def test_graphs_can_be_turned_off_and_on():
    theirs, ours = pair(TD3)
    for graphed in (True, False, True):
        ours.cuda_graphs = graphed
        train(theirs), train(ours)
    assert_alike(theirs, ours, **TOLERANCE)


def make_searching(folder, **kwargs):
    settings = dict(policy_kwargs=deepcopy(TANH), buffer_size=500, batch_size=16, learning_starts=20)
    more = settings | SMALL_SEARCH | kwargs
    return MCBSTD3("MlpPolicy", "InvertedPendulum-v5", device="cuda", seed=0, **more)


@pytest.mark.parametrize("value_expansion", [0, 2])
def test_a_search_trains_beside_the_graphs(value_expansion):
    agent = make_searching(None, value_expansion=value_expansion)
    agent.learn(80)
    assert agent._graph_memory.graphs.n_captured == 2
    action, _ = agent.predict(np.zeros(4))
    assert np.isfinite(action).all()


def test_rollouts_are_compiled_and_those_of_the_cpu(tmp_path):
    agent = make_searching(None)
    agent.learn(40)
    agent.save(tmp_path / "agent")
    on_cpu = MCBSTD3.load(tmp_path / "agent", agent.env, device="cpu")
    decisions = []
    for each in (agent, on_cpu):
        assert "rollouts are compiled" in each.planner.description
        decisions.append(each.planner.plan(agent._last_obs, np.random.default_rng(0)))
    np.testing.assert_allclose(decisions[0].values, decisions[1].values, rtol=1e-6)


def test_a_resumed_run_says_that_it_is_not_exact(tmp_path):
    crash(make_searching, tmp_path, 120, 100)
    agent = resume(tmp_path / "checkpoints")
    with pytest.warns(UserWarning, match="not exact: on cuda"):
        learn(agent, tmp_path, 120)
    assert agent.num_timesteps == 120 and agent._graph_memory.graphs.n_captured == 2


def test_actions_are_those_of_sb3():
    theirs, ours = pair(TD3)
    for number in range(8):
        observations = np.random.default_rng(number).normal(size=(1, 3))
        (expected, _), (found, _) = (agent.predict(observations) for agent in (theirs, ours))
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert ours._graph_memory.acting.graphs.n_captured == 1
