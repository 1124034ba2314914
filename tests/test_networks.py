"""Networks as functions on arrays, against SB3's own calls of them."""

from types import MappingProxyType

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC
from sb3_contrib.tqc import tqc
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from sb3_mcbs import MCBSTD3, SearchPolicy
from sb3_mcbs.networks.functions import entropy_function, policy_function, value_function
from sb3_mcbs.networks.mlp import MLP
from sb3_mcbs.networks.plain_networks import actor_mlp
from sb3_mcbs.networks.torch_settings import matmul_precision, one_thread
from tests.conftest import SEARCHING, SMALL, WITHOUT_SEARCH


def agent_of(cls, settings=MappingProxyType({}), **policy_kwargs):
    return cls(
        "MlpPolicy",
        "HalfCheetah-v5",
        seed=0,
        **{**SMALL, "policy_kwargs": dict(net_arch=[16, 12]) | policy_kwargs, **settings},
    )


def sb3_action(agent, observations):
    return agent.policy.scale_action(agent.predict(observations, deterministic=True)[0])


def sb3_value(agent, observations, actions):
    with th.no_grad():
        values = agent.critic(th.as_tensor(observations), th.as_tensor(actions))
        if isinstance(agent, TQC):
            return values.mean(dim=(1, 2)).numpy()
        return np.min([value[:, 0].numpy() for value in values], axis=0)


KINDS = [
    (TD3, {}),
    (TD3, dict(n_critics=3, activation_fn=th.nn.Tanh)),
    (TD3, dict(activation_fn=th.nn.ELU)),  # not covered by MLP: SB3's own call
    (DDPG, {}),
    (SAC, {}),
    (SAC, dict(use_sde=True)),
    (TQC, {}),
]


