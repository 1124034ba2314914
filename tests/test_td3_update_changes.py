"""Networks and optimizers that are changed after the agent was made are trained as by SB3."""

import logging
from contextlib import ExitStack, contextmanager
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.td3 import td3 as td3_module
from torch import nn
from torch.nn.modules import module as torch_module
from torch.nn.utils import parametrizations, prune
from torch.optim import optimizer as torch_optimizer

from sb3_mcbs.networks.td3_update import FastUpdate
from tests.conftest import SMALL, assert_same_parameters


class FastTD3(FastUpdate):
    """TD3 with the fast gradient step and without search."""

    fast_update = True


def agent_with_steps(cls):
    """An agent whose replay buffer is full and whose networks are as they were made."""
    agent = cls("MlpPolicy", "Pendulum-v1", seed=0, learning_starts=40, **deepcopy(SMALL))
    agent.learn(40)
    agent.set_logger(configure(None, []))
    return agent


def train(agent, steps: int = 12) -> None:
    agent.set_random_seed(1)
    for _ in range(steps // 2):
        agent.train(gradient_steps=2, batch_size=32)


def is_fast(agent) -> bool:
    return agent._present_update() is not None


# What sees every call is a list that both agents must have filled alike.


def freeze(agent, calls):
    agent.actor.mu[0].weight.requires_grad_(False)
    agent.critic.qf1.requires_grad_(False)


def clip_gradients(agent, calls):
    for parameter in agent.critic.parameters():
        parameter.register_hook(lambda gradient: calls.append("clip") or gradient.clamp(-0.01, 0.01))


def clip_accumulated(agent, calls):
    def clip(parameter):
        calls.append("clip")
        parameter.grad.clamp_(-0.001, 0.001)

    for parameter in agent.actor.parameters():
        parameter.register_post_accumulate_grad_hook(clip)


def hook(register, of="actor.mu.1"):
    """Register a hook that counts its calls and, where it may, halves the output."""

    def change(agent, calls):
        def count(*args):
            calls.append(register)
            return args[-1] * 0.5 if register == "register_forward_hook" else None

        getattr(agent.policy.get_submodule(of), register)(count)

    return change


def forward_of_an_instance(agent, calls):
    critic, forward = agent.critic.qf0, agent.critic.qf0.forward
    critic.forward = lambda x: calls.append("forward") or forward(x) + 1


def method_of_an_instance(agent, calls):
    forward = agent.critic.q1_forward
    agent.critic.q1_forward = lambda *args: calls.append("q1") or forward(*args) * 2


def step_of_an_optimizer(agent, calls):
    step = agent.actor.optimizer.step
    agent.actor.optimizer.step = lambda *args: calls.append("step") or step(*args)


def zero_grad_of_an_optimizer(agent, calls):
    zero_grad = agent.critic.optimizer.zero_grad
    agent.critic.optimizer.zero_grad = lambda: calls.append("zero_grad") or zero_grad()


def hook_of_an_optimizer(register):
    return lambda agent, calls: getattr(agent.critic.optimizer, register)(lambda *args: calls.append("hook"))


def another_group(agent, calls):
    """Of a parameter whose gradient SB3 forgets."""
    calls.append(nn.Parameter(th.zeros(1)))
    calls[0].grad = th.ones(1)
    agent.actor.optimizer.add_param_group({"params": calls})


def tied(agent, calls):
    agent.critic.qf1[2] = agent.critic.qf0[2]
    agent.critic_target.qf1[2] = agent.critic_target.qf0[2]
    agent.critic.optimizer = th.optim.Adam(agent.critic.parameters())


def shared_by_actor_and_critic(agent, calls):
    agent.actor.mu[2] = agent.critic.qf0[2]
    agent.actor.optimizer = th.optim.Adam(agent.actor.parameters())


def layers(make):
    """Put another layer into the actor and its target."""

    def change(agent, calls):
        th.manual_seed(0)
        agent.actor.mu[1] = make()
        agent.actor_target.mu[1] = deepcopy(agent.actor.mu[1])
        agent.actor.optimizer = th.optim.Adam(agent.actor.parameters())

    return change


def optimizer(make):
    def change(agent, calls):
        agent.actor.optimizer = make(agent.actor.parameters())

    return change


def two_groups(parameters):
    first, *rest = parameters
    return th.optim.Adam([{"params": [first], "lr": 1e-2}, {"params": rest}])


def parameter_replaced(agent, calls):
    """SB3's optimizer goes on with the old one."""
    agent.actor.mu[0].weight = nn.Parameter(agent.actor.mu[0].weight * 2)


def fewer_critics(agent, calls):
    agent.critic.q_networks = agent.critic.q_networks[:1]


def reversed_critics(agent, calls):
    agent.critic.q_networks = agent.critic.q_networks[::-1]


def reversed_targets(agent, calls):
    agent.critic_target.q_networks = agent.critic_target.q_networks[::-1]


def other_features(agent, calls):
    class Doubling(FlattenExtractor):
        def forward(self, observations):
            return 2 * super().forward(observations)

    agent.actor.features_extractor = Doubling(agent.observation_space)


def not_contiguous(agent, calls):
    weight = agent.actor.mu[2].weight
    weight.data = th.cat([weight.data, weight.data], dim=1)[:, ::2]


def extra_parameter(of):
    """One that nothing uses, but the target's follows it."""

    def change(agent, calls):
        for network, value in (("critic", 1.0), ("critic_target", 0.0)):
            extra = nn.Parameter(th.full((3,), value))
            getattr(agent, network).get_submodule(of).register_parameter("extra", extra)

    return change


def compiled(agent, calls):
    agent.actor.mu.compile(backend="eager")


def pruned(agent, calls):
    for actor in (agent.actor, agent.actor_target):  # SB3 needs them to be alike
        prune.l1_unstructured(actor.mu[0], "weight", amount=0.5)


def weight_norm(agent, calls):
    for actor in (agent.actor, agent.actor_target):
        parametrizations.weight_norm(actor.mu[0])
    agent.actor.optimizer = th.optim.Adam(agent.actor.parameters())


LEFT_TO_SB3 = {
    "frozen": freeze,
    "hooks of parameters": clip_gradients,
    "hooks after accumulation": clip_accumulated,
    "forward hook": hook("register_forward_hook"),
    "forward hook of a target": hook("register_forward_hook", "critic_target.qf0.2"),
    "forward hook of the actor": hook("register_forward_pre_hook", "actor"),
    "forward hook where features are made": hook(
        "register_forward_pre_hook", "critic.features_extractor.flatten"
    ),
    "forward pre hook": hook("register_forward_pre_hook", "actor.mu"),
    "backward hook": hook("register_full_backward_hook", "critic.qf1.2"),
    "backward pre hook": hook("register_full_backward_pre_hook"),
    "old backward hook": hook("register_backward_hook"),
    "forward of an instance": forward_of_an_instance,
    "method of an instance": method_of_an_instance,
    "step of an optimizer": step_of_an_optimizer,
    "zero_grad of an optimizer": zero_grad_of_an_optimizer,
    "hook before an optimizer's step": hook_of_an_optimizer("register_step_pre_hook"),
    "hook after an optimizer's step": hook_of_an_optimizer("register_step_post_hook"),
    "another group": another_group,
    "tied critics": tied,
    "shared by actor and critic": shared_by_actor_and_critic,
    "ELU": layers(nn.ELU),
    "LayerNorm": layers(lambda: nn.LayerNorm(16)),
    "Dropout": layers(lambda: nn.Sequential(nn.ReLU(), nn.Dropout(0.5))),
    "learned activation": layers(nn.PReLU),
    "RMSprop": optimizer(th.optim.RMSprop),
    "SGD": optimizer(lambda parameters: th.optim.SGD(parameters, 0.1)),
    "AdamW": optimizer(th.optim.AdamW),
    "two groups": optimizer(two_groups),
    "parameter replaced": parameter_replaced,
    "fewer critics": fewer_critics,
    "reversed critics": reversed_critics,
    "reversed targets": reversed_targets,
    "other features": other_features,
    "not contiguous": not_contiguous,
    "extra parameter of a layer": extra_parameter("qf0.0"),
    "extra parameter of an activation": extra_parameter("qf0.1"),
    "extra parameter of features": extra_parameter("features_extractor"),
    "extra parameter of a critic": extra_parameter(""),
    "compiled": compiled,
    "pruned": pruned,
    "weight_norm": weight_norm,
}


def other_layer(agent, calls):
    layers(nn.Tanh)(agent, calls)
    for actor in (agent.actor, agent.actor_target):
        th.manual_seed(1)
        actor.mu[2] = nn.Linear(16, 16, bias=False)
    agent.actor.optimizer = th.optim.Adam(agent.actor.parameters(), lr=1e-2)


def other_sequential(agent, calls):
    th.manual_seed(0)
    for actor in (agent.actor, agent.actor_target):
        actor.mu = nn.Sequential(nn.Linear(3, 8), nn.Sequential(nn.ReLU(), nn.Linear(8, 1)), nn.Tanh())
    agent.actor.optimizer = th.optim.Adam(agent.actor.parameters())


def other_actor(agent, calls):
    """What is trained is the agent's; its policy keeps the old one."""
    th.manual_seed(0)
    agent.actor = agent.policy.make_actor()
    agent.actor.optimizer = th.optim.Adam(agent.actor.parameters())


def other_policy(agent, calls):
    """The agent goes on with the networks of the old one, as SB3's does."""
    agent.policy = deepcopy(agent.policy)


def other_critic_target(agent, calls):
    th.manual_seed(0)
    agent.critic_target = agent.policy.make_critic()


def other_storage(agent, calls):
    for parameter in agent.critic.parameters():
        parameter.data = parameter.data * 0.5


def other_group(agent, calls):
    agent.actor.optimizer.param_groups[0].update(weight_decay=0.1, betas=(0.5, 0.9), amsgrad=True, eps=1e-5)
    agent.critic.optimizer.param_groups[0].update(maximize=True)


def other_settings(agent, calls):
    agent.tau, agent.gamma, agent.policy_delay = 0.5, 0.5, 1
    agent.target_policy_noise, agent.target_noise_clip = 0.1, 0.05
    agent.lr_schedule = lambda remaining: 1e-2


def other_parameters(agent, calls):
    parameters = agent.get_parameters()
    for name, value in parameters["policy"].items():
        parameters["policy"][name] = value * 0.5
    agent.set_parameters(parameters)


STILL_FAST = {
    "other layer": other_layer,
    "other Sequential": other_sequential,
    "other actor": other_actor,
    "other policy": other_policy,
    "other target": other_critic_target,
    "other storage": other_storage,
    "other group": other_group,
    "other settings": other_settings,
    "other parameters": other_parameters,
    "target is frozen": lambda agent, calls: agent.critic_target.requires_grad_(False),
}


@pytest.mark.parametrize("change", [*LEFT_TO_SB3, *STILL_FAST])
def test_a_changed_agent_is_trained_as_by_sb3(change):
    agents, calls = [agent_with_steps(cls) for cls in (TD3, FastTD3)], ([], [])
    for agent, its_calls in zip(agents, calls, strict=True):
        train(agent, 0)
        {**LEFT_TO_SB3, **STILL_FAST}[change](agent, its_calls)
        train(agent)
    theirs, ours = agents
    assert is_fast(ours) == (change in STILL_FAST)
    assert calls[0] == calls[1]
    for name in ("actor", "actor_target", "critic", "critic_target"):
        expected, found = getattr(theirs, name).state_dict(), getattr(ours, name).state_dict()
        assert expected.keys() == found.keys()
        for key, value in expected.items():
            tolerance = dict(rtol=2e-3, atol=2e-5) if change in STILL_FAST else dict(rtol=0, atol=0)
            np.testing.assert_allclose(found[key], value, **tolerance, err_msg=f"{name}.{key}")


@contextmanager
def replaced(cls, name):
    method = getattr(cls, name)

    def other(self, *args, **kwargs):
        return method(self, *args, **kwargs) * 0.5

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cls, name, other)
        yield


