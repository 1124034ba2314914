"""What happens when something goes wrong while an agent acts: every fault is injected here."""

import json
import os
import signal
import time
import warnings
from contextlib import nullcontext
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from stable_baselines3.her import HerReplayBuffer

from sb3_mcbs import MCBSTD3, NonFiniteError, SearchPolicy, SnapshotEnvWrapper, WorkerError
from sb3_mcbs.agents.checked_rollouts import break_trajectories
from sb3_mcbs.agents.faults import InvalidDecisions
from tests.conftest import snapshot_vec_env


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo writes a log file where it runs when a simulation diverges."""
    monkeypatch.chdir(tmp_path)


def blow_up(wrapper: SnapshotEnvWrapper) -> None:
    wrapper.unwrapped.data.qvel[0] = 1e11


class BlowUp(BaseCallback):
    """Lets the simulation of one environment diverge in the step after step ``at``."""

    def __init__(self, at: int, env_index: int = 0) -> None:
        super().__init__()
        self.at, self.env_index = at, env_index
        self.seen: list[tuple] = []

    def _on_step(self) -> bool:
        self.seen.append((self.locals["new_obs"], self.locals["dones"], self.locals["infos"]))
        if self.n_calls == self.at:
            self.training_env.env_method("apply", blow_up, indices=[self.env_index])
        return True


class Faulty(gym.Wrapper):
    """Goes wrong at one step of its life, in itself as in its copies.

    :param how: "nan" and "inf" observations, "reward" that is infinite, "last" for a NaN at the end of an
        episode, "raise", "sigkill" or "reset" for a NaN in the first observation.
    """

    def __init__(self, env: gym.Env, how: str, at: int = 10) -> None:
        super().__init__(env)
        self.how, self.at, self.age = how, at, 0

    def reset(self, **kwargs):
        observation, info = self.env.reset(**kwargs)
        return (observation * np.nan if self.how == "reset" else observation), info

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.age += 1
        if self.age == self.at:
            if self.how == "raise":
                raise ZeroDivisionError("the gear broke")
            if self.how == "sigkill":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.how == "reward":
                reward = np.inf
            if self.how in ("nan", "last"):
                observation = observation * np.nan
            if self.how == "inf":
                observation = observation + np.inf
            truncated = self.how == "last"
        return observation, reward, terminated, truncated, info


def faulty_vec_env(how: str, vec_env_cls=DummyVecEnv, at: int = 10):
    """Two Pendulums; the second goes wrong."""

    def healthy() -> gym.Env:
        return SnapshotEnvWrapper(Monitor(gym.make("Pendulum-v1")))

    def faulty() -> gym.Env:
        return SnapshotEnvWrapper(Faulty(Monitor(gym.make("Pendulum-v1")), how, at))

    # Quicker to start than SB3's default.
    settings = {"start_method": "fork"} if vec_env_cls is SubprocVecEnv else {}
    return vec_env_cls([healthy, faulty], **settings)


# --- the simulation diverges -----------------------------------------------------------------------------


@pytest.mark.parametrize("at", [8, 30])  # before and after the search begins
@pytest.mark.parametrize(("vec_env_cls", "n_envs"), [(DummyVecEnv, 1), (DummyVecEnv, 2), (SubprocVecEnv, 2)])
def test_a_diverged_step_is_not_stored(make_agent, tmp_path: Path, vec_env_cls, n_envs: int, at: int) -> None:
    vec_env = snapshot_vec_env("HalfCheetah-v5", n_envs, vec_env_cls=vec_env_cls)
    agent = make_agent(vec_env, learning_starts=20 * n_envs)
    agent.set_logger(configure(str(tmp_path), ["json"]))
    callback = BlowUp(at, env_index=n_envs - 1)
    with pytest.warns(UserWarning, match=f"simulation of environment {n_envs - 1} diverged at step") as told:
        agent.learn(40 * n_envs, callback=callback, log_interval=1)
    # Not those about files that earlier loggers left open, whose names have this test's in them.
    messages = [str(warning.message) for warning in told if warning.category is UserWarning]
    assert ["diverged" in message for message in messages].count(True) == 1, messages
    assert not any("forward model" in message for message in messages), "the model is not to blame"

    new_obs, dones, infos = callback.seen[at]
    assert dones[-1] and infos[-1]["simulation_diverged"] and infos[-1]["TimeLimit.truncated"]
    assert infos[-1]["episode"]["l"] >= 1, "Monitor knows of the end"
    buffer = agent.replay_buffer
    assert agent.n_diverged_steps == 1
    assert buffer.pos == 40 - 1, "all other steps are there"
    assert (buffer.dones[at - 1] == 1).all() and (buffer.timeouts[at - 1] == 1).all()
    np.testing.assert_array_equal(buffer.observations[at], new_obs)
    assert np.abs(buffer.rewards[:40]).max() < 1e6
    logged = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    assert [values["rollout/diverged_steps"] for values in logged] == [1], "one episode ended, by diverging"
    vec_env.close()


def test_the_count_is_saved_and_logged(make_agent, tmp_path: Path) -> None:
    agent = make_agent(snapshot_vec_env("InvertedPendulum-v5"))
    callback = BlowUp(5)
    with warnings.catch_warnings(record=True):
        agent.learn(15, callback=callback, log_interval=None)
    assert agent.logger.name_to_value["rollout/diverged_steps"] == 1
    agent.save(tmp_path / "agent.zip")
    assert MCBSTD3.load(tmp_path / "agent.zip").n_diverged_steps == 1


def test_divergence_leaves_normalisation_in_order(make_agent) -> None:
    vec_env = VecNormalize(snapshot_vec_env("HalfCheetah-v5"))
    agent = make_agent(vec_env)
    with pytest.warns(UserWarning, match="diverged"):
        agent.learn(40, callback=BlowUp(25))
    assert vec_env.ret_rms.var < 1e3, "the reward of a jump is not counted"
    assert np.abs(agent.replay_buffer.rewards).max() < 1e3
    observation = agent.replay_buffer.observations[25, 0]
    assert np.abs(observation[:8]).max() <= 0.1, "the next row is a first observation, not normalised"


class Stop(BaseCallback):
    """Ends the training at a step, or breaks it off as Ctrl-C does."""

    def __init__(self, at: int, broken_off: bool) -> None:
        super().__init__()
        self.at, self.broken_off = at, broken_off

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at and self.broken_off:
            raise KeyboardInterrupt
        return self.num_timesteps != self.at


@pytest.mark.parametrize("broken_off", [False, True])
@pytest.mark.parametrize("settings", [{}, dict(n_steps=3), dict(search_share=0.5, search_unit="episode")])
def test_training_that_a_callback_stopped_can_go_on(make_agent, settings: dict, broken_off: bool) -> None:
    """Also where an episode ends in that step, which SB3 does not store."""
    env = VecNormalize(snapshot_vec_env("Pendulum-v1", 2, env_kwargs={"max_episode_steps": 25}))
    agent = make_agent(env, **settings)
    for at in (44, 50, 96):
        with pytest.raises(KeyboardInterrupt) if broken_off else nullcontext():
            agent.learn(60, callback=Stop(at, broken_off), reset_num_timesteps=False)
        assert (agent.num_timesteps, agent._schedule._starts.tolist()) == (at, [50 * (at // 50)] * 2)
    agent.learn(60, reset_num_timesteps=False)
    buffer = agent.replay_buffer
    assert buffer.pos * 2 == agent.num_timesteps - 3 * 2, "the three steps are not stored"
    assert buffer.dones[[20, 22, 44]].all() and buffer.timeouts[[20, 22, 44]].all()


def test_a_monitor_that_forbids_early_resets(tmp_path: Path) -> None:
    env = SnapshotEnvWrapper(
        Monitor(gym.make("InvertedPendulum-v5"), str(tmp_path / "log"), allow_early_resets=False)
    )
    for _ in range(2):
        env.reset(seed=0)
        env.step(env.action_space.sample() * 0)
        blow_up(env)
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert (reward, terminated, truncated) == (0, False, True)
        assert info["episode"]["l"] == 2
    assert env.env.get_total_steps() == 4
    env.close()
    assert len((tmp_path / "log.monitor.csv").read_text().splitlines()) == 2 + 2


def test_evaluations_end_although_every_episode_diverges(make_agent) -> None:
    class AlwaysDiverges(gym.Wrapper):
        def step(self, action):
            self.unwrapped.data.qvel[0] = 1e11
            return self.env.step(action)

    vec_env = DummyVecEnv(
        [lambda: SnapshotEnvWrapper(Monitor(AlwaysDiverges(gym.make("InvertedPendulum-v5"))))]
    )
    policy = SearchPolicy(make_agent("InvertedPendulum-v5"), vec_env, seed=0)
    returns, lengths = evaluate_policy(policy, vec_env, 2, return_episode_rewards=True)
    assert (returns, lengths) == ([0, 0], [1, 1])
    assert policy.last_result.chosen.tolist() == [-1], "no candidate was valid"


def test_what_is_not_a_divergence() -> None:
    env = SnapshotEnvWrapper(gym.make("HalfCheetah-v5"))
    env.reset(seed=0)
    blow_up(env)
    env.unwrapped.step(env.action_space.sample())  # not seen by the wrapper
    assert not env.step(env.action_space.sample())[3], "an old warning"
    blow_up(env)
    assert env.step(env.action_space.sample())[3]
    blow_up(env)
    assert env.step(env.action_space.sample())[3], "MuJoCo's own count does not grow here"
    env.reset()
    assert not env.step(env.action_space.sample())[3]
    copy = env.clone()
    blow_up(copy)
    assert copy.step(env.action_space.sample())[3]
    assert not env.step(env.action_space.sample())[3], "a copy's divergence is the copy's"


def test_bad_controls_and_exchanged_simulators_are_seen() -> None:
    env = SnapshotEnvWrapper(gym.make("HalfCheetah-v5"))
    env.reset(seed=0)
    *_, truncated, info = env.step(np.full(6, np.nan, np.float32))
    assert truncated and info["simulation_diverged"]
    other = gym.make("HalfCheetah-v5").unwrapped
    env.unwrapped.model, env.unwrapped.data = other.model, other.data
    env.reset(seed=0)
    blow_up(env)
    assert env.step(env.action_space.sample())[3]


def box_buffer(
    cls: type[ReplayBuffer] = ReplayBuffer, size: int = 10, n_envs: int = 1, **kwargs
) -> ReplayBuffer:
    box = spaces.Box(-100, 100, (1,), np.float32)
    return cls(size * n_envs, box, box, "cpu", n_envs, **kwargs)


def fill(buffer: ReplayBuffer, places, done: float = 0) -> None:
    """Steps of size 1 from each place; the reward is the place."""
    for place in places:
        rows = np.full((buffer.n_envs, 1), place, np.float32)
        if isinstance(buffer, HerReplayBuffer):
            keys = ("observation", "achieved_goal", "desired_goal")
            here, there = dict.fromkeys(keys, rows), dict.fromkeys(keys, rows + 1)
        else:
            here, there = rows, rows + 1
        infos = [{"TimeLimit.truncated": False}] * buffer.n_envs
        buffer.add(here, there, rows, rows[:, 0], np.full(buffer.n_envs, done), infos)


def test_returns_over_several_steps_end_at_the_gap() -> None:
    buffer = box_buffer(NStepReplayBuffer, n_steps=3, gamma=1.0)
    fill(buffer, [1, 2, 3])
    break_trajectories(buffer)
    fill(buffer, [50, 51])
    samples = buffer._get_samples(np.array([1, 2, 3]))
    assert samples.rewards.ravel().tolist() == [2 + 3, 3, 50 + 51]
    assert samples.next_observations.ravel().tolist() == [4, 4, 52]
    assert samples.dones.ravel().tolist() == [0, 0, 0], "bootstrapped"


@pytest.mark.parametrize("handle_timeouts", [True, False])
def test_what_was_stored_last_is_truncated(handle_timeouts: bool) -> None:
    buffer = box_buffer(size=4, n_envs=2, handle_timeout_termination=handle_timeouts)
    break_trajectories(buffer)
    assert not buffer.dones.any(), "there is nothing yet"
    fill(buffer, [1, 2, 3])
    fill(buffer, [4], done=1)
    break_trajectories(buffer)  # at the wrap-around
    assert buffer.timeouts.sum() == 0, "a termination stays one"
    fill(buffer, [5, 6, 7, 8])
    break_trajectories(buffer)
    assert buffer.dones[3].tolist() == buffer.timeouts[3].tolist() == [1, 1]
    assert not buffer._get_samples(np.array([3, 3])).dones.any()


def test_a_memory_efficient_buffer_does_not_look_across_the_gap() -> None:
    buffer = box_buffer(optimize_memory_usage=True, handle_timeout_termination=False)
    fill(buffer, [1, 2])
    break_trajectories(buffer)
    fill(buffer, [50, 51])
    samples = buffer._get_samples(np.array([1]))
    assert samples.next_observations.item() == 50 and samples.dones.item() == 1


def test_goals_come_from_this_side_of_the_gap() -> None:
    box = spaces.Box(-100, 100, (1,), np.float32)
    space = spaces.Dict(dict.fromkeys(("observation", "achieved_goal", "desired_goal"), box))
    buffer = HerReplayBuffer(20, space, box, env=None, device="cpu", n_envs=2, copy_info_dict=False)
    fill(buffer, [1, 2, 3])
    break_trajectories(buffer)
    fill(buffer, [50], done=1)
    assert buffer.ep_length[:4].tolist() == [[3, 3]] * 3 + [[1, 1]]
    goals = buffer._sample_goals(np.zeros(50, np.int64), np.zeros(50, np.int64))
    assert set(goals.ravel().tolist()) <= {2, 3, 4}


# --- numbers that are not finite -------------------------------------------------------------------------


@pytest.mark.parametrize("normalise", [False, True])
@pytest.mark.parametrize(
    ("how", "what"),
    [("nan", "observation"), ("inf", "observation"), ("reward", "reward inf"), ("last", "last observation")],
)
def test_an_environment_that_returns_nan(make_agent, how: str, what: str, normalise: bool) -> None:
    vec_env = faulty_vec_env(how)
    if normalise:
        vec_env = VecNormalize(vec_env)
    agent = make_agent(vec_env, learning_starts=100)
    with pytest.raises(
        NonFiniteError, match=rf"Environment 1 returned the {what}.* after the action \["
    ) as caught:
        agent.learn(100)
    assert "check_env" in str(caught.value)
    assert agent.replay_buffer.pos == 9 and np.isfinite(agent.replay_buffer.next_observations).all()
    if normalise:
        assert np.isfinite(vec_env.obs_rms.mean).all() and np.isfinite(vec_env.ret_rms.var)
        assert vec_env.obs_rms.count == pytest.approx(1e-4 + 2 * 10)  # reset and nine steps


def test_dict_observations_are_checked(make_agent, make_dict_env) -> None:
    class NoSpeed(gym.ObservationWrapper):
        def observation(self, observation):
            return {**observation, "speed": observation["speed"] * np.nan}

    agent = make_agent(DummyVecEnv([lambda: NoSpeed(make_dict_env())]), policy="MultiInputPolicy")
    with pytest.raises(NonFiniteError, match=r"Environment 0 is in a state .* \[nan\]"):
        agent.learn(100)


def test_a_first_observation_that_is_nan(make_agent) -> None:
    agent = make_agent(faulty_vec_env("reset"))
    with pytest.raises(NonFiniteError, match="Environment 1 is in a state"):
        agent.learn(100)
    vec_env = faulty_vec_env("reset")
    with pytest.raises(NonFiniteError, match="Environment 1 is in a state"):
        SearchPolicy(make_agent(), vec_env).predict(vec_env.reset())


def test_large_numbers_are_finite(make_agent) -> None:
    class Large(gym.RewardWrapper):
        def reward(self, reward):
            return 3e38

    agent = make_agent(DummyVecEnv([lambda: Large(gym.make("Pendulum-v1"))] * 2), learning_starts=100)
    agent.learn(20)
    assert agent.replay_buffer.pos == 10


@pytest.mark.parametrize("network", ["actor", "critic"])
@pytest.mark.parametrize(
    "settings", [{}, {"rollout_depth": 0}, {"search_kwargs": {"time_budget": 1.0, "max_beam_width": 4}}]
)
def test_networks_that_diverged(make_agent, network: str, settings: dict) -> None:
    agent = make_agent("InvertedPendulum-v5", **settings)
    agent.learn(25)
    with th.no_grad():
        next(getattr(agent, network).parameters()).fill_(np.nan)
    with pytest.raises(NonFiniteError, match=f"The {network}.* networks have diverged.*learning_rate"):
        agent.learn(25, reset_num_timesteps=False)
    vec_env = snapshot_vec_env("InvertedPendulum-v5")
    policy = SearchPolicy(agent, vec_env)
    with pytest.raises(NonFiniteError, match="networks have diverged"):
        policy.predict(vec_env.reset())


@pytest.mark.parametrize("forward_model", ["mujoco", "pool"])
def test_rollouts_that_diverge_are_not_the_networks_fault(make_agent, forward_model: str) -> None:
    vec_env = snapshot_vec_env("InvertedPendulum-v5", 2)
    policy = SearchPolicy(make_agent("InvertedPendulum-v5"), vec_env, seed=0, forward_model=forward_model)
    observations = vec_env.reset()
    policy.predict(observations)
    vec_env.env_method("apply", blow_up, indices=[1])
    actions, _ = policy.predict(observations)
    assert policy.last_result.chosen[0] >= 0 and policy.last_result.chosen[1] == -1
    expected, _ = policy.model.predict(observations)
    np.testing.assert_allclose(actions[1], expected[1], atol=1e-6)


# --- environments that fail, workers that end --------------------------------------------------------------


def test_an_environment_that_raises(make_agent) -> None:
    agent = make_agent(faulty_vec_env("raise"))
    with pytest.raises(ZeroDivisionError, match="the gear broke") as caught:
        agent.learn(100)
    assert caught.value.__notes__ == ["This happened in environment 1 of 2."]


def closes_at_once(vec_env) -> bool:
    start = time.perf_counter()
    vec_env.close()
    return time.perf_counter() - start < 1


@pytest.mark.parametrize("learning_starts", [10, 100])  # with the search, and before it
def test_a_worker_that_raises(make_agent, learning_starts: int) -> None:
    vec_env = VecNormalize(faulty_vec_env("raise", SubprocVecEnv, at=10))
    agent = make_agent(vec_env, learning_starts=learning_starts, rollout_depth=1)
    with pytest.raises(WorkerError, match="environment 1 ended with exit code 1") as caught:
        agent.learn(100)
    assert (caught.value.env_index, caught.value.exit_code) == (1, 1)
    assert "ZeroDivisionError: the gear broke" in str(caught.value)
    assert 'test_faults.py", line' in caught.value.worker_traceback
    assert isinstance(caught.value.__cause__, EOFError | OSError)
    assert closes_at_once(vec_env)
    assert not any(process.is_alive() for process in vec_env.unwrapped.processes)


def test_a_worker_that_is_killed(make_agent) -> None:
    vec_env = faulty_vec_env("sigkill", SubprocVecEnv)
    agent = make_agent(vec_env, rollout_depth=0)  # a copy would kill it before the step does
    with pytest.raises(WorkerError, match=r"environment 1 was killed by SIGKILL \(exit code -9\)") as caught:
        agent.learn(100)
    assert "memory" in str(caught.value) and caught.value.worker_traceback == ""
    assert closes_at_once(vec_env)


class KillFirst(BaseCallback):
    """Kills the worker of environment 0 before the next search."""

    def _on_step(self) -> bool:
        if self.n_calls == 15:
            process = self.training_env.unwrapped.processes[0]
            os.kill(process.pid, signal.SIGKILL)
            process.join()
        return True


def test_a_worker_that_is_missing_when_the_search_needs_it(make_agent) -> None:
    vec_env = faulty_vec_env("never", SubprocVecEnv)
    agent = make_agent(vec_env)
    with pytest.raises(WorkerError, match="environment 0 was killed by SIGKILL"):
        agent.learn(100, callback=KillFirst())
    assert closes_at_once(vec_env)
    agent.planner.close()


def test_errors_that_are_no_worker_s(make_agent) -> None:
    class DiskFull(BaseCallback):
        def _on_step(self) -> bool:
            raise OSError(28, "No space left on device")

    vec_env = faulty_vec_env("never", SubprocVecEnv)
    with pytest.raises(OSError, match="No space left"):
        make_agent(vec_env).learn(100, callback=DiskFull())
    assert vec_env.reset().shape == (2, 3), "the workers go on"
    vec_env.close()


class RaisesInCopies(gym.Wrapper):
    """Steps only itself, once it is armed: copies carry the identity of the original."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.armed: int | None = None

    def step(self, action):
        if self.armed not in (None, id(self)):
            raise OSError("table.csv is not there")
        return super().step(action)


