"""Batches that are gathered from a copy of the replay buffer."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env

from sb3_mcbs.networks.batches import MirroredBatches


@pytest.mark.parametrize("n_envs", [1, 2])
def test_mirrored_batches_are_what_the_buffer_samples(n_envs):
    env = make_vec_env("Pendulum-v1", n_envs)
    buffer = ReplayBuffer(10 * n_envs, env.observation_space, env.action_space, n_envs=n_envs, device="cpu")
    rng, added = np.random.default_rng(0), 0

    def add(n):
        for _ in range(n):
            obs, next_obs = rng.normal(size=(2, n_envs, 3))
            ends = rng.random(n_envs) < 0.5
            infos = [{"TimeLimit.truncated": bool(rng.random() < 0.5)} for _ in range(n_envs)]
            buffer.add(obs, next_obs, rng.normal(size=(n_envs, 1)), rng.normal(size=n_envs), ends, infos)

    mirrored = MirroredBatches(buffer, 64, th.device("cpu"))
    for n in (3, 1, 0, 5, 1, 4, 10, 10, 25, -1, 2, 7):
        if n < 0:
            buffer.reset()
            n = 3
        add(n)
        added += n
        buffer.dones[buffer.pos - 1] = 1  # as where a step is left out
        mirrored.copy_rows(added)
        np.random.seed(n)
        expected = buffer.sample(64)
        np.random.seed(n)
        mirrored.draw(None)
        for name, value in expected._asdict().items():
            found = getattr(mirrored.read(), name)
            assert (found is None) == (value is None), name
            if value is not None:
                np.testing.assert_array_equal(found, value.float(), err_msg=name)


def test_a_row_is_copied_once(monkeypatch):
    env = make_vec_env("Pendulum-v1", 1)
    buffer = ReplayBuffer(100, env.observation_space, env.action_space, device="cpu")
    mirrored, copied = MirroredBatches(buffer, 4, th.device("cpu")), []
    monkeypatch.setattr(mirrored, "_copy", lambda first, end: copied.append((first, end)))
    for n in range(1, 4):
        buffer.add(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 1)), np.zeros(1), np.zeros(1), [{}])
        mirrored.copy_rows(n)
    assert copied == [(0, 1), (1, 2), (2, 3)]
