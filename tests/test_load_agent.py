"""Agents from files that nobody trusts."""

import functools
import json
import os
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from torch import nn

from sb3_mcbs import MCBSTD3, AgentFileError, SearchPolicy, load_agent
from sb3_mcbs.loading import agent_file
from tests import agent_files as files
from tests.conftest import SEARCHING, SMALL_SEARCH, assert_same_parameters

ALL = [TD3, DDPG, SAC, TQC, CrossQ, *SEARCHING]


@pytest.fixture
def saved(make_agent, tmp_path):
    """Make an agent, save it, and return both."""
    return functools.partial(files.save_agent, make_agent, tmp_path)


def load(path, env="Pendulum-v1", **kwargs):
    return load_agent(path, env, device="cpu", **kwargs)


@pytest.mark.parametrize("cls", ALL)
@pytest.mark.parametrize("activation", [None, nn.ReLU, nn.Tanh])
def test_acts_as_with_sb3s_loader(saved, cls, activation):
    kwargs = {} if activation is None else dict(activation_fn=activation)
    agent, path = saved(cls, gamma=0.97, policy_kwargs=dict(net_arch=dict(pi=[16, 8], qf=[12]), **kwargs))
    agent.learn(30)
    agent.save(path)
    loaded = load(path)
    assert type(loaded) is cls
    assert_same_parameters(loaded, cls.load(path, device="cpu"))
    files.assert_same_agent(loaded, cls.load(path, device="cpu"))
    assert loaded.actor.activation_fn is (activation or nn.ReLU)
    assert ("policy_kwargs: activation_fn" in loaded.not_taken_over) == (activation is None)


@pytest.mark.parametrize("cls", [SAC, TQC, CrossQ])
@pytest.mark.parametrize("clip_mean", [None, 0.5, 0.0])
def test_state_dependent_exploration(saved, cls, clip_mean):
    kwargs = {} if clip_mean is None else dict(clip_mean=clip_mean, use_expln=True)
    agent, path = saved(cls, use_sde=True, policy_kwargs=dict(net_arch=[16], **kwargs))
    with th.no_grad():
        for parameter in agent.policy.parameters():
            parameter.mul_(10)  # so that the mean is clipped
    agent.save(path)
    loaded, other = load(path), cls.load(path, device="cpu")
    files.assert_same_agent(loaded, other)
    assert loaded.actor.use_expln == other.actor.use_expln
    assert loaded.predict(np.ones(3, np.float32), deterministic=False)[0].shape == (1,)


@pytest.mark.parametrize(
    ("cls", "settings"),
    [
        (TD3, dict(net_arch=[])),
        (SAC, dict(net_arch=[])),
        (TD3, dict(n_critics=3)),
        (TD3, dict(n_critics=1)),
        (TQC, dict(n_critics=5, n_quantiles=7)),
        (TQC, dict(n_quantiles=3, share_features_extractor=True)),
        (CrossQ, dict(net_arch=[])),
        (CrossQ, dict(n_critics=3, net_arch=[8, 6, 4])),
        (CrossQ, dict(batch_norm=False)),
        (CrossQ, dict(batch_norm_eps=0.5, batch_norm_momentum=0.1, renorm_warmup_steps=5)),
    ],
)
def test_architecture_is_told_from_tensors(saved, cls, settings):
    _, path = saved(cls, policy_kwargs={"net_arch": [8], **settings})
    loaded = load(path, algo=cls.__name__.lower())
    assert type(loaded) is cls
    files.assert_same_agent(loaded, cls.load(path, device="cpu"))


@pytest.mark.parametrize("cls", ALL)
def test_searches(saved, cls):
    _, path = saved(cls)
    actions = []
    for which in (load, lambda path: cls.load(path, device="cpu")):
        env = make_vec_env("Pendulum-v1", 1, seed=1)
        policy = SearchPolicy(which(path), env, seed=0, **SMALL_SEARCH)
        actions.append(policy.predict(env.reset())[0])
        assert policy.last_result.simulated_steps == 9
    np.testing.assert_array_equal(*actions)


def test_search_in_the_environment_it_was_loaded_with(saved):
    _, path = saved(SAC, env="HalfCheetah-v5")
    env = make_vec_env("HalfCheetah-v5", 2, seed=0)
    agent = load(path, env)
    assert agent.get_env() is env
    policy = SearchPolicy(agent, env, seed=0, **SMALL_SEARCH)
    observation = env.reset()
    for _ in range(3):
        action, _ = policy.predict(observation)
        observation, *_ = env.step(action)
    assert policy.last_result.actions.shape == (2, 6)


