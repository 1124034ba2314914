"""The gradient step against SB3's own."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs.networks.td3_update import TD3Update


def trained_pair(steps=200, env=None, cls=TD3, **kwargs):
    """Two agents from one seed and buffer, after SB3's updates and after ours."""
    agents = []
    for _ in range(2):
        agent = cls(
            "MlpPolicy",
            make_vec_env("HalfCheetah-v5", 1, seed=0) if env is None else env(),
            seed=3,
            device="cpu",
            buffer_size=1000,
            learning_starts=300,
            batch_size=64,
            **{"policy_kwargs": dict(net_arch=[64, 48])} | kwargs,
        )
        agent.learn(300)
        agents.append(agent)
    theirs, ours = agents
    update = TD3Update(ours)
    for agent, train in ((theirs, TD3.train.__get__(theirs)), (ours, update.train)):
        agent.set_logger(configure(None, []))
        agent.set_random_seed(5)
        for _ in range(steps // 4):
            train(gradient_steps=4, batch_size=64)
    return theirs, ours


CASES = {
    "as TD3 is": {},
    # Smooth, see below: with what MuJoCo 3.17 computes a ReLU is on in one of the two and off in the other.
    "one critic": dict(policy_kwargs=dict(net_arch=[64, 48], n_critics=1, activation_fn=th.nn.Tanh)),
    "three critics": dict(policy_kwargs=dict(net_arch=[64, 48], n_critics=3)),
    "tanh": dict(policy_kwargs=dict(net_arch=dict(pi=[32], qf=[48, 40, 32]), activation_fn=th.nn.Tanh)),
    "no hidden layer": dict(policy_kwargs=dict(net_arch=[])),
    "policy delay 3": dict(policy_delay=3),
    "n-step": dict(n_steps=3),
    "no smoothing": dict(target_policy_noise=1e-8),
    "weight decay": dict(
        policy_kwargs=dict(net_arch=[32], optimizer_kwargs=dict(weight_decay=0.1, amsgrad=True))
    ),
    "learning rate schedule": dict(learning_rate=lambda remaining: 1e-3 * (0.5 + 0.5 * remaining)),
    # Smooth, for a ReLU whose input is 0 but for rounding is on in one of the two and off in the other.
    "normalised": dict(
        env=lambda: VecNormalize(make_vec_env("HalfCheetah-v5", 1, seed=0)),
        policy_kwargs=dict(net_arch=[64, 48], activation_fn=th.nn.Tanh),
    ),
    "DDPG": dict(cls=DDPG),
    "matrix observations": dict(env=lambda: make_vec_env(_matrix_env, 1, seed=0)),
}


def _matrix_env():
    return gym.wrappers.FrameStackObservation(gym.make("Pendulum-v1"), 2)


@pytest.mark.parametrize("case", CASES)
def test_same_networks_as_sb3_after_200_updates(case):
    theirs, ours = trained_pair(**CASES[case])
    assert theirs._n_updates == ours._n_updates == 200
    before = type(theirs)(
        "MlpPolicy", theirs.get_env(), seed=3, device="cpu", policy_kwargs=theirs.policy_kwargs
    )
    for name, expected in theirs.policy.state_dict().items():
        found, start = ours.policy.state_dict()[name], before.policy.state_dict()[name]
        np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-4, err_msg=name)
        if "target" not in name:
            assert (expected - start).abs().max() > 20 * (expected - found).abs().max(), name
    for key in ("train/critic_loss", "train/actor_loss", "train/learning_rate", "train/n_updates"):
        if key in theirs.logger.name_to_value:
            assert ours.logger.name_to_value[key] == pytest.approx(theirs.logger.name_to_value[key], rel=1e-2)
    assert ours.logger.name_to_value.keys() == theirs.logger.name_to_value.keys()


def test_the_optimizer_goes_on_with_sb3s_own_update(tmp_path):
    _, ours = trained_pair(8)
    for optimizer in (ours.actor.optimizer, ours.critic.optimizer):
        assert optimizer.param_groups[0]["fused"] is None
    ours.save(tmp_path / "agent")
    env = ours.get_env()
    loaded = TD3.load(tmp_path / "agent", env, device="cpu")
    state = next(iter(loaded.critic.optimizer.state.values()))
    assert float(state["step"]) == 8
    loaded.learn(400, reset_num_timesteps=True)
    assert loaded._n_updates > 8
