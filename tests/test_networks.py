"""Networks as functions on arrays, against SB3's own calls of them."""

import sys
from types import MappingProxyType

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC, CrossQ
from sb3_contrib.common.torch_layers import BatchRenorm1d
from sb3_contrib.crossq import policies as crossq_policies
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.env_util import make_vec_env

from sb3_mcbs import MCBSTD3, MCBSCrossQ
from sb3_mcbs.networks import mlp
from sb3_mcbs.networks.batch_renorm import Renormalization
from sb3_mcbs.networks.functions import policy_function, target_actor, value_function
from sb3_mcbs.networks.mlp import MLP
from sb3_mcbs.networks.plain_networks import actor_mlp, critic_mlps
from sb3_mcbs.networks.torch_settings import matmul_precision, one_thread
from tests.conftest import SMALL
from tests.graph_helpers import GRAPHED, TANH, agent_with_steps, assert_alike, train

CROSSQ = (CrossQ, GRAPHED[CrossQ])


def agent_of(cls, settings=MappingProxyType({}), **policy_kwargs):
    return cls(
        "MlpPolicy",
        "HalfCheetah-v5",
        seed=0,
        **{**SMALL, "policy_kwargs": dict(net_arch=[16, 12]) | policy_kwargs, **settings},
    )


def change_normalization(agent):
    """Give batch renormalization parameters and statistics that it might have after a training."""
    for layer in agent.policy.modules():
        if isinstance(layer, BatchRenorm1d):
            with th.no_grad():
                for tensor in (layer.ra_mean, layer.bias):
                    tensor.normal_()
                for tensor in (layer.ra_var, layer.scale):
                    tensor.uniform_(0.2, 3)


def sb3_action(agent, observations):
    return agent.policy.scale_action(agent.predict(observations, deterministic=True)[0])


def sb3_value(agent, observations, actions):
    with th.no_grad():
        values = agent.critic(th.as_tensor(observations), th.as_tensor(actions))
        if isinstance(agent, TQC):
            return values.mean(dim=(1, 2)).numpy()
        return np.min([value[:, 0].numpy() for value in values], axis=0)


HANDLERS = [
    (TD3, {}),
    (TD3, dict(n_critics=3, activation_fn=th.nn.Tanh)),
    (TD3, dict(activation_fn=th.nn.ELU)),  # not covered by MLP: SB3's own call
    (DDPG, {}),
    (SAC, {}),
    (SAC, dict(use_sde=True)),
    (TQC, {}),
    (CrossQ, {}),
    (CrossQ, dict(batch_norm=False)),
    (CrossQ, dict(activation_fn=th.nn.Tanh, batch_norm_eps=0.1)),
    (CrossQ, dict(net_arch=[])),
]


@pytest.mark.parametrize("cls, policy_kwargs", HANDLERS)
@pytest.mark.parametrize("rows", [1, 7])
def test_same_numbers_as_sb3(cls, policy_kwargs, rows):
    agent = agent_of(cls, **policy_kwargs)
    change_normalization(agent)
    agent.policy.set_training_mode(False)
    rng = np.random.default_rng(0)
    observations, actions = rng.standard_normal((rows, 17)), rng.uniform(-1, 1, (rows, 6)).astype(np.float32)
    found = policy_function(agent)(observations)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, sb3_action(agent, observations), rtol=1e-5, atol=1e-6)
    found = value_function(agent)(observations, actions)
    np.testing.assert_allclose(found, sb3_value(agent, observations, actions), rtol=1e-5, atol=1e-6)