def test_numbers_are_taken_over(saved):
    _, path = saved(TQC, gamma=0.9, ent_coef="auto_0.1", top_quantiles_to_drop_per_net=3)
    loaded = load(path)
    assert (loaded.gamma, loaded.ent_coef, loaded.top_quantiles_to_drop_per_net) == (0.9, "auto_0.1", 3)


@pytest.mark.parametrize("cls", SEARCHING)
def test_search_settings_are_taken_over(saved, cls):
    agent, path = saved(cls, beam_width=7, search_kwargs=dict(rollout_noise=0.03, include_policy_action=True))
    loaded = load(path)
    assert loaded.search_settings == agent.search_settings
    assert SearchPolicy(loaded, make_vec_env("Pendulum-v1", 1)).settings.beam_width == 7


def test_nothing_is_allocated_or_drawn(saved):
    _, path = saved(SAC, buffer_size=1_000_000)
    before = th.get_rng_state()
    loaded = load(path)
    assert th.equal(th.get_rng_state(), before)
    assert loaded.replay_buffer is None and loaded.ent_coef_optimizer is None
    assert not isinstance(loaded.actor.optimizer, th.optim.Optimizer)
    assert not isinstance(loaded.critic.optimizer, th.optim.Optimizer)


@pytest.mark.parametrize("cls", ALL)
def test_refuses_to_train_and_says_what_to_do(saved, cls):
    loaded = load(saved(cls)[1])
    for call in (lambda: loaded.learn(10), lambda: loaded.train(1), lambda: loaded.save("x")):
        with pytest.raises(RuntimeError, match=rf"only acts.*{cls.__name__}\.load\(path, env=env\)"):
            call()


def test_lists_what_was_not_taken_over(saved, caplog):
    _, path = saved(SAC)
    with caplog.at_level("INFO", "sb3_mcbs"):
        left = load(path).not_taken_over
    assert left["policy_class"] == left["lr_schedule"] == "a pickle, which is not opened"
    assert left["tau"] == "not needed to act"
    assert left["action_space"] == "the environment's is used"
    for name in ("actor.optimizer.pth", "critic.optimizer.pth", "pytorch_variables.pth"):
        assert left[name] == "a member that is not read"
    assert not left.keys() & {
        "gamma",
        "ent_coef",
        "use_sde",
        "policy_kwargs",
        "policy.pth",
        "data",
    }
    assert "lr_schedule" in caplog.text and not [r for r in caplog.records if r.levelname == "WARNING"]


def test_algorithm_can_be_named(saved):
    _, path = saved(TD3)
    assert type(load(path, algo="mcbs_td3")) is MCBSTD3
    assert type(load(path, algo="ddpg")) is DDPG
    with pytest.raises(AgentFileError, match=r"TD3\.zip: .*not of the algorithm 'sac'.*deterministic"):
        load(path, algo="sac")
    with pytest.raises(ValueError, match="algo must be one of"):
        load(path, algo="ppo")
    with pytest.raises(AgentFileError, match=r"not of the algorithm 'sac'.*25 output"):
        load(saved(TQC)[1], algo="sac")
    with pytest.raises(AgentFileError, match=r"not of the algorithm 'sac'.*no target networks"):
        load(saved(CrossQ)[1], algo="sac")
    with pytest.raises(AgentFileError, match=r"not of the algorithm 'mcbs_crossq'.* and target networks"):
        load(saved(SAC)[1], algo="mcbs_crossq")


def test_path_without_suffix(saved):
    _, path = saved(TD3)
    assert type(load(str(path)[:-4])) is TD3
    with pytest.raises(FileNotFoundError):
        load(path.with_name("nothing"))


# What tensors do not tell


SB3_CONSTRUCTOR = "<function TD3Policy.__init__ at 0x7f>"


class Wave(nn.Module):
    def forward(self, x):
        return th.sin(x)


def test_unknown_activation_is_asked_for(saved):
    _, path = saved(TD3, policy_kwargs=dict(net_arch=[8], activation_fn=Wave))
    with pytest.raises(ValueError, match=r"TD3\.zip: .*Wave.*Pass policy_kwargs="):
        load(path)
    loaded = load(path, policy_kwargs=dict(activation_fn=Wave, net_arch=[8]))
    files.assert_same_agent(loaded, TD3.load(path, device="cpu"))
    assert loaded.not_taken_over["policy_kwargs"] == "those of the caller are used"