EVERYWHERE = {
    "forward hook": lambda: torch_module.register_module_forward_hook(lambda *args: args[-1]),
    "forward pre hook": lambda: torch_module.register_module_forward_pre_hook(lambda *args: None),
    "backward hook": lambda: torch_module.register_module_full_backward_hook(lambda *args: None),
    "backward pre hook": lambda: torch_module.register_module_full_backward_pre_hook(lambda *args: None),
    "optimizer's pre hook": lambda: torch_optimizer.register_optimizer_step_pre_hook(lambda *args: None),
    "optimizer's post hook": lambda: torch_optimizer.register_optimizer_step_post_hook(lambda *args: None),
    "forward of a class": lambda: replaced(nn.ReLU, "forward"),
    "method of a class": lambda: replaced(FlattenExtractor, "forward"),
    "autocast": lambda: th.autocast("cpu", dtype=th.bfloat16),
    "anomalies": lambda: th.autograd.set_detect_anomaly(True),
}


@pytest.mark.parametrize("what", EVERYWHERE)
def test_what_is_done_to_all_networks_is_left_to_sb3_while_it_lasts(what):
    agents = [agent_with_steps(cls) for cls in (TD3, FastTD3)]
    for agent in agents:
        with ExitStack() as stack:
            stack.enter_context(EVERYWHERE[what]())
            train(agent)
            assert not isinstance(agent, FastTD3) or not is_fast(agent)
    assert_same_parameters(*agents)
    assert is_fast(agents[1])


