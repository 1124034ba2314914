"""Captured gradient steps against SB3's own, on the CPU with a stand-in for CUDA's graphs."""

import logging
import pickle
from copy import copy, deepcopy

import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs import MCBSSAC, MCBSTD3, MCBSCrossQ
from sb3_mcbs.agents.expanded_buffer import ExpandedReplayBuffer
from sb3_mcbs.networks import batches, graphs, mlp
from sb3_mcbs.networks.batches import CopiedBatches, MirroredBatches
from tests.fake_graph import FakeBackend
from tests.graph_helpers import GRAPHED, TANH, GraphTD3, SACSteps, agent_with_steps, assert_alike, train


@pytest.fixture
def backend(monkeypatch) -> FakeBackend:
    fake = FakeBackend()
    monkeypatch.setitem(graphs.BACKENDS, "cpu", fake)
    return fake


def normalized():
    return VecNormalize(make_vec_env("Pendulum-v1", 1, seed=0))


CASES = {
    "TD3": (TD3, {}),
    "TD3, two environments": (TD3, dict(env=lambda: make_vec_env("Pendulum-v1", 2, seed=0))),
    "TD3, policy delay 3": (TD3, dict(policy_delay=3)),
    "TD3, n-step": (TD3, dict(n_steps=3)),
    "TD3, normalised": (TD3, dict(env=normalized)),
    "TD3, weight decay": (TD3, dict(policy_kwargs=TANH | dict(optimizer_kwargs=dict(weight_decay=0.1)))),
    "DDPG": (DDPG, {}),
    "SAC": (SAC, {}),
    "SAC, fixed entropy": (SAC, dict(ent_coef=0.2)),
    "SAC, targets at every third step": (SAC, dict(target_update_interval=2)),
    "SAC, n-step": (SAC, dict(n_steps=3)),
    "TQC": (TQC, {}),
    "TQC, three critics": (TQC, dict(policy_kwargs=TANH | dict(n_critics=3, n_quantiles=7))),
    "CrossQ": (CrossQ, {}),
    "CrossQ past the warm-up": (CrossQ, dict(policy_kwargs=TANH | dict(renorm_warmup_steps=20))),
}


def pair(case):
    cls, kwargs = CASES[case]
    return agent_with_steps(cls, **kwargs), agent_with_steps(GRAPHED[cls], **kwargs)


@pytest.mark.parametrize("case", CASES)
def test_replayed_steps_are_sb3s(case, backend):
    theirs, ours = pair(case)
    start = {name: value.clone() for name, value in ours.policy.state_dict().items()}
    for agent in (theirs, ours):
        train(agent)
    assert backend.n_replays >= 15 and 1 <= backend.n_captures <= 4
    assert theirs._n_updates == ours._n_updates == 40
    assert_alike(theirs, ours)
    moved = [float((ours.policy.state_dict()[name] - value).abs().max()) for name, value in start.items()]
    assert max(moved) > 0.01
    ours._graph_memory.record_losses(ours.logger)
    expected, found = theirs.logger.name_to_value, ours.logger.name_to_value
    assert expected.keys() == found.keys()
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=1e-3), name


@pytest.mark.parametrize("cls", [SAC, TQC, CrossQ])
def test_the_same_steps_run_eagerly(cls):
    theirs, ours = agent_with_steps(cls), agent_with_steps(GRAPHED[cls])
    train(theirs)
    ours.set_random_seed(1)
    for _ in range(20):
        ours._make_update().train(2, 16)
    assert_alike(theirs, ours)
    assert theirs.logger.name_to_value.keys() == ours.logger.name_to_value.keys()


def other_gamma(agent):
    agent.gamma = 0.5


def other_tau(agent):
    agent.tau = 0.5


def other_noise(agent):
    agent.target_policy_noise, agent.target_noise_clip = 0.5, 1.0


def other_optimizer_settings(agent):
    agent.critic.optimizer.param_groups[0]["betas"] = (0.5, 0.9)


def parameters_from_a_file(agent):
    agent.set_parameters(deepcopy(agent.get_parameters()))


def other_storage(agent):
    for parameter in agent.critic.parameters():
        parameter.data = parameter.data * 0.5


def other_activation(agent):
    for network in (agent.actor, agent.actor_target):
        network.mu[1] = th.nn.ReLU()


