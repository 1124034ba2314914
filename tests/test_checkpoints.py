"""A run that is lost and resumed ends bit-identical to one that never stopped."""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import DDPG, SAC, TD3, HerReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack, VecMonitor, VecNormalize

from sb3_mcbs import (
    MCBS,
    MCBSDDPG,
    MCBSSAC,
    MCBSTD3,
    MCBSTQC,
    ExactCheckpointCallback,
    MCBSCrossQ,
    SnapshotEnvWrapper,
    resume,
)
from sb3_mcbs.checkpoints import CheckpointError
from sb3_mcbs.checkpoints.settings import check_settings, describe_agent
from tests.checkpoint_helpers import Crash, assert_resumed_is_exact, assert_same_runs, crash, learn
from tests.conftest import SEARCHING

SMALL = dict(learning_starts=20, batch_size=16, seed=0, device="cpu")
SEARCH = dict(beam_width=3, rollout_depth=2, n_simulations=2, model_kwargs=dict(n_threads=1))


def maker(cls, env_id="Pendulum-v1", n_envs=1, vec_env_cls=None, wrap=lambda vec_env: vec_env, **settings):
    """How to make an agent in a folder."""
    search = SEARCH if issubclass(cls, MCBS) else {}
    kwargs = {"policy_kwargs": dict(net_arch=[16, 16]), "buffer_size": 90, **SMALL, **search, **settings}
    policy = kwargs.pop("policy", "MlpPolicy")

    def make(folder: Path):
        return cls(policy, wrap(make_env(folder, env_id, n_envs, vec_env_cls)), **kwargs)

    return make


def make_env(folder: Path, env_id="Pendulum-v1", n_envs=1, vec_env_cls=None):
    return make_vec_env(
        env_id,
        n_envs,
        seed=0,
        monitor_dir=str(folder / "monitor"),
        wrapper_class=SnapshotEnvWrapper,
        vec_env_cls=vec_env_cls,
    )


def returns_in(folder: Path) -> list[list[str]]:
    files = sorted((folder / "monitor").glob("*"))
    return [[line.rpartition(",")[0] for line in file.read_text().splitlines()[2:]] for file in files]


OU_NOISE = OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.3 * np.ones(1))
RUNS = {
    "MCBSTD3": maker(
        MCBSTD3, action_noise=NormalActionNoise(np.zeros(1), np.ones(1)), action_noise_after_search=True
    ),
    "MCBSTD3, n-step returns": maker(MCBSTD3, n_steps=3),
    "MCBSTD3, SB3's gradient step": maker(
        MCBSTD3, fast_update=False, learning_rate=LinearSchedule(1e-3, 0, 1)
    ),
    "MCBSTD3, pool": maker(MCBSTD3, forward_model="pool"),
    "MCBSTD3, MuJoCo": maker(MCBSTD3, "InvertedPendulum-v5"),
    "MCBSTD3, value expansion": maker(MCBSTD3, "InvertedPendulum-v5", n_envs=2, value_expansion=2),
    "MCBSTD3, branches": maker(MCBSTD3, "InvertedPendulum-v5", n_envs=2, value_expansion=2, branch_length=6),
    "MCBSTD3, saturation by episodes": maker(
        MCBSTD3,
        "InvertedPendulum-v5",
        search_schedule="saturation",
        search_unit="episode",
        search_share=0.6,
        schedule_kwargs=dict(saturation_window=20),
    ),
    "MCBSTD3, few directions": maker(MCBSTD3, "Hopper-v5", search_kwargs=dict(proposal_dims=2, noise_hold=2)),
    "MCBSDDPG": maker(MCBSDDPG),
    "MCBSDDPG, plans of a preset": maker(MCBSDDPG, preset="balanced"),
    "MCBSSAC": maker(MCBSSAC),
    "MCBSSAC, gSDE": maker(MCBSSAC, use_sde=True, use_sde_at_warmup=True),
    "MCBSTQC": maker(MCBSTQC),
    "MCBSTQC, fixed entropy, MuJoCo": maker(MCBSTQC, "InvertedPendulum-v5", ent_coef=0.1),
    "MCBSCrossQ, value expansion": maker(
        MCBSCrossQ,
        "InvertedPendulum-v5",
        value_expansion=2,
        policy_kwargs=dict(net_arch=[16, 16], renorm_warmup_steps=30),
    ),
    "MCBSCrossQ, branches": maker(
        MCBSCrossQ,
        "InvertedPendulum-v5",
        value_expansion=2,
        branch_length=6,
        policy_kwargs=dict(net_arch=[16, 16]),
    ),
    "TD3, Ornstein-Uhlenbeck, two environments": maker(TD3, n_envs=2, action_noise=OU_NOISE),
    "TD3, whole episodes": maker(TD3, "InvertedPendulum-v5", train_freq=(1, "episode"), gradient_steps=-1),
    "DDPG, large buffer": maker(DDPG, buffer_size=1000),
    "DDPG, buffer smaller than the distance": maker(DDPG, buffer_size=25),
    "SAC, learned entropy": maker(SAC),
    "SAC, gSDE": maker(SAC, use_sde=True, sde_sample_freq=7),
    "TQC, fixed entropy": maker(TQC, ent_coef=0.1),
    "CrossQ, gSDE, fixed entropy": maker(CrossQ, use_sde=True, ent_coef=0.1),
    "SAC, memory saved": maker(
        SAC, optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)
    ),
}


