"""Networks and policies that are changed after the agent was made are searched with as they are now."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th
from stable_baselines3 import TD3
from torch import nn
from torch.nn.utils import prune

from sb3_mcbs import MCBSDDPG, MCBSSAC, MCBSTD3, MCBSTQC, SearchPolicy
from sb3_mcbs.networks.functions import STOCHASTIC, target_actor
from tests.conftest import SEARCHING, WITHOUT_SEARCH, snapshot_vec_env


def scaled_action(agent, observations):
    return agent.policy.scale_action(agent.predict(observations, deterministic=True)[0])


def other_network(agent):
    th.manual_seed(1)
    if isinstance(agent, STOCHASTIC):
        agent.actor.latent_pi = nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 16))
    else:
        agent.actor.mu = nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 1), nn.Tanh())


def first_of(agent):
    return agent.actor.latent_pi if isinstance(agent, STOCHASTIC) else agent.actor.mu


def replace_activation(network, layer):
    network[next(index for index, each in enumerate(network) if isinstance(each, nn.ReLU))] = layer


def linear_of(agent):
    return next(layer for layer in first_of(agent) if isinstance(layer, nn.Linear))


def searched_layer(layer):
    def change(agent):
        replace_activation(first_of(agent), layer())

    return change


def searched_policy(agent):
    th.manual_seed(1)
    spaces = agent.observation_space, agent.action_space
    agent.policy = agent.policy_class(*spaces, agent.lr_schedule, net_arch=[8])


def searched_actor(agent):
    th.manual_seed(1)
    agent.policy.actor = agent.policy.make_actor()


def searched_hook(agent):
    linear_of(agent).register_forward_hook(lambda module, inputs, output: -output)


def searched_method(agent):
    forward = agent.actor.forward
    agent.actor.forward = lambda *args, **kwargs: -forward(*args, **kwargs)


def searched_pruning(agent):
    prune.l1_unstructured(linear_of(agent), "weight", amount=0.9)


def searched_storage(agent):
    linear_of(agent).weight.data = -linear_of(agent).weight.data


SEARCHED = {
    "other network": other_network,
    "ELU": searched_layer(nn.ELU),
    "Tanh": searched_layer(nn.Tanh),
    "Dropout": searched_layer(lambda: nn.Dropout(0.5)),  # in training mode, as modules are made
    "other policy": searched_policy,
    "other actor": searched_actor,
    "hook": searched_hook,
    "forward": searched_method,
    "pruned": searched_pruning,
    "storage": searched_storage,
}


@pytest.mark.parametrize("change", SEARCHED)
@pytest.mark.parametrize("cls", SEARCHING)
def test_a_search_is_around_the_present_actor(make_agent, cls, change):
    plain = make_agent(cls=WITHOUT_SEARCH[cls])
    policy = SearchPolicy(
        plain, snapshot_vec_env("Pendulum-v1"), seed=0, search_kwargs=dict(include_policy_action=True)
    )
    training = make_agent(
        snapshot_vec_env("Pendulum-v1"), cls=cls, search_kwargs=dict(include_policy_action=True)
    )
    for agent, planner, vec_env in (
        (plain, policy.planner, policy.vec_env),
        (training, training.planner, training.env),
    ):
        observations = vec_env.reset()
        rng = np.random.default_rng(0)
        before = scaled_action(agent, observations)
        assert abs(planner.plan(observations, rng).candidates - before).min() < 1e-6
        SEARCHED[change](agent)
        result = planner.plan(observations, rng)
        found = abs(result.candidates - scaled_action(agent, observations)).min(axis=1)
        np.testing.assert_allclose(found, 0, atol=1e-6)
        assert abs(result.candidates - before).min() > 1e-6


def other_critic(agent):
    th.manual_seed(2)
    agent.policy.critic = agent.policy.make_critic()


def dropout_in_a_critic(agent):
    replace_activation(agent.policy.critic.q_networks[0], nn.Dropout(0.5))


def hook_of_a_critic(agent):
    agent.policy.critic.q_networks[1].register_forward_hook(lambda module, inputs, output: output - 5)


@pytest.mark.parametrize("change", [other_critic, dropout_in_a_critic, hook_of_a_critic, searched_policy])
@pytest.mark.parametrize("cls", [cls for cls in SEARCHING if cls is not MCBSDDPG])
def test_values_are_those_of_the_present_critics(make_agent, cls, change):
    agent = make_agent(cls=cls, rollout_depth=0, n_simulations=1)
    observations = agent.env.reset()
    agent.planner.plan(observations, np.random.default_rng(0))
    change(agent)
    result = agent.planner.plan(observations, np.random.default_rng(0))
    agent.policy.set_training_mode(False)
    seen = np.repeat(observations, result.candidates.shape[1], axis=0)
    with th.no_grad():
        values = agent.policy.critic(th.as_tensor(seen), th.as_tensor(result.candidates[0]))
    expected = values.mean(dim=(1, 2)) if cls is MCBSTQC else th.cat(values, 1).amin(dim=1)
    np.testing.assert_allclose(result.values[0], expected, rtol=1e-4, atol=1e-6)


def test_actions_are_unscaled_by_the_present_policy(make_agent):
    agent = make_agent(cls=TD3)
    policy = SearchPolicy(agent, snapshot_vec_env("Pendulum-v1"), seed=0, rollout_depth=1)
    observations = policy.vec_env.reset()
    policy.predict(observations)
    agent.policy.unscale_action = lambda actions: np.full_like(actions, 0.125)
    assert (policy.predict(observations)[0] == 0.125).all()
    assert (policy.planner.functions().unscale_action(np.ones((4, 1))) == 0.125).all()
    agent.policy = deepcopy(make_agent(cls=TD3).policy)
    assert (policy.predict(observations)[0] != 0.125).all()


@pytest.mark.parametrize("cls", [MCBSTD3, MCBSSAC])
def test_expanded_targets_are_those_of_the_actor_that_is_trained(make_agent, cls):
    agent = make_agent("Hopper-v5", cls=cls, value_expansion=1)
    observations = np.random.default_rng(0).standard_normal((4, 11)).astype(np.float32)
    before = target_actor(agent)(observations, np.random.default_rng(0))[0]
    th.manual_seed(3)
    name = "actor_target" if cls is MCBSTD3 else "actor"
    setattr(agent, name, agent.policy.make_actor())
    after = target_actor(agent)(observations, np.random.default_rng(0))[0]
    assert abs(after - before).min() > 1e-6
    if cls is MCBSTD3:
        with th.no_grad():
            np.testing.assert_allclose(
                after, agent.actor_target(th.as_tensor(observations)), rtol=1e-4, atol=1e-6
            )