def other_target(agent):
    agent.critic_target = deepcopy(agent.critic)


def other_buffer(agent):
    agent.replay_buffer = deepcopy(agent.replay_buffer)
    agent.replay_buffer.rewards += 1


RECAPTURED = [
    other_gamma,
    other_tau,
    other_noise,
    other_optimizer_settings,
    parameters_from_a_file,
    other_storage,
    other_activation,
    other_target,
    other_buffer,
]


def other_learning_rate(agent):
    agent.lr_schedule = lambda remaining: 1e-2


def other_values(agent):
    with th.no_grad():
        for parameter in agent.actor.parameters():
            parameter *= 0.5


def other_rewards(agent):
    agent.replay_buffer.rewards *= 0.5


def other_delay(agent):
    agent.policy_delay = 4


STILL_CAPTURED = [other_learning_rate, other_values, other_rewards, other_delay]


@pytest.mark.parametrize("change", [*RECAPTURED, *STILL_CAPTURED])
def test_changed_agents_are_trained_as_by_sb3(change, backend):
    theirs, ours = pair("TD3")
    train(theirs), train(ours)
    captured, ours_before = backend.n_captures, ours._graph_memory.graphs.n_captured
    assert captured == ours_before == 2
    for agent in (theirs, ours):
        change(agent)
        train(agent)
    assert_alike(theirs, ours)
    assert backend.n_captures == captured + (2 if change in RECAPTURED else 0)


def test_gradients_that_sb3_drops_are_still_the_graphs(backend):
    theirs, ours = pair("TD3")
    for agent in (theirs, ours):
        train(agent)
        agent.actor.optimizer.zero_grad()
        agent.critic.optimizer.zero_grad()
        train(agent)
    assert_alike(theirs, ours)


def test_a_loaded_warm_up_is_counted_anew(backend):
    theirs, ours = pair("CrossQ past the warm-up")
    for agent in (theirs, ours):
        train(agent, 60)
        assert agent.critic.qf0[0].steps == 60
        state = deepcopy(agent.policy.state_dict())
        for name, value in state.items():
            if name.endswith("steps"):
                value.fill_(15)
        agent.policy.load_state_dict(state)
        train(agent, 4)
        train(agent, 20)
    assert_alike(theirs, ours)


def test_every_replay_draws_new_noise(backend):
    ours = agent_with_steps(GraphTD3, n_steps=1, learning_rate=0.0, target_policy_noise=0.5)
    found = set()
    for _ in range(20):
        ours.train(1, 16)
        ours._graph_memory.record_losses(ours.logger)
        found.add(ours.logger.name_to_value["train/critic_loss"])
    assert backend.n_replays >= 12 and len(found) == 20


def test_without_room_for_the_rows_batches_are_copied(backend, monkeypatch, caplog):
    def no_room(*args):
        raise th.OutOfMemoryError("CUDA out of memory")

    theirs, ours = pair("TD3")
    monkeypatch.setattr(batches, "MirroredBatches", no_room)
    monkeypatch.setattr("sb3_mcbs.networks.update.MirroredBatches", MirroredBatches)
    train(theirs), train(ours)
    assert_alike(theirs, ours)
    assert isinstance(ours._graph_memory._batches, CopiedBatches)
    assert caplog.text.count("There is no room for the replay buffer") == 1


def test_what_cannot_be_captured_runs_without(backend, monkeypatch, caplog):
    def fails(step):
        raise RuntimeError("CUDA error: operation not permitted when stream is capturing")

    monkeypatch.setattr(backend, "capture", fails)
    theirs, ours = pair("SAC")
    train(theirs), train(ours)
    assert_alike(theirs, ours)
    assert caplog.text.count("gradient steps go on without: CUDA error") == 1


def test_a_number_that_the_host_reads_cannot_be_captured(backend):
    with pytest.raises(RuntimeError, match="not permitted"):
        backend.capture(lambda: th.ones(1).item())


NOT_COVERED = {
    "hooks": lambda agent: agent.critic.qf0.register_forward_hook(lambda *args: None),
    "frozen": lambda agent: agent.actor.mu.requires_grad_(False),
    "has other modules": lambda agent: agent.critic.register_module("extra", th.nn.Linear(1, 1)),
    "was replaced": lambda agent: setattr(agent.actor, "get_action_dist_params", None),
}