def arm(wrapper: SnapshotEnvWrapper) -> None:
    layer = wrapper.env
    layer.armed = id(layer)


@pytest.mark.parametrize(("vec_env_cls", "n_envs"), [(DummyVecEnv, 1), (DummyVecEnv, 2), (SubprocVecEnv, 2)])
@pytest.mark.parametrize("strategy", ["beam", "tree", "cem"])
def test_all_simulations_invalid_is_no_quiet_state(make_agent, caplog, vec_env_cls, n_envs, strategy) -> None:
    if vec_env_cls is SubprocVecEnv and strategy != "beam":
        pytest.skip("workers do the same for every strategy")
    env = vec_env_cls([lambda: SnapshotEnvWrapper(RaisesInCopies(gym.make("Pendulum-v1")))] * n_envs)
    agent = make_agent(env, strategy=strategy)
    env.env_method("apply", arm)
    with pytest.warns(
        UserWarning, match="All simulations of the last 1[0-9] decisions were invalid.*OSError"
    ):
        agent.learn(20 + 120 * n_envs)
    said = [record.getMessage() for record in caplog.records if "All simulations" in record.message]
    assert [f"last {count} " in text for count, text in zip((10, 100), said, strict=True)] == [True, True]
    assert all("the policy's own actions are executed instead" in text for text in said)
    # The traceback shows where it happened, once.
    assert ['table.csv is not there")' in text for text in said] == [True, False]
    values = agent.logger.name_to_value
    assert values["search/invalid_rollouts"] == agent.n_invalid_rollouts >= values["search/decisions"] > 100
    env.close()


def test_invalid_decisions_are_counted_in_a_row(make_agent, caplog) -> None:
    agent = make_agent("InvertedPendulum-v5").learn(30)
    found = agent._search([0])
    invalid = found._replace(chosen=np.array([-1]), invalid_rollouts=6)
    decisions = InvalidDecisions()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for result in [invalid] * 9 + [found] + [invalid] * 9 + [found._replace(chosen=np.array([-1]))]:
            decisions.note(result, agent.planner.model)
    for _ in range(9):
        decisions.note(invalid, agent.planner.model)
    with pytest.warns(UserWarning, match="last 10 decisions .* They diverged"):
        decisions.note(invalid, agent.planner.model)
    assert "Traceback" not in caplog.text