def test_present_parameters_and_networks_are_used():
    agent, other = agent_of(TD3), agent_of(TD3, activation_fn=th.nn.Tanh)
    observations = np.random.default_rng(0).standard_normal((3, 17))
    before = policy_function(agent)(observations)
    with th.no_grad():
        agent.actor.mu[0].weight.mul_(2)  # as an optimizer does
        agent.actor.mu[2].weight.data = agent.actor.mu[2].weight.data * 3  # as ``to(device)`` does
    found = policy_function(agent)(observations)
    np.testing.assert_allclose(found, sb3_action(agent, observations), rtol=1e-5, atol=1e-6)
    assert abs(found - before).max() > 0.01
    agent.policy.actor = other.actor
    found = policy_function(agent)(observations)
    np.testing.assert_allclose(found, sb3_action(other, observations), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("cls", [TD3, DDPG, SAC, TQC, CrossQ])
def test_networks_of_a_gpu_are_copied_as_they_are(cls, monkeypatch):
    """Here they are on the CPU and taken for others."""
    agent, rng = agent_of(cls), np.random.default_rng(0)
    change_normalization(agent)
    agent.policy.set_training_mode(False)
    observations = rng.standard_normal((7, 17)).astype(np.float32)
    actions = rng.uniform(-1, 1, (7, 6)).astype(np.float32)

    def functions():
        policy, value, draw = policy_function(agent), value_function(agent), target_actor(agent)
        return lambda: [
            policy(observations),
            value(observations, actions),
            *draw(observations, np.random.default_rng(0)),
        ]

    expected = functions()()
    monkeypatch.setattr(mlp, "_is_host", lambda device: False)
    copied = functions()
    with th.no_grad():
        for tensor in agent.policy.parameters():
            tensor *= 1.1
    for before, found in zip(expected, copied(), strict=True):
        np.testing.assert_array_equal(found, before)
    changed = [np.array_equal(a, b) for a, b in zip(functions()(), expected, strict=True)]
    assert not any(changed[:3])


@pytest.mark.parametrize("cls", [SAC, TQC, CrossQ])
def test_what_sb3s_actors_draw_with_may_be_replaced(cls, monkeypatch):
    agent, observations = agent_of(cls), np.zeros((3, 17), dtype=np.float32)

    def drawn():
        return target_actor(agent)(observations, np.random.default_rng(0))

    (actions, bonus), log_prob = drawn(), SquashedDiagGaussianDistribution.log_prob
    monkeypatch.setattr(SquashedDiagGaussianDistribution, "log_prob", lambda *args: 2 * log_prob(*args))
    np.testing.assert_allclose(drawn()[1], 2 * bonus, rtol=1e-4)
    monkeypatch.undo()
    monkeypatch.setattr(sys.modules[type(agent.actor).__module__], "LOG_STD_MAX", -19.0)
    assert np.abs(drawn()[0] - actions).max() > 0.1


def test_batch_renormalization_has_the_present_statistics():
    agent = agent_of(CrossQ)
    rng = np.random.default_rng(0)
    observations, actions = rng.standard_normal((5, 17)), rng.uniform(-1, 1, (5, 6)).astype(np.float32)
    before = policy_function(agent)(observations), value_function(agent)(observations, actions)
    change_normalization(agent)
    agent.policy.set_training_mode(True)  # as in ``train``, where single rows would be normalized to nothing
    statistics = {name: value.clone() for name, value in agent.policy.state_dict().items()}
    actor_mlp(agent.actor), critic_mlps(agent.critic)  # covered, not left to SB3
    found = policy_function(agent)(observations), value_function(agent)(observations, actions)
    agent.policy.set_training_mode(False)
    np.testing.assert_allclose(found[0], sb3_action(agent, observations), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found[1], sb3_value(agent, observations, actions), rtol=1e-5, atol=1e-6)
    assert abs(found[0] - before[0]).max() > 0.01 and abs(found[1] - before[1]).max() > 0.01
    assert all(th.equal(value, statistics[name]) for name, value in agent.policy.state_dict().items())


def test_batch_renormalization_that_is_not_covered():
    layer = BatchRenorm1d(2)
    layer.train = lambda mode=True: layer
    with pytest.raises(TypeError, match="replaced train method"):
        MLP(layer)
    layer = BatchRenorm1d(2)
    layer.register_buffer("more", th.zeros(2))
    with pytest.raises(TypeError, match="other parameters or statistics"):
        MLP(layer)


@pytest.mark.parametrize("warmup_steps", [10, -1])
def test_batch_renormalization_is_sb3_contribs(warmup_steps):
    theirs, ours = (BatchRenorm1d(5, warmup_steps=warmup_steps) for _ in range(2))
    th.manual_seed(0)
    for layer in (theirs, ours):
        layer.ra_mean.copy_(th.linspace(-8, 8, 5))  # clipped at both ends
        layer.ra_var.copy_(th.linspace(0.1, 40, 5))
        layer.scale.data = th.linspace(-1, 2, 5)
    x, gradient = th.randn(2, 70, 5)
    given = (2 * x + 1).requires_grad_()
    expected = theirs(given)
    expected.backward(gradient)
    renormalization = Renormalization(ours)
    with th.no_grad():
        found, kept = renormalization.train(given.t(), past_warmup=warmup_steps < 0)
        of_input = renormalization.backward(kept, gradient.t().clone(), of_parameters=True, of_input=True)
    pairs = [(found.t(), expected), (of_input.t(), given.grad)]
    pairs += [(p.grad, q.grad) for p, q in zip(ours.parameters(), theirs.parameters(), strict=True)]
    pairs += zip(ours.buffers(), theirs.buffers(), strict=True)
    for value, right in pairs:
        th.testing.assert_close(value, right, rtol=1e-4, atol=1e-5)

    theirs.eval()
    expected = theirs(given)
    by_input = th.autograd.grad(expected, given, gradient)[0]
    with th.no_grad():
        found, kept = renormalization.evaluate(given.t())
        of_input = renormalization.backward(kept, gradient.t().clone(), of_parameters=False, of_input=True)
    th.testing.assert_close(found.t(), expected, rtol=1e-4, atol=1e-5)
    th.testing.assert_close(of_input.t(), by_input, rtol=1e-4, atol=1e-5)


def test_a_dead_unit_has_no_gradient():
    layer = BatchRenorm1d(2, warmup_steps=-1)
    layer.ra_mean += 1
    renormalization = Renormalization(layer)
    with th.no_grad():
        output, kept = renormalization.train(th.tensor([[0.0, 0.0], [1.0, 2.0]]), past_warmup=True)
        of_input = renormalization.backward(kept, 2 * output, of_parameters=False, of_input=True)
    assert th.isfinite(of_input).all() and of_input[1].any()


@pytest.mark.parametrize("policy_delay", [1, 3])
def test_crossq_trains_as_sb3_contrib_does(policy_delay):
    settings = {"learning_starts": 50, "policy_delay": policy_delay, "search_share": 0.0}
    agents = [agent_of(MCBSCrossQ, settings | {"fast_update": fast}) for fast in (False, True)]
    assert [agent._present_update() is not None for agent in agents] == [False, True]
    for agent in agents:
        agent.learn(50)
        agent.set_random_seed(1)
        agent.train(gradient_steps=30, batch_size=32)
    for name, expected in agents[0].policy.state_dict().items():
        th.testing.assert_close(agents[1].policy.state_dict()[name], expected, rtol=1e-3, atol=1e-4)
    for name in ("actor_loss", "critic_loss", "ent_coef", "ent_coef_loss"):
        values = [agent.logger.name_to_value[f"train/{name}"] for agent in agents]
        assert values[1] == pytest.approx(values[0], rel=1e-3), name


def crossq_agents(settings=MappingProxyType({}), **policy_kwargs):
    """SB3-Contrib's and ours in the same state, with transitions to learn from and learned statistics."""
    agents = [agent_with_steps(cls, policy_kwargs=TANH | policy_kwargs, **settings) for cls in CROSSQ]
    for agent in agents:
        th.manual_seed(2)
        change_normalization(agent)
    return agents


@pytest.mark.parametrize("warmup_steps", [1000, -1])
@pytest.mark.parametrize(
    "policy_kwargs",
    [
        {},
        dict(activation_fn=th.nn.ReLU),
        dict(n_critics=1, net_arch=[8]),
        dict(n_critics=3, net_arch=dict(pi=[8, 7, 6], qf=[])),
        dict(batch_norm=False),
    ],
)
@pytest.mark.parametrize("policy_delay", [1, 2])
def test_gradients_of_crossq_are_sb3_contribs(policy_kwargs, warmup_steps, policy_delay):
    # Adam hides factors, so the gradients themselves are compared. In a step of the actor SB3-Contrib adds
    # gradients to the critics' that it does not use.
    settings = {"policy_delay": policy_delay, "ent_coef": "auto_0.2"}
    theirs, ours = crossq_agents(settings, renorm_warmup_steps=warmup_steps, **policy_kwargs)
    assert ours._present_update() is not None
    for agent in (theirs, ours):
        agent.set_random_seed(1)
        agent.train(gradient_steps=1, batch_size=64)
    network = "actor" if policy_delay == 1 else "critic"
    pairs = [getattr(agent, network).named_parameters() for agent in (theirs, ours)]
    for (name, expected), (_, found) in zip(*pairs, strict=True):
        scale = float(expected.grad.abs().max())
        th.testing.assert_close(found.grad, expected.grad, rtol=1e-3, atol=1e-4 * scale + 1e-6, msg=name)
    if policy_delay == 1:
        th.testing.assert_close(ours.log_ent_coef.grad, theirs.log_ent_coef.grad)


def with_new_adams(change):
    def changed(agent):
        th.manual_seed(3)
        change(agent)
        for network in (agent.actor, agent.critic):
            network.optimizer = th.optim.Adam(network.parameters(), lr=1e-3)

    return changed


@with_new_adams
def tied_critics(agent):
    agent.critic.qf1[4] = agent.critic.qf0[4]


@with_new_adams
def tied_normalization(agent):
    agent.critic.qf1[3] = agent.critic.qf0[3]


@with_new_adams
def shared_by_actor_and_critic(agent):
    agent.actor.latent_pi[4] = agent.critic.qf0[4]


@with_new_adams
def mean_is_deviation(agent):
    agent.actor.log_std = agent.actor.mu


@with_new_adams
def a_layer_twice(agent):
    layer = th.nn.Linear(12, 12)
    agent.actor.latent_pi.extend([layer, th.nn.Tanh(), layer])


@with_new_adams
def normalized_mean(agent):
    agent.actor.mu = th.nn.Sequential(BatchRenorm1d(12), agent.actor.mu)


def pinned_mode(agent):
    for layer in agent.critic.modules():
        if isinstance(layer, BatchRenorm1d):
            layer.eval()
            layer.train = lambda mode=True, layer=layer: layer


def other_density(agent):
    distribution = agent.actor.action_dist
    log_prob = distribution.log_prob
    distribution.log_prob = lambda *args: 3 * log_prob(*args)


LEFT_TO_SB3_CONTRIB = {
    tied_critics: "a parameter is used twice",
    tied_normalization: "a parameter is used twice",
    shared_by_actor_and_critic: "a parameter is used twice",
    mean_is_deviation: "a parameter is used twice",
    a_layer_twice: "a parameter is used twice",
    normalized_mean: "mean and standard deviation contain batch renormalization",
    pinned_mode: "a replaced train method",
    other_density: "a method of the actor's distribution was replaced",
}


@pytest.mark.parametrize("change", LEFT_TO_SB3_CONTRIB)
def test_a_changed_crossq_is_left_to_sb3_contrib(change):
    theirs, ours = crossq_agents({"policy_delay": 1})
    for agent in (theirs, ours):
        change(agent)
        train(agent, 6)
    assert LEFT_TO_SB3_CONTRIB[change] in "".join(ours._reasons_said)
    assert_alike(theirs, ours, rtol=0, atol=0)


@pytest.mark.parametrize(
    "owner, name, value",
    [
        (crossq_policies.Actor, "action_log_prob", None),
        (crossq_policies, "LOG_STD_MAX", -1.5),
        (SquashedDiagGaussianDistribution, "log_prob_from_params", None),
    ],
)
def test_what_sb3_contribs_actor_uses_may_be_replaced(owner, name, value, monkeypatch):
    ours = agent_with_steps(GRAPHED[CrossQ])
    assert ours._present_update() is not None
    monkeypatch.setattr(owner, name, value)
    assert ours._present_update() is None
    assert f"{owner.__name__}.{name} was replaced" in "".join(ours._reasons_said)


def test_batch_renormalization_is_left_in_the_same_mode():
    for agent in crossq_agents():
        agent.policy.set_training_mode(True)  # as modules are made
        agent.train(1, 16)
        layers = [layer for layer in agent.policy.modules() if isinstance(layer, BatchRenorm1d)]
        assert layers and not any(layer.training for layer in layers)


def test_the_default_type_of_numbers_may_be_another():
    theirs, ours = crossq_agents({"policy_delay": 1})
    th.set_default_dtype(th.float64)
    try:
        train(theirs, 6), train(ours, 6)
    finally:
        th.set_default_dtype(th.float32)
    assert ours._present_update() is not None
    assert_alike(theirs, ours)


@pytest.mark.parametrize("cls, batch_size", [(MCBSTD3, 100), (MCBSCrossQ, 64)])
def test_the_default_batch_size_is_sb3s(cls, batch_size, monkeypatch):
    agent = agent_of(cls, {"search_share": 0.0, "learning_starts": 20})
    agent.learn(20)
    sample, sizes = agent.replay_buffer.sample, []
    agent.replay_buffer.sample = lambda size, **kwargs: sizes.append(size) or sample(size, **kwargs)
    for agent.fast_update in (True, False):
        agent.train(gradient_steps=1)
    assert sizes == [batch_size, batch_size]


def test_hooks_run():
    agent = agent_of(TD3)
    agent.actor.mu[1].register_forward_hook(lambda module, inputs, output: output * 0)
    bias = agent.actor.mu[2].bias
    expected = policy_function(agent)(np.ones((2, 17)))
    np.testing.assert_allclose(expected, sb3_action(agent, np.ones((2, 17))), rtol=1e-5, atol=1e-6)
    assert bias.requires_grad
    with pytest.raises(TypeError, match="hooks"):
        actor_mlp(agent.actor)


def test_images_are_not_flattened():
    agent = agent_of(TD3)
    agent.actor.observation_space = spaces.Box(0, 255, (3, 40, 40), np.uint8)
    with pytest.raises(TypeError, match="vectors"):
        actor_mlp(agent.actor)


def test_other_layers_are_named():
    with pytest.raises(TypeError, match="LayerNorm"):
        MLP(th.nn.Linear(2, 2), th.nn.LayerNorm(2))
    with pytest.raises(TypeError, match="no layers"):
        MLP(th.nn.Sequential())


def test_gradients_against_autograd():
    th.manual_seed(0)
    network = th.nn.Sequential(
        th.nn.Linear(4, 8),
        th.nn.ReLU(),
        th.nn.Linear(8, 6, bias=False),
        th.nn.Tanh(),
        th.nn.Tanh(),
        th.nn.Linear(6, 2),
    )
    rows = th.randn(5, 4, requires_grad=True)
    weight = th.randn(5, 2)
    (network(rows) * weight).sum().backward()
    expected = [p.grad.clone() for p in network.parameters()]
    mlp, x = MLP(network), rows.detach().t().contiguous()
    with th.no_grad():
        by_input = mlp.backward(mlp.run(x), weight.t().contiguous(), of_input=True)
        np.testing.assert_allclose(by_input.t(), rows.grad, rtol=1e-5, atol=1e-6)
        for parameter in network.parameters():
            parameter.grad = None
        mlp.backward(mlp.run(x), weight.t().contiguous(), of_parameters=True)
    for parameter, gradient in zip(network.parameters(), expected, strict=True):
        np.testing.assert_allclose(parameter.grad, gradient, rtol=1e-5, atol=1e-6)


def test_process_wide_settings_are_put_back():
    before = th.get_float32_matmul_precision()
    th.set_num_threads(2)
    try:
        with pytest.raises(ZeroDivisionError), one_thread(), matmul_precision("medium"):
            assert th.get_num_threads() == 1 and th.get_float32_matmul_precision() == "medium"
            1 / 0  # noqa: B018
        assert th.get_num_threads() == 2 and th.get_float32_matmul_precision() == before
        # Threads that were released come back.
        with one_thread():
            pass
        product = th.randn(300, 300) @ th.eye(300)
        assert product.shape == (300, 300)
    finally:
        th.set_num_threads(1)


def test_the_update_that_is_used(capsys):
    fast = MCBSTD3("MlpPolicy", "Pendulum-v1", verbose=1, **SMALL)
    assert fast._present_update() is not None
    fast.actor.mu[0] = BatchRenorm1d(3)
    assert fast._present_update() is None
    assert "batch renormalization, which has two modes" in capsys.readouterr().out
    own = MCBSTD3("MlpPolicy", "Pendulum-v1", fast_update=False, **SMALL)
    assert own._present_update() is None
    capsys.readouterr()
    settings = {**SMALL, "policy_kwargs": dict(net_arch=[8], activation_fn=th.nn.ELU)}
    other = MCBSTD3("MlpPolicy", make_vec_env("Pendulum-v1"), verbose=1, learning_starts=10, **settings)
    assert other._present_update() is None
    other.learn(15)
    said = capsys.readouterr().out
    assert said.count("Gradient steps are SB3's own, not the fast ones: ELU is not covered") == 1
    assert other._n_updates == 5
    with pytest.raises(TypeError, match="fast_update"):
        MCBSTD3("MlpPolicy", "Pendulum-v1", fast_update="yes", **SMALL)
    with pytest.raises(ValueError, match="matmul_precision"):
        MCBSTD3("MlpPolicy", "Pendulum-v1", matmul_precision="low", **SMALL)


@pytest.mark.parametrize("low, high", [(-1.0, 1.0), (-2.0, 2.0), (-0.4, 0.4), (-0.3, 7.1), (0.0, 1e-3)])
def test_actions_are_unscaled_as_sb3_does_it_to_the_bit(low, high):
    import gymnasium as gym

    env = gym.wrappers.RescaleAction(gym.make("Pendulum-v1"), np.float32(low), np.float32(high))
    agent = MCBSTD3("MlpPolicy", env, **SMALL)
    actions = np.random.default_rng(0).uniform(-1, 1, (5000, 1)).astype(np.float32)
    found = agent.planner.unscale(actions)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, agent.policy.unscale_action(actions))