@pytest.mark.parametrize("reason", NOT_COVERED)
@pytest.mark.parametrize("cls", [SAC, TQC, CrossQ])
def test_what_is_not_covered_is_left_to_sb3(cls, reason, backend, caplog):
    caplog.set_level(logging.INFO, "sb3_mcbs")
    ours = agent_with_steps(GRAPHED[cls])
    NOT_COVERED[reason](ours)
    for _ in range(2):
        assert ours._present_update() is None
    assert caplog.text.count("Gradient steps are SB3's own") == 1 and reason in caplog.text


def test_gsde_is_left_to_sb3(backend, caplog):
    caplog.set_level(logging.INFO, "sb3_mcbs")
    theirs, ours = agent_with_steps(SAC, use_sde=True), agent_with_steps(SACSteps, use_sde=True)
    train(theirs), train(ours)
    assert_alike(theirs, ours)
    assert backend.n_replays == 0 and "not an actor whose mean action is an MLP" in caplog.text


def test_an_adam_that_the_user_chose_is_not_captured(backend, caplog):
    caplog.set_level(logging.INFO, "sb3_mcbs")
    theirs, ours = pair("TD3")
    for agent in (theirs, ours):
        agent.actor.optimizer.param_groups[0]["foreach"] = True
        train(agent)
    assert_alike(theirs, ours)
    assert backend.n_warm_ups == 0
    assert caplog.text.count("Gradient steps are not captured in CUDA graphs: an optimizer's foreach") == 1


@pytest.mark.parametrize("cls", GRAPHED)
def test_graphs_can_be_turned_off_and_on(cls, backend):
    theirs, ours = agent_with_steps(cls), agent_with_steps(GRAPHED[cls])
    for number, graphed in enumerate((True, False, True)):
        ours.cuda_graphs, replays = graphed, backend.n_replays
        train(theirs), train(ours)
        assert (backend.n_replays > replays) == graphed, number
    assert_alike(theirs, ours)
    for optimizer in (ours.actor.optimizer, ours.critic.optimizer):
        group = optimizer.param_groups[0]
        assert (group["fused"], group["capturable"], type(group["lr"])) == (None, False, float)
    ours.cuda_graphs = "yes"
    with pytest.raises(TypeError, match="cuda_graphs must be True or False, got 'yes'"):
        train(ours)


@pytest.mark.parametrize("cls", GRAPHED)
def test_saved_agents_go_on(cls, backend, tmp_path):
    theirs, ours = agent_with_steps(cls), agent_with_steps(GRAPHED[cls])
    train(theirs), train(ours)
    ours.save(tmp_path / "ours")
    for other in (cls, GRAPHED[cls]):
        loaded = other.load(tmp_path / "ours", device="cpu", custom_objects={"fast_update": True})
        loaded.replay_buffer, loaded.n_envs = theirs.replay_buffer, 1
        loaded.set_logger(configure(None, []))
        expected = deepcopy(theirs)
        train(expected), train(loaded)
        assert_alike(expected, loaded)


def test_copies_capture_their_own(backend):
    ours = agent_with_steps(GraphTD3)
    train(ours)
    for other in (deepcopy(ours), pickle.loads(pickle.dumps(ours._graph_memory))):
        memory = getattr(other, "_graph_memory", other)
        assert memory.graphs.n_captured == 0 and memory._batches is None
    other = deepcopy(ours)
    for agent in (ours, other):
        train(agent)
    assert_alike(ours, other)


@pytest.mark.parametrize("settings", [{}, dict(fast_update=False)])
def test_an_agent_that_searches_learns_the_same(settings, backend, make_agent, tmp_path):
    found = []
    for graphed in (False, True):
        agent = make_agent(
            "InvertedPendulum-v5", seed=1, policy_kwargs=deepcopy(TANH), cuda_graphs=graphed, **settings
        )
        agent.set_logger(configure(str(tmp_path / str(graphed)), ["csv"]))
        agent.learn(80, log_interval=1)
        found.append(agent)
    assert (backend.n_replays > 0) == settings.get("fast_update", True)
    assert_alike(*found)
    columns = [(tmp_path / name / "progress.csv").read_text().splitlines()[0] for name in ("True", "False")]
    assert "train/critic_loss" in columns[0]
    assert set(columns[0].split(",")) == set(columns[1].split(","))
    assert copy(found[1])._graph_memory is not found[1]._graph_memory