@pytest.mark.parametrize("name", RUNS)
def test_resumed_is_exact(name, tmp_path):
    assert_resumed_is_exact(RUNS[name], tmp_path)
    assert returns_in(tmp_path / "whole") == returns_in(tmp_path / "lost")


def test_normalized_worker_environments(tmp_path):
    make = maker(
        MCBSTD3,
        "InvertedPendulum-v5",
        n_envs=2,
        vec_env_cls=SubprocVecEnv,
        wrap=lambda env: VecNormalize(env),
    )
    whole, resumed = assert_resumed_is_exact(make, tmp_path)
    assert returns_in(tmp_path / "whole") == returns_in(tmp_path / "lost") != [[], []]
    for name in ("mean", "var", "count"):
        assert np.array_equal(getattr(whole.env.obs_rms, name), getattr(resumed.env.obs_rms, name))
        assert np.array_equal(getattr(whole.env.ret_rms, name), getattr(resumed.env.ret_rms, name))
    assert np.array_equal(whole.env.returns, resumed.env.returns)
    whole.env.close()
    resumed.env.close()


def test_frame_stack_and_vec_monitor_with_an_env_of_the_caller(tmp_path):
    def make(folder):
        folder.mkdir(exist_ok=True)
        vec_env = make_vec_env("Pendulum-v1", 2, seed=0)
        return VecFrameStack(VecMonitor(vec_env, str(folder / "vec")), 2)

    assert_resumed_is_exact(
        lambda folder: TD3("MlpPolicy", make(folder), buffer_size=90, **SMALL), tmp_path, make_env=make
    )


def test_hindsight_replay(tmp_path):
    def env(folder=None):
        return make_vec_env(lambda: BitFlippingEnv(n_bits=3, continuous=True, max_steps=5), 1, seed=0)

    def make(folder):
        return SAC(
            "MultiInputPolicy", env(), replay_buffer_class=HerReplayBuffer, buffer_size=60,
            policy_kwargs=dict(net_arch=[16]), **SMALL,
        )  # fmt: skip

    assert_resumed_is_exact(make, tmp_path, make_env=env)


def test_box2d_by_replay(tmp_path):
    pytest.importorskip("Box2D")
    assert_resumed_is_exact(maker(TD3, "LunarLanderContinuous-v3"), tmp_path)


def evaluation(folder: Path):
    env = make_vec_env("Pendulum-v1", 1, seed=7)
    return [EvalCallback(env, n_eval_episodes=1, eval_freq=30, log_path=str(folder), verbose=0)]


def test_evaluations_and_nested_callbacks(tmp_path):
    assert_resumed_is_exact(RUNS["MCBSTD3"], tmp_path, more=evaluation)
    whole, lost = (np.load(tmp_path / name / "evaluations.npz") for name in ("whole", "lost"))
    assert len(whole["timesteps"]) == 5
    for name in whole.files:
        assert np.array_equal(whole[name], lost[name])


