"""Normalisation statistics as npz."""

import io
import pickle
import sys
import zipfile

import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs import AgentFileError, SearchPolicy, cli, load_agent, load_statistics, save_statistics
from sb3_mcbs.zoo.convert_statistics import convert_statistics
from tests.agent_files import Payload, write
from tests.conftest import SMALL_SEARCH


@pytest.fixture
def normalizer():
    env = VecNormalize(make_vec_env("Pendulum-v1", 2, seed=0), clip_obs=5.0, gamma=0.9, epsilon=1e-6)
    env.reset()
    for _ in range(20):
        env.step(np.ones((2, 1), np.float32))
    return env


def assert_same_normalisation(left: VecNormalize, right: VecNormalize) -> None:
    observations = np.random.default_rng(0).normal(size=(50, 3), scale=20).astype(np.float32)
    rewards = np.linspace(-20, 5, 30)
    np.testing.assert_array_equal(left.normalize_obs(observations), right.normalize_obs(observations))
    np.testing.assert_array_equal(left.normalize_reward(rewards), right.normalize_reward(rewards))
    for name in ("norm_obs", "norm_reward", "clip_obs", "clip_reward", "gamma", "epsilon"):
        assert getattr(left, name) == getattr(right, name)
    for kind in ("obs_rms", "ret_rms") if left.norm_obs else ("ret_rms",):
        assert getattr(left, kind).count == getattr(right, kind).count


def arrays_of(path) -> dict[str, np.ndarray]:
    with np.load(path) as arrays:
        return dict(arrays)


def test_round_trip(normalizer, tmp_path):
    path = tmp_path / "statistics.numbers"
    save_statistics(normalizer, path)
    loaded = load_statistics(path, make_vec_env("Pendulum-v1", 1))
    assert_same_normalisation(loaded, normalizer)
    mean = loaded.obs_rms.mean.copy()
    loaded.reset()
    np.testing.assert_array_equal(loaded.obs_rms.mean, mean)  # the statistics stay as they are
    assert load_statistics(path, make_vec_env("Pendulum-v1", 1), training=True).training


def test_rewards_only(tmp_path):
    env = VecNormalize(make_vec_env("Pendulum-v1", 1), norm_obs=False)
    save_statistics(env, tmp_path / "s.npz")
    loaded = load_statistics(tmp_path / "s.npz", make_vec_env("Pendulum-v1", 1))
    assert_same_normalisation(loaded, env)


def test_agent_with_statistics(make_agent, normalizer, tmp_path):
    agent = make_agent(normalizer, cls=SAC).learn(60)
    agent.save(tmp_path / "agent")
    save_statistics(normalizer, tmp_path / "s.npz")
    actions = []
    for loads in (True, False):
        env = make_vec_env("Pendulum-v1", 1, seed=3)
        if loads:
            env = load_statistics(tmp_path / "s.npz", env)
            model = load_agent(tmp_path / "agent", env, device="cpu")
        else:
            normalizer.save(tmp_path / "s.pkl")
            env = VecNormalize.load(tmp_path / "s.pkl", env)
            env.training = False
            model = SAC.load(tmp_path / "agent", env, device="cpu")
        policy = SearchPolicy(model, env, seed=0, **SMALL_SEARCH)
        env.seed(5)  # SB3's loader has seeded the environment
        actions.append(policy.predict(env.reset())[0])
        assert policy.planner.source.view.reward_normalizer is env
    np.testing.assert_array_equal(*actions)