AHEAD = {
    "stored transitions, in compiled code": (MCBSTD3, dict(tau=0.5)),
    "stored transitions, step by step": (MCBSSAC, {}),
    "branches": (MCBSCrossQ, dict(branch_length=4, learning_rate=1e-3)),
}


@pytest.mark.parametrize("case", AHEAD)
def test_the_next_batch_is_simulated_during_the_step(case, backend, make_agent, monkeypatch):
    """Networks are taken for those of a GPU. The other agent samples as :func:`simulating_first`."""
    monkeypatch.setattr(mlp, "_is_host", lambda device: False)
    cls, settings = AHEAD[case]
    # Every step moves the networks far.
    settings = dict(policy_kwargs=deepcopy(TANH), value_expansion=2, learning_rate=0.01) | settings
    simulated = []
    for name in ("draw", "simulate_ahead"):
        method = getattr(CopiedBatches, name)

        def counted(batches, *args, name=name, method=method):
            agent = batches._buffer.expanding_agent
            before = agent.n_simulated_steps
            method(batches, *args)
            simulated.append((name, agent.n_simulated_steps - before))

        monkeypatch.setattr(CopiedBatches, name, counted)
    found = []
    for graphed in (True, False):
        agent = make_agent("InvertedPendulum-v5", cls=cls, seed=1, cuda_graphs=graphed, **settings)
        if not graphed:
            monkeypatch.setattr(ExpandedReplayBuffer, "sample", simulating_first(ExpandedReplayBuffer.sample))
        agent.learn(80)
        found.append(agent)
    assert_alike(*found)
    (first, n), *others = simulated
    assert first == "draw" and n > 0 and len(others) > 100
    assert all((n > 0) == (name == "simulate_ahead") for name, n in others)


def test_nothing_is_simulated_for_a_replay_buffer_that_no_longer_expands(backend, make_agent):
    env = VecNormalize(make_vec_env("InvertedPendulum-v5", 1))
    agent = make_agent(env, search_share=0.0, value_expansion=2)
    agent.learn(30)
    buffer, n = agent.replay_buffer, agent.n_simulated_steps
    assert n > 0 and buffer._ahead is not None
    assert "_ahead" not in vars(pickle.loads(pickle.dumps(buffer)))
    agent.value_expansion = 0
    agent.learn(30)
    assert agent.replay_buffer is buffer and agent.n_simulated_steps == n
    assert "_ahead" not in vars(buffer)


def simulating_first(sample):
    """Simulate for the next batch before the step, when no network has moved."""

    def sample_and_simulate(buffer, batch_size, env=None):
        batch = sample(buffer, batch_size, env)
        buffer.next_simulation(batch_size, env)()
        return batch

    return sample_and_simulate


@pytest.mark.parametrize("cls", [TD3, DDPG])
def test_replayed_actions_are_sb3s(cls, backend):
    theirs, ours = (agent_with_steps(each) for each in (cls, GRAPHED[cls]))
    backend.n_replays, rng = 0, np.random.default_rng(0)

    def assert_same_actions(agents=(theirs, ours)):
        for shape in ((1, 3), (4, 3), (3,), (1, 3)):
            observations = rng.normal(size=shape)
            (expected, _), (found, _) = (agent.predict(observations) for agent in agents)
            assert found.shape == expected.shape and found.dtype == expected.dtype
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)

    for _ in range(4):
        assert_same_actions()
    for agent in (theirs, ours):
        train(agent, 4)
    assert_same_actions()
    for agent in (theirs, ours):
        agent.set_parameters({"policy": {k: v / 2 for k, v in agent.policy.state_dict().items()}}, False)
    assert_same_actions()
    assert backend.n_replays >= 12 and backend.n_captures == 2, "one for each number of rows"
    for agent in (theirs, ours):
        agent.policy.actor.mu[1] = th.nn.ReLU()
    assert_same_actions()
    replays = backend.n_replays
    for agent in (theirs, ours):
        agent.policy.actor.mu[1].register_forward_hook(lambda module, inputs, output: output * 0)
    assert_same_actions()
    assert backend.n_replays == replays