@pytest.mark.parametrize("cls, policy_kwargs", KINDS)
@pytest.mark.parametrize("rows", [1, 7])
def test_same_numbers_as_sb3(cls, policy_kwargs, rows):
    agent = agent_of(cls, **policy_kwargs)
    rng = np.random.default_rng(0)
    observations, actions = rng.standard_normal((rows, 17)), rng.uniform(-1, 1, (rows, 6)).astype(np.float32)
    found = policy_function(agent)(observations)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, sb3_action(agent, observations), rtol=1e-5, atol=1e-6)
    found = value_function(agent)(observations, actions)
    np.testing.assert_allclose(found, sb3_value(agent, observations, actions), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("activation_fn", [th.nn.ReLU, th.nn.ELU], ids=["plain", "sb3's own call"])
@pytest.mark.parametrize("n_dropped", [0, 2, 24])
def test_truncated_value_is_the_target_of_sb3_contribs_gradient_step(monkeypatch, activation_fn, n_dropped):
    agent = agent_of(TQC, n_critics=3, activation_fn=activation_fn)
    agent.top_quantiles_to_drop_per_net = n_dropped
    agent.gamma, agent.ent_coef_optimizer, agent.ent_coef_tensor = 0.5, None, th.tensor(0.0)
    agent.set_logger(configure(format_strings=[]))
    rng = np.random.default_rng(0)
    observation = rng.standard_normal(17)
    for _ in range(20):
        agent.replay_buffer.add(
            observation, observation, np.zeros((1, 6)), np.array([0.0]), np.zeros(1), [{}]
        )
    next_action = rng.uniform(-1, 1, (1, 6)).astype(np.float32)
    expected = value_function(agent, "truncated")(observation[None], next_action)
    mean = value_function(agent, "mean")(observation[None], next_action)
    targets = []
    loss = tqc.quantile_huber_loss

    def spy(current, target, **kwargs):
        targets.append(target.mean(dim=(1, 2)).numpy())
        return loss(current, target, **kwargs)

    action_log_prob = agent.actor.action_log_prob
    monkeypatch.setattr(tqc, "quantile_huber_loss", spy)
    monkeypatch.setattr(
        agent.actor,
        "action_log_prob",
        lambda observations: (
            th.as_tensor(np.repeat(next_action, len(observations), axis=0)),
            action_log_prob(observations)[1],
        ),
    )
    agent.train(1, 4)
    np.testing.assert_allclose(targets[0], np.repeat(0.5 * expected, 4), rtol=1e-5, atol=1e-6)
    assert (abs(expected - mean) < 1e-6) == (n_dropped == 0)


SOFT_KINDS = [
    *((cls, dict(ent_coef=ent_coef), {}) for cls in (SAC, TQC) for ent_coef in (0.3, "auto_0.3")),
    *((cls, dict(ent_coef=0.3, use_sde=True), dict(log_std_init=-1.0)) for cls in (SAC, TQC)),
]


@pytest.mark.parametrize("cls, settings, policy_kwargs", SOFT_KINDS)
def test_entropies_are_those_of_the_agents_own_draws(cls, settings, policy_kwargs):
    agent = agent_of(cls, settings, **policy_kwargs)
    observations = np.random.default_rng(0).standard_normal((50, 17))
    with th.no_grad():
        actions, log_prob = agent.actor.action_log_prob(th.as_tensor(observations))
    found = entropy_function(agent)(observations, actions.numpy())
    np.testing.assert_allclose(found, -0.3 * log_prob.numpy(), rtol=1e-3, atol=1e-3)
    if agent.log_ent_coef is not None:
        agent.log_ent_coef.data += np.log(2)
        np.testing.assert_allclose(
            entropy_function(agent)(observations, actions.numpy()), 2 * found, rtol=1e-5
        )


@pytest.mark.parametrize("cls", [SAC, TQC])
def test_the_entropy_of_a_saturated_actors_own_action_is_exact(cls):
    """Its action is 1 to the last bit, and the inverse of tanh would take it for that of 8.3."""
    agent = agent_of(cls, dict(ent_coef=1.0))
    with th.no_grad():
        agent.actor.mu.bias += 12
    observations = np.random.default_rng(0).standard_normal((5, 17))
    actions = policy_function(agent)(observations)
    assert (actions == 1).all()
    with th.no_grad():
        mean, log_std, _ = agent.actor.get_action_dist_params(th.as_tensor(observations))
        distribution = agent.actor.action_dist.proba_distribution(mean, log_std)
        expected = -distribution.log_prob(th.as_tensor(actions), mean).numpy()
    np.testing.assert_allclose(entropy_function(agent)(observations, actions), expected, rtol=1e-5)
    assert (abs(expected + distribution.log_prob(th.as_tensor(actions)).numpy()) > 1).all()


@pytest.mark.parametrize("cls", SEARCHING)
def test_values_that_an_agent_does_not_have_are_refused(make_agent, cls):
    plain = make_agent(cls=WITHOUT_SEARCH[cls])
    for settings, fits, words in (
        (dict(entropy_bonus=True), (SAC, TQC), "entropy_bonus=True is for SAC and TQC"),
        (dict(tqc_value="truncated"), TQC, "tqc_value='truncated' is for TQC"),
    ):
        for make in (
            lambda settings=settings: make_agent(cls=cls, **settings),
            lambda settings=settings: SearchPolicy(plain, plain.get_env(), **settings),
        ):
            if issubclass(cls, fits):
                make()
            else:
                with pytest.raises(ValueError, match=words):
                    make()


def test_truncated_values_need_a_quantile():
    agent = agent_of(TQC, dict(top_quantiles_to_drop_per_net=25))
    with pytest.raises(ValueError, match=r"top_quantiles_to_drop_per_net from 0 to below .* 25; got 25"):
        SearchPolicy(agent, agent.get_env(), tqc_value="truncated")


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
        th.nn.Linear(4, 8), th.nn.ReLU(), th.nn.Linear(8, 6, bias=False), th.nn.Tanh(), th.nn.Linear(6, 2)
    )
    rows = th.randn(5, 4, requires_grad=True)
    weight = th.randn(5, 2)
    (network(rows) * weight).sum().backward()
    expected = [p.grad.clone() for p in network.parameters()]
    mlp, x = MLP(network), rows.detach().t().contiguous()
    with th.no_grad():
        outputs = mlp.outputs(x)
        by_input = mlp.backward(x, outputs, weight.t().contiguous(), of_parameters=False)
        np.testing.assert_allclose(by_input.t(), rows.grad, rtol=1e-5, atol=1e-6)
        for parameter in network.parameters():
            parameter.grad = None
        mlp.backward(x, mlp.outputs(x), weight.t().contiguous(), of_parameters=True)
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
    found = agent._searcher.unscale(actions)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, agent.policy.unscale_action(actions))