def without_times(folder: Path, name: str) -> list:
    if name.endswith(".csv"):
        lines = (folder / name).read_text().splitlines()
        columns = lines[0].split(",")
        kept = sorted(column for column in columns if not column.startswith("time/") and "ms_" not in column)
        return [
            [dict(zip(columns, line.split(","), strict=True))[column] for column in kept] for line in lines
        ]
    return [
        {
            key: value
            for key, value in json.loads(line).items()
            if not key.startswith("time/") and "ms_" not in key
        }
        for line in (folder / name).read_text().splitlines()
    ]


def test_log_files_go_on(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    def make(folder):
        agent = RUNS["SAC, learned entropy"](folder)
        agent.set_logger(configure(str(folder / "log"), ["csv", "json", "log", "tensorboard"]))
        return agent

    # An episode ends at 200 steps, is logged before the crash, and again after it.
    assert_resumed_is_exact(make, tmp_path, steps=450, crash_at=215, log_interval=1, save_freq=90)
    for name in ("progress.csv", "progress.json"):
        whole, lost = (without_times(tmp_path / run / "log", name) for run in ("whole", "lost"))
        assert whole == lost
        assert len(whole) >= 2
    lengths = [
        len((tmp_path / run / "log" / "log.txt").read_text().splitlines()) for run in ("whole", "lost")
    ]
    assert lengths[0] == lengths[1]
    scalars = []
    for run in ("whole", "lost"):
        events = EventAccumulator(str(tmp_path / run / "log"))
        events.Reload()
        scalars.append([(event.step, event.value) for event in events.Scalars("rollout/ep_rew_mean")])
    assert scalars[0] == scalars[1]


def test_a_run_that_goes_on_counting(tmp_path):
    """reset_num_timesteps=False: nothing is added to the steps of the original call."""

    def make(folder):
        agent = RUNS["SAC, learned entropy"](folder)
        agent.learn(50)
        return agent

    whole, resumed = assert_resumed_is_exact(make, tmp_path, crash_at=160, reset_num_timesteps=False)
    assert whole.num_timesteps == resumed.num_timesteps == 200


def test_networks_are_there_before_learn(tmp_path):
    crash(RUNS["MCBSTD3"], tmp_path, 150, 105)
    agent = resume(tmp_path / "checkpoints")
    again = MCBSTD3.resume(tmp_path / "checkpoints")
    observation = np.array([[0.5, 0.5, 1.0]], dtype=np.float32)
    assert isinstance(again, MCBSTD3)
    assert np.array_equal(agent.predict(observation)[0], again.predict(observation)[0])
    agent.save(tmp_path / "saved")
    loaded = MCBSTD3.load(tmp_path / "saved")
    assert np.array_equal(agent.predict(observation)[0], loaded.predict(observation)[0])
    assert not {"_stopped_run", "_setup_learn"} & set(vars(loaded))
    fresh = RUNS["MCBSTD3"](tmp_path / "fresh")
    assert not np.array_equal(agent.predict(observation)[0], fresh.predict(observation)[0])


def test_an_agent_of_sb3_is_what_it_was(tmp_path):
    """Until the run goes on it has a second base class, which nobody need know of."""
    crash(RUNS["DDPG, large buffer"], tmp_path, 150, 105)
    agent = resume(tmp_path / "checkpoints")
    assert isinstance(agent, DDPG) and type(agent).__name__ == "DDPG"
    agent.save(tmp_path / "saved")
    loaded = DDPG.load(tmp_path / "saved")
    learn(agent, tmp_path, 150)
    for each in (agent, loaded):
        assert type(each) is DDPG and not {"_stopped_run", "_setup_learn"} & set(vars(each))


def test_settings_are_those_of_the_run(tmp_path):
    crash(maker(MCBSTD3, beam_noise=0.37, gamma=0.9), tmp_path, 150, 105)
    agent = resume(tmp_path / "checkpoints")
    assert (agent.beam_noise, agent.gamma, agent.beam_width) == (0.37, 0.9, 3)


def test_the_order_of_keys_is_no_setting(tmp_path):
    """RL Zoo saves a run's dictionaries sorted, and makes the agent that goes on from these."""
    keys = dict(rollout_noise=0.2, include_policy_action=True)
    saved, same, other = (
        describe_agent(maker(MCBSTD3, search_kwargs=search_kwargs)(tmp_path))
        for search_kwargs in (keys, dict(sorted(keys.items())), {**keys, "rollout_noise": 0.3})
    )
    assert saved.json["nodes"] != same.json["nodes"]
    check_settings(saved, same)
    with pytest.raises(CheckpointError, match=r"run of the checkpoint: search_kwargs\."):
        check_settings(saved, other)


@pytest.mark.parametrize("cls", SEARCHING)
def test_settings_that_override_a_preset_are_those_of_the_run(cls, tmp_path):
    make = maker(cls, preset="strong", beam_width=7, search_kwargs=dict(rollout_noise=0.2, n_elites=None))
    crash(make, tmp_path, 60, 45)
    agent = resume(tmp_path / "checkpoints")
    assert agent.search_settings == make(tmp_path / "other").search_settings
    assert (agent.preset, agent.strategy, agent.beam_width) == ("strong", "cem", 7)
    own = dict(n_rounds=4, n_elites=None, antithetic=True, rollout_noise=0.2)
    assert agent.search_kwargs == own
    other = maker(cls, preset="strong", strategy="beam")(tmp_path / "beam")
    assert (other.strategy, other.search_kwargs) == ("beam", dict(antithetic=True))


def test_learn_may_be_called_again(tmp_path):
    """With the same callback, as long as steps are counted on."""
    agent = RUNS["DDPG, large buffer"](tmp_path)
    callback = ExactCheckpointCallback(40, tmp_path / "checkpoints")
    agent.learn(100, callback=callback)
    agent.learn(100, callback=callback, reset_num_timesteps=False)
    resumed = resume(tmp_path / "checkpoints")
    resumed.learn(
        100, callback=ExactCheckpointCallback(40, tmp_path / "checkpoints"), reset_num_timesteps=False
    )
    assert_same_runs(agent, resumed)
    with pytest.raises(CheckpointError, match="holds the checkpoints of a run"):
        agent.learn(100, callback=callback)


def test_resume_of_another_class(tmp_path):
    crash(RUNS["DDPG, large buffer"], tmp_path, 150, 105)
    with pytest.raises(CheckpointError, match="of a DDPG, not of a MCBSTD3"):
        MCBSTD3.resume(tmp_path / "checkpoints")


class OwnExtractor(FlattenExtractor):
    """A class that no checkpoint may name unless the caller does."""


def test_classes_of_the_caller(tmp_path):
    make = maker(TD3, policy_kwargs=dict(net_arch=[8], features_extractor_class=OwnExtractor))
    crash(make, tmp_path, 150, 105)
    with pytest.raises(CheckpointError, match=r"OwnExtractor.*classes="):
        resume(tmp_path / "checkpoints")
    learn(resume(tmp_path / "checkpoints", classes=[OwnExtractor]), tmp_path, 150)


class OwnTimeAwareObservation(gym.wrappers.TimeAwareObservation):
    """Another wrapper with the same observations."""


def test_an_environment_with_a_wrapper_must_be_passed(tmp_path):
    def env(folder):
        return make_vec_env("Pendulum-v1", 1, seed=0, wrapper_class=gym.wrappers.TimeAwareObservation)

    def make(folder):
        return TD3("MlpPolicy", env(folder), buffer_size=90, **SMALL)

    crash(make, tmp_path / "a", 150, 105)
    with pytest.raises(CheckpointError, match=r"resume\(path, env="):
        resume(tmp_path / "a" / "checkpoints")
    other = make_vec_env("Pendulum-v1", 1, wrapper_class=OwnTimeAwareObservation)
    with pytest.raises(CheckpointError, match="not made as the one of the checkpoint"):
        learn(resume(tmp_path / "a" / "checkpoints", other), tmp_path / "a", 150)
    assert_resumed_is_exact(make, tmp_path / "b", make_env=env)


class TestRefused:
    def make_lost(self, tmp_path):
        crash(RUNS["DDPG, large buffer"], tmp_path, 150, 105)
        return resume(tmp_path / "checkpoints")

    def test_other_total(self, tmp_path):
        with pytest.raises(CheckpointError, match=r"started for 150 steps, learn\(\) was called for 200"):
            learn(self.make_lost(tmp_path), tmp_path, 200)

    def test_no_callback(self, tmp_path):
        with pytest.raises(CheckpointError, match="the same ones in the same order"):
            self.make_lost(tmp_path).learn(150)

    def test_another_callback(self, tmp_path):
        with pytest.raises(CheckpointError, match="EvalCallback"):
            learn(self.make_lost(tmp_path), tmp_path, 150, more=evaluation(tmp_path))

    def test_inside_an_event_callback(self, tmp_path):
        nested = EveryNTimesteps(10, ExactCheckpointCallback(40, tmp_path))
        with pytest.raises(CheckpointError, match="inside a EveryNTimesteps"):
            RUNS["DDPG, large buffer"](tmp_path / "run").learn(50, callback=nested)

    def test_a_folder_that_is_in_use(self, tmp_path):
        crash(RUNS["DDPG, large buffer"], tmp_path, 150, 105)
        with pytest.raises(CheckpointError, match="holds the checkpoints of a run"):
            learn(RUNS["DDPG, large buffer"](tmp_path), tmp_path, 150)

    def test_a_setting_that_is_no_data(self, tmp_path):
        make = maker(TD3, learning_rate=lambda progress: 1e-3)
        with pytest.raises(CheckpointError, match=r"lambda.*LinearSchedule"):
            learn(make(tmp_path), tmp_path, 150)

    def test_a_buffer_that_is_not_known(self, tmp_path):
        from stable_baselines3.common.buffers import ReplayBuffer

        class OwnBuffer(ReplayBuffer):
            pass

        with pytest.raises(CheckpointError, match="OwnBuffer"):
            learn(maker(TD3, replay_buffer_class=OwnBuffer)(tmp_path), tmp_path, 150)

    def test_state_that_is_no_data(self, tmp_path):
        agent = RUNS["DDPG, large buffer"](tmp_path)
        agent.my_file = open(tmp_path / "file", "w")  # noqa: SIM115
        with pytest.raises(CheckpointError, match=r"DDPG\.my_file.*TextIOWrapper"):
            learn(agent, tmp_path, 150)
        agent.my_file.close()

    def test_no_path(self, tmp_path):
        with pytest.raises(CheckpointError, match="needs a path"):
            RUNS["DDPG, large buffer"](tmp_path).learn(50, callback=ExactCheckpointCallback(40))

    @pytest.mark.parametrize("save_freq", [0, -1, 1.5, True, "10"])
    def test_save_freq(self, save_freq, tmp_path):
        with pytest.raises(ValueError, match="save_freq"):
            ExactCheckpointCallback(save_freq, tmp_path)


def test_other_circumstances_are_said(tmp_path):
    crash(RUNS["DDPG, large buffer"], tmp_path, 150, 105)
    th.set_num_threads(2)
    try:
        with pytest.warns(UserWarning, match="not exact: torch threads: 1 then, 2 now"):
            learn(resume(tmp_path / "checkpoints"), tmp_path, 150)
    finally:
        th.set_num_threads(1)


def test_a_crash_while_resuming_loses_nothing(tmp_path):
    """The files that a resumed run opens anew are written again from the checkpoint, however often."""
    make = RUNS["TD3, whole episodes"]
    whole = learn(make(tmp_path / "whole"), tmp_path / "whole", 150)
    crash(make, tmp_path / "lost", 150, 105)
    for crash_at in (110, 130):
        with pytest.raises(Crash):
            learn(resume(tmp_path / "lost" / "checkpoints"), tmp_path / "lost", 150, crash_at)
    resume(tmp_path / "lost" / "checkpoints")  # opens Monitor's file, and ends here
    resumed = learn(resume(tmp_path / "lost" / "checkpoints"), tmp_path / "lost", 150)
    assert returns_in(tmp_path / "whole") == returns_in(tmp_path / "lost")
    assert whole.num_timesteps == resumed.num_timesteps
