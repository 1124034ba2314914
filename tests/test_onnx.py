"""Exported networks compute what the agent's do."""

import os
import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_mcbs import cli, save_statistics
from sb3_mcbs.networks.functions import value_function
from sb3_mcbs.sharing import export_onnx

onnxruntime = pytest.importorskip("onnxruntime", reason="needs ONNX Runtime: pip install 'sb3-mcbs[onnx]'")
EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "onnx_search.py"


def make_agent(cls: type, env: VecEnv, **policy_kwargs):
    agent = cls(
        "MlpPolicy",
        env,
        buffer_size=10,
        device="cpu",
        seed=0,
        policy_kwargs=dict(net_arch=[32, 32], **policy_kwargs),
    )
    with th.no_grad():
        for buffer in agent.policy.buffers():  # batch renormalization that does something
            if buffer.dtype == th.float32:
                buffer.uniform_(0.5, 1.5)
    return agent


def assert_same(path: Path, agent, env: VecEnv, seed: int = 0) -> None:
    space = env.observation_space
    raw = np.random.default_rng(seed).normal(scale=3, size=(7, *space.shape)).astype(np.float32)
    seen = env.normalize_obs(raw) if isinstance(env, VecNormalize) else raw
    actor = onnxruntime.InferenceSession(path)
    critics = onnxruntime.InferenceSession(path.with_name(f"{path.stem}-critics.onnx"))
    (actions,) = actor.run(["action"], {"observation": raw})
    np.testing.assert_allclose(actions, agent.predict(seen, deterministic=True)[0], atol=1e-5)
    random = np.array([env.action_space.sample() for _ in raw])
    value, values = critics.run(["value", "values"], {"observation": raw, "action": random})
    scaled = agent.policy.scale_action(random)
    np.testing.assert_allclose(value, value_function(agent)(seen, scaled), atol=1e-5)
    assert values.shape == (7, 2)
    one = actor.run(["action"], {"observation": raw[:1]})[0]
    np.testing.assert_allclose(one, actions[:1], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cls", "policy_kwargs"),
    [(TD3, {}), (TD3, {"activation_fn": th.nn.ELU}), (TQC, {}), (CrossQ, {})],
    ids=["TD3", "TD3 with ELU", "TQC", "CrossQ"],
)
def test_outputs_are_the_agents(cls: type, policy_kwargs: dict, tmp_path: Path) -> None:
    env = make_vec_env("HalfCheetah-v5")
    agent = make_agent(cls, env, **policy_kwargs)
    agent.policy.set_training_mode(True)
    path, _ = export_onnx(agent, tmp_path / "policy.onnx")
    assert all(module.training for module in agent.policy.actor.modules())
    agent.policy.set_training_mode(False)
    assert_same(path, agent, env)


def test_the_command_exports_a_normalized_agent_without_opening_pickles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gym.register("Narrow-v0", lambda: gym.wrappers.RescaleAction(gym.make("Pendulum-v1"), -0.5, 3.0))
    try:
        env = VecNormalize(make_vec_env("Narrow-v0"), clip_obs=1.5)
        env.obs_rms.mean[:], env.obs_rms.var[:], env.ret_rms.var = (
            [0.1, -2.0, 1.0],
            [0.3, 4.0, 2.0],
            np.float64(9.0),
        )
        agent = make_agent(SAC, env)
        agent.save(tmp_path / "agent.zip")
        save_statistics(env, tmp_path / "statistics.npz")
        path = tmp_path / "policy.onnx"
        words = ["export", str(tmp_path / "agent.zip"), "--env", "Narrow-v0", "-o", str(path)]
        monkeypatch.setattr(sys, "argv", ["sb3-mcbs", *words])
        cli.main()
    finally:
        del gym.registry["Narrow-v0"]
    assert_same(path, agent, env)
    about = onnxruntime.InferenceSession(path).get_modelmeta().custom_metadata_map
    assert about["algorithm"] == "SAC" and float(about["gamma"]) == 0.99
    assert float(about["reward_scale"]) == pytest.approx(1 / 3)


def test_observations_in_dictionaries_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    env = gym.wrappers.TransformObservation(
        gym.make("Pendulum-v1"), lambda x: {"x": x}, gym.spaces.Dict({"x": gym.spaces.Box(-9, 9, (3,))})
    )
    agent = TD3("MultiInputPolicy", env, buffer_size=10)
    with pytest.raises(ValueError, match="observations that are a Box"):
        export_onnx(agent, tmp_path / "policy.onnx")


@pytest.mark.slow
def test_the_example_searches_without_torch(tmp_path: Path) -> None:
    agent = make_agent(TD3, make_vec_env("HalfCheetah-v5"))
    export_onnx(agent, tmp_path / "policy.onnx")
    xml = Path(gym.__file__).parent / "envs" / "mujoco" / "assets" / "half_cheetah.xml"
    code = (
        "import runpy, sys; sys.argv = sys.argv[1:]; names = runpy.run_path(sys.argv[0])\n"
        "assert not {'torch', 'stable_baselines3', 'sb3_mcbs', 'gymnasium'} & set(sys.modules)\n"
        "import gymnasium, numpy as np\n"
        "env = gymnasium.make('HalfCheetah-v5', reset_noise_scale=0.0)\n"
        "env.reset(seed=0)\n"
        "data = names['mujoco'].MjData(names['model'])\n"
        "for action in np.random.default_rng(0).uniform(-1, 1, (20, 6)):\n"
        "    observation, reward, *_ = env.step(action)\n"
        "    assert np.isclose(names['step'](data, action), reward)\n"
        "    assert np.allclose(names['observe'](data)[0], observation, atol=1e-5)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, EXAMPLE, "policy.onnx", xml, "20"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "SB3_MCBS_NO_ZOO_HOOK": "1"},
    )
    assert done.returncode == 0, done.stderr
    assert re.match(r"return -?[\d.]+ in 20 steps", done.stdout)