@pytest.mark.parametrize(
    "entries",
    [
        dict(policy_kwargs=...),
        dict(policy_kwargs={":serialized:": "", ":type:": "<class 'dict'>"}),
        dict(policy_kwargs={":serialized:": "", ":type:": "<class 'author.Kwargs'>", "net_arch": [16]}),
        dict(policy_kwargs={"activation_fn": "<class 'torch.nn.modules.activation.Tanh'> "}),
        dict(policy_kwargs={"activation_fn": ["<class 'torch.nn.modules.activation.Tanh'>"]}),
        dict(policy_kwargs={"activation_fn": None}),
        dict(policy_kwargs={"squash": True}),
        dict(policy_class=...),
        dict(policy_class={":serialized:": "", "__module__": "author", "__init__": SB3_CONSTRUCTOR}),
        dict(policy_class={":serialized:": "", "__module__": "stable_baselines3.td3.policies"}),
    ],
)  # fmt: skip
def test_unreadable_policy_is_asked_for(saved, tmp_path, entries):
    _, path = saved(TD3)
    changed = files.with_data(path, tmp_path / "changed.zip", **entries)
    with pytest.raises(ValueError, match="Pass policy_kwargs="):
        load(changed)
    loaded = load(changed, policy_kwargs=dict(activation_fn=nn.Tanh))
    assert loaded.actor.activation_fn is nn.Tanh


def test_other_policies_are_refused_by_name(saved, make_agent, make_dict_env, tmp_path):
    _, path = saved(TD3)
    agent = make_agent(make_dict_env(), policy="MultiInputPolicy", cls=SAC)
    with pytest.raises(ValueError, match="MlpPolicy, whose observations are vectors"):
        load(path, make_dict_env())
    with pytest.raises(ValueError, match=r"needs continuous \(Box\) actions"):
        load(path, "CartPole-v1")
    state = agent.policy.state_dict() | {"actor.features_extractor.cnn.0.weight": th.zeros(3, 3)}
    with pytest.raises(AgentFileError, match=r"CnnPolicy.*load method of the SB3 algorithm"):
        load(files.with_policy(path, tmp_path / "cnn.zip", state))
    with pytest.raises(ValueError, match="without a features extractor of their own"):
        load(path, policy_kwargs=dict(features_extractor_class=Wave))
    with pytest.raises(AgentFileError, match="not those of a TD3, DDPG, SAC, TQC or CrossQ agent"):
        load(files.with_policy(path, tmp_path / "ppo.zip", {"mlp_extractor.0.weight": th.zeros(3, 3)}))


def test_other_environment_is_refused_with_both_shapes(saved):
    _, path = saved(TD3)
    with pytest.raises(AgentFileError, match=r"\(16, 3\).*\(16, 17\).*observations \(17,\).*actions \(6,\)"):
        load(path, "HalfCheetah-v5")


def test_other_action_bounds_are_warned_of(saved, caplog):
    _, path = saved(TD3)
    env = gym.wrappers.RescaleAction(gym.make("Pendulum-v1"), np.float32(-1), np.float32(1))
    load(path, env)
    assert "low=[-1.0], those of the training at [-2.0]" in caplog.text
    caplog.clear()
    load(path)
    assert not caplog.text


# Real files, where they are at hand


@pytest.mark.slow
@pytest.mark.skipif("SB3_MCBS_AGENTS" not in os.environ, reason="SB3_MCBS_AGENTS names no folder of agents")
def test_agents_of_rl_zoo():
    """Files ``sac-ENV.zip`` and ``tqc-ENV.zip``, as old as 2020, against SB3's own loader."""
    paths = sorted(Path(os.environ["SB3_MCBS_AGENTS"]).glob("*.zip"))
    assert paths
    for path in paths:
        algo, env_id = path.stem.split("-", 1)
        env = gym.make(env_id.replace("-v3", "-v4"))
        loaded = load(path, env)
        other = _load_trusted({"sac": SAC, "tqc": TQC}[algo], path, env)
        assert type(loaded) is type(other)
        assert_same_parameters(loaded, other)
        files.assert_same_agent(loaded, other, n=500)
        assert isinstance(loaded.observation_space, spaces.Box)


def _load_trusted(cls, path, env):
    """SB3's loader, with replacements for pickles that need Python 3.6 or Gym."""
    data = json.loads(files.members_of(path)["data"])
    pickled = {name for name, value in data.items() if agent_file.is_pickled(value)} - {"policy_class"}
    objects = dict.fromkeys(pickled) | dict(
        observation_space=env.observation_space, action_space=env.action_space, learning_rate=0.0,
        lr_schedule=lambda _: 0.0, train_freq=1, buffer_size=1,
    )  # fmt: skip
    objects.pop("target_entropy", None)
    if "policy_kwargs" in pickled:
        copy = data["policy_kwargs"]
        objects["policy_kwargs"] = {name: copy[name] for name in ("net_arch", "log_std_init", "use_sde")}
    return cls.load(path, device="cpu", custom_objects=objects)