def test_the_fast_step_is_taken_again_and_the_reason_was_said_once(caplog, capsys):
    agent = agent_with_steps(FastTD3)
    agent.verbose = 1
    caplog.set_level(logging.INFO, "sb3_mcbs")
    for _ in range(2):
        agent.actor.requires_grad_(False)
        train(agent)
        assert not is_fast(agent)
        agent.actor.requires_grad_(True)
        assert is_fast(agent)
        handle = agent.critic.qf0.register_forward_hook(lambda *args: None)
        train(agent)
        handle.remove()
        train(agent)
        assert is_fast(agent)
    said = capsys.readouterr().out
    for reason in ("parameters are frozen", "a Sequential has hooks"):
        message = f"Gradient steps are SB3's own, not the fast ones: {reason}"
        assert said.count(message) == 1 and caplog.text.count(message) == 1
    agent.fast_update = False
    train(agent)
    assert "Gradient steps" not in capsys.readouterr().out
    agent.fast_update = "sometimes"
    with pytest.raises(TypeError, match="fast_update must be True or False, got 'sometimes'"):
        train(agent)


class OtherTrain(TD3):
    def train(self, gradient_steps, batch_size=100):
        self.trained = True


class FastOtherTrain(FastTD3, OtherTrain):
    pass


def test_the_train_of_another_base_class_is_called():
    agent = agent_with_steps(FastOtherTrain)
    train(agent)
    assert agent.trained


def test_what_sb3_cannot_train_fails_alike():
    for cls in (TD3, FastTD3):
        agent = agent_with_steps(cls)
        agent.critic.requires_grad_(False)
        with pytest.raises(RuntimeError, match="does not require grad"):
            train(agent)


@pytest.mark.parametrize(("owner", "name"), [(th.nn.functional, "mse_loss"), (td3_module, "polyak_update")])
def test_functions_that_sb3_trains_with_are_called(monkeypatch, owner, name):
    calls, function = [], getattr(owner, name)
    monkeypatch.setattr(owner, name, lambda *args, **kwargs: calls.append(name) or function(*args, **kwargs))
    agent = agent_with_steps(FastTD3)
    train(agent)
    assert calls
