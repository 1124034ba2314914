"""Agents whose gradient steps are captured, and SB3's to compare them with."""

from copy import deepcopy

import numpy as np
import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from sb3_mcbs.networks.crossq_update import CrossQSteps
from sb3_mcbs.networks.soft_update import SACSteps, TQCSteps
from sb3_mcbs.networks.td3_update import FastUpdate


class GraphTD3(FastUpdate):
    fast_update = True


class GraphDDPG(FastUpdate, DDPG):
    fast_update = True


class GraphCrossQ(CrossQSteps):
    fast_update = True


GRAPHED = {TD3: GraphTD3, DDPG: GraphDDPG, SAC: SACSteps, TQC: TQCSteps, CrossQ: GraphCrossQ}
#: Smooth, for a ReLU whose input is 0 but for rounding is on in one of the two and off in the other.
TANH = dict(net_arch=[16, 12], activation_fn=th.nn.Tanh)


def agent_with_steps(cls, env=None, n_steps=60, **kwargs):
    """An agent with steps in its replay buffer, whose networks are as they were made."""
    env = make_vec_env("Pendulum-v1", 1, seed=0) if env is None else env()
    settings = dict(policy_kwargs=TANH, buffer_size=200, batch_size=16, device="cpu", seed=0)
    agent = cls("MlpPolicy", env, learning_starts=n_steps, **deepcopy(settings | kwargs))
    agent.learn(n_steps)
    agent.set_logger(configure(None, []))
    return agent


def train(agent, n_steps=40) -> None:
    agent.set_random_seed(1)
    for _ in range(n_steps // 2):
        agent.train(gradient_steps=2, batch_size=16)


def assert_alike(theirs, ours, rtol=1e-3, atol=2e-5) -> None:
    expected, found = theirs.policy.state_dict(), ours.policy.state_dict()
    assert expected.keys() == found.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(found[name].cpu(), value.cpu(), rtol=rtol, atol=atol, err_msg=name)
    if getattr(theirs, "log_ent_coef", None) is not None:
        np.testing.assert_allclose(ours.log_ent_coef.item(), theirs.log_ent_coef.item(), rtol=rtol)