def test_conversion_needs_trust(normalizer, tmp_path, monkeypatch, capsys):
    pickled, target = tmp_path / "vecnormalize.pkl", tmp_path / "statistics.npz"
    flag = tmp_path / "flag"
    pickled.write_bytes(pickle.dumps(Payload(flag)))
    with pytest.raises(PermissionError, match="runs whatever code its author put in"):
        convert_statistics(pickled, target)
    arguments = ["sb3-mcbs", "convert-statistics", str(pickled), str(target)]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    assert "--trusted" in capsys.readouterr().err
    assert not flag.exists() and not target.exists()
    with pytest.raises(ValueError, match="has no VecNormalize in it"):
        convert_statistics(pickled, target, trusted=True)
    assert flag.exists(), "the test's payload has to run where it is trusted"
    flag.unlink()
    normalizer.save(pickled)
    monkeypatch.setattr(sys, "argv", [*arguments, "--trusted"])
    cli.main()
    assert_same_normalisation(load_statistics(target, make_vec_env("Pendulum-v1", 1)), normalizer)


def test_a_pickle_is_not_statistics(normalizer, tmp_path):
    flag, path = tmp_path / "flag", tmp_path / "s.npz"
    venv = make_vec_env("Pendulum-v1", 1)
    path.write_bytes(pickle.dumps(Payload(flag)))
    with pytest.raises(AgentFileError, match=r"s\.npz: the zip file cannot be read"):
        load_statistics(path, venv)
    save_statistics(normalizer, path)
    arrays = arrays_of(path) | {"obs_mean": np.array([Payload(flag)])}
    np.savez(path, **arrays)
    with pytest.raises(AgentFileError, match=r"'obs_mean\.npy' cannot be read"):
        load_statistics(path, venv)
    assert not flag.exists()
    with np.load(path, allow_pickle=True) as opened:
        opened["obs_mean"]
    assert flag.exists()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("obs_mean", np.zeros(4), r"obs_mean must have the shape \(3,\)"),
        ("obs_mean", np.array([0, np.nan, 0]), "must be finite"),
        ("obs_mean", np.zeros(3, complex), "real values"),
        ("obs_var", np.array([1.0, 0.0, 1.0]), "above 0"),
        ("ret_var", np.float64(-1), "above 0"),
        ("ret_count", np.float64(0), "above 0"),
        ("clip_obs", np.float64(0), "clip_obs must be above 0"),
        ("clip_reward", np.float64(np.nan), "clip_reward must be above 0"),
        ("gamma", np.float64(1.5), "at most 1.0"),
        ("epsilon", np.float64(np.inf), "epsilon must be"),
        ("norm_obs", np.float64(1), "norm_obs must have"),
        ("gamma", None, "has no array 'gamma'"),
        ("obs_count", None, "has no array 'obs_count'"),
    ],
)
def test_values_are_checked(normalizer, tmp_path, name, value, message):
    path = tmp_path / "s.npz"
    save_statistics(normalizer, path)
    arrays = arrays_of(path) | {name: value}
    np.savez(path, **{key: array for key, array in arrays.items() if array is not None})
    with pytest.raises(AgentFileError, match=message):
        load_statistics(path, make_vec_env("Pendulum-v1", 1))


def test_bombs_and_other_environments(normalizer, tmp_path):
    path = tmp_path / "s.npz"
    save_statistics(normalizer, path)
    with pytest.raises(AgentFileError, match=r"shape \(17,\), as the environment needs"):
        load_statistics(path, make_vec_env("HalfCheetah-v5", 1))
    header = io.BytesIO()
    claim = {"descr": "<f8", "fortran_order": False, "shape": (10**9, 10**9)}
    np.lib.format.write_array_header_1_0(header, claim)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    write(path, members | {"obs_mean.npy": header.getvalue()})
    with pytest.raises(AgentFileError, match=r"'obs_mean\.npy' cannot be read"):
        load_statistics(path, make_vec_env("Pendulum-v1", 1))
    write(path, members | {"obs_mean.npy": bytes(2**26 + 1)}, zipfile.ZIP_DEFLATED)
    with pytest.raises(AgentFileError, match=r"'obs_mean\.npy' has more than"):
        load_statistics(path, make_vec_env("Pendulum-v1", 1))


def test_several_inputs_are_refused(make_dict_env, tmp_path):
    with pytest.raises(TypeError, match="Dict observations"):
        save_statistics(VecNormalize(make_vec_env(make_dict_env, 1)), tmp_path / "s.npz")
