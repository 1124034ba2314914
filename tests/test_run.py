"""Agents that search train: every kind of environment and policy, SB3's own behaviour kept."""

import json
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from gymnasium.wrappers import TransformReward
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_mcbs import MCBSSAC, MCBSTD3, MCBSTQC, MCBSCrossQ, SnapshotEnvWrapper
from sb3_mcbs.models import ForwardModelError
from tests.conftest import (
    SEARCHING,
    WITHOUT_SEARCH,
    assert_same_parameters,
    parameters_of,
    snapshot_vec_env,
)


def logged(agent, folder):
    """Everything that was logged, as one list of dicts."""
    agent.set_logger(configure(str(folder), ["json"]))
    return lambda: [json.loads(line) for line in (folder / "progress.json").read_text().splitlines()]


@pytest.mark.parametrize(
    "cls, env_id, depth",
    [
        *((MCBSTD3, env_id, depth) for env_id in ("HalfCheetah-v5", "Pendulum-v1") for depth in (0, 1, 3)),
        *((cls, *case) for cls in SEARCHING[1:] for case in [("HalfCheetah-v5", 3), ("Pendulum-v1", 0)]),
    ],
)
def test_trains(make_agent, cls, env_id, depth):
    agent = make_agent(env_id, cls=cls, rollout_depth=depth)
    before = parameters_of(agent)
    agent.learn(60)
    assert agent.num_timesteps == 60 and agent.n_decisions == 40
    if depth:
        assert agent.planner.model.kind == ("mujoco" if env_id == "HalfCheetah-v5" else "pool")
    first_steps, later_steps = 3, (depth - 1) * 6
    assert agent.n_simulated_steps == (40 * (first_steps + later_steps) if depth else 0)
    after = parameters_of(agent)
    for name in before:
        assert not np.array_equal(before[name], after[name]), name


@pytest.mark.parametrize("cls", [cls for cls in SEARCHING if "MultiInputPolicy" in cls.policy_aliases])
def test_dict_observations(make_agent, make_dict_env, cls):
    agent = make_agent(make_dict_env(), policy="MultiInputPolicy", cls=cls)
    agent.learn(40)
    assert agent.n_decisions == 20


@pytest.mark.parametrize(
    "cls, env_id, vec_env_cls",
    [
        *((cls, "Pendulum-v1", DummyVecEnv) for cls in SEARCHING),
        (MCBSTD3, "Swimmer-v5", DummyVecEnv),
        (MCBSTD3, "Swimmer-v5", SubprocVecEnv),
        (MCBSTD3, "Pendulum-v1", SubprocVecEnv),
    ],
)
def test_many_environments(make_agent, cls, env_id, vec_env_cls):
    env = VecMonitor(snapshot_vec_env(env_id, 2, vec_env_cls=vec_env_cls))
    agent = make_agent(VecNormalize(env), cls=cls, model_kwargs=dict(n_threads=2))
    agent.learn(60)
    assert agent.n_decisions == 40
    env.close()


@pytest.mark.parametrize("cls", SEARCHING)
def test_processes_and_one_process_train_alike(make_agent, cls):
    agents = []
    for vec_env_cls in (DummyVecEnv, SubprocVecEnv):
        env = snapshot_vec_env("HalfCheetah-v5", 2, vec_env_cls=vec_env_cls)
        agents.append(make_agent(env, cls=cls).learn(50))
        env.close()
    assert_same_parameters(*agents)


def test_workers_that_are_not_wrapped_are_refused(make_agent):
    env = make_vec_env("Pendulum-v1", 1, vec_env_cls=SubprocVecEnv)
    with pytest.raises(ValueError, match=r"env_wrapper: sb3_mcbs\.SnapshotEnvWrapper"):
        make_agent(env)
    env.close()


def test_workers_whose_wrapper_is_not_outermost_are_refused(make_agent):
    """A look-ahead from inside would know neither these actions nor these rewards."""

    def wrap(env):
        return TransformReward(SnapshotEnvWrapper(env), lambda reward: -reward)

    env = make_vec_env("Pendulum-v1", 2, vec_env_cls=SubprocVecEnv, wrapper_class=wrap)
    with pytest.raises(
        ValueError, match=r"\[0, 1\] have TransformReward outside of their SnapshotEnvWrapper"
    ):
        make_agent(env)
    assert make_agent(env, rollout_depth=0).learn(24).n_decisions == 4  # nothing is simulated
    env.close()


def test_unknown_vectorized_wrapper_is_refused(make_agent):
    with pytest.raises(ValueError, match="VecFrameStack"):
        make_agent(VecFrameStack(make_vec_env("Pendulum-v1", 1), 2))


@pytest.mark.parametrize("cls", SEARCHING)
def test_same_seed_same_run_and_threads_change_nothing(make_agent, cls):
    one, two, other = (
        make_agent("Hopper-v5", cls=cls, seed=s, model_kwargs=dict(n_threads=n)).learn(60)
        for s, n in [(3, 1), (3, 2), (4, 1)]
    )
    assert_same_parameters(one, two)
    np.testing.assert_array_equal(one.replay_buffer.actions[:60], two.replay_buffer.actions[:60])
    assert not np.array_equal(one.replay_buffer.actions[:60], other.replay_buffer.actions[:60])


GSDE = dict(use_sde=True, use_sde_at_warmup=True, sde_sample_freq=4)


@pytest.mark.parametrize(
    "cls, settings", [*((cls, {}) for cls in SEARCHING), (MCBSSAC, GSDE), (MCBSTQC, GSDE), (MCBSCrossQ, GSDE)]
)
def test_before_learning_starts_it_is_the_agent_without_search(make_agent, cls, settings):
    """The same random numbers are drawn in the same order as without search until the first one."""
    noise = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
    settings = dict(action_noise=noise, learning_starts=30, **settings)
    agents = [make_agent(cls=which, **settings).learn(30) for which in (WITHOUT_SEARCH[cls], cls)]
    plain, searching = (agent.replay_buffer.actions[:30] for agent in agents)
    np.testing.assert_array_equal(plain, searching)
    assert agents[1].n_decisions == 0


@pytest.mark.parametrize("cls", [MCBSSAC, MCBSTQC, MCBSCrossQ])
@pytest.mark.parametrize("settings", [{}, GSDE])
def test_search_is_around_the_mean_action(make_agent, cls, settings):
    """Neither the actor's distribution nor gSDE decides what is searched, however wide they are."""
    policy_kwargs = dict(net_arch=[16], log_std_init=1.0) if settings else dict(net_arch=[16])
    agent = make_agent(
        cls=cls, beam_width=1, beam_noise=0, policy_kwargs=policy_kwargs, gradient_steps=0, **settings
    )
    agent.learn(40)
    observations = agent.replay_buffer.observations[20:40, 0]
    mean, _ = agent.predict(observations, deterministic=True)
    drawn, _ = agent.predict(observations, deterministic=False)
    searched = agent.policy.unscale_action(agent.replay_buffer.actions[20:40, 0])
    np.testing.assert_allclose(searched, mean, rtol=1e-4, atol=1e-5)
    assert np.abs(drawn - mean).max() > 0.1


class NotesRandomness(BaseCallback):
    """Keeps torch's random state and gSDE's exploration matrix after every step."""

    def __init__(self) -> None:
        super().__init__()
        self.states, self.matrices = [], []

    def _on_step(self) -> bool:
        self.states.append(th.get_rng_state().numpy())
        self.matrices.append(self.model.actor.action_dist.exploration_mat.detach().numpy().copy())
        return True


@pytest.mark.parametrize("cls", [MCBSSAC, MCBSTQC, MCBSCrossQ])
def test_searching_leaves_gsdes_resampling_as_it_is(make_agent, cls):
    """The matrices are those of the agent without search, step by step, and so is all later randomness."""
    noted = []
    for which in (WITHOUT_SEARCH[cls], cls):
        agent = make_agent(cls=which, learning_rate=0.0, **GSDE)
        noted.append(NotesRandomness())
        agent.learn(60, callback=noted[-1])
    plain, searching = noted
    assert agent.n_decisions == 40
    np.testing.assert_array_equal(plain.matrices, searching.matrices)
    np.testing.assert_array_equal(plain.states, searching.states)
    changes = [not np.array_equal(*pair) for pair in pairwise(searching.matrices[20:])]
    assert any(changes), "it was resampled while there was search"


@pytest.mark.parametrize("cls", SEARCHING)
def test_searched_action_is_executed_and_stored_as_it_is(make_agent, cls):
    """RL Zoo's settings contain action noise; SB3 would add it to the chosen action."""
    executed = []

    class Spy(gym.ActionWrapper):
        def action(self, action):
            executed.append(np.array(action))
            return action

    env = Spy(gym.make("Pendulum-v1"))
    agent = make_agent(env, cls=cls, action_noise=NormalActionNoise(np.zeros(1), 5.0 * np.ones(1)))
    chosen = []
    agent._setup_learn(1)
    plan = agent.planner.plan
    agent.planner.plan = lambda *args: chosen.append(plan(*args)) or chosen[-1]
    agent.learn(40)
    assert len(chosen) == 20
    searched = np.concatenate([result.actions for result in chosen])
    np.testing.assert_array_equal(agent.replay_buffer.actions[20:40, 0], searched)
    real = [action for action in executed if action.shape == (1,)][-20:]
    assert len(real) == 20


@pytest.mark.parametrize("cls", SEARCHING)
def test_action_noise_after_search_is_an_option(make_agent, cls):
    noise = NormalActionNoise(np.zeros(1), 5.0 * np.ones(1))
    quiet, loud = (
        make_agent(cls=cls, action_noise=noise, action_noise_after_search=after).learn(40).replay_buffer
        for after in (False, True)
    )
    quiet, loud = quiet.actions[20:40], loud.actions[20:40]
    assert np.mean(np.abs(loud) == 1) > 0.5 > np.mean(np.abs(quiet) == 1)


@pytest.mark.parametrize("cls", SEARCHING)
def test_logs(make_agent, tmp_path, cls):
    env = snapshot_vec_env("Pendulum-v1", env_kwargs=dict(max_episode_steps=50))
    agent = make_agent(env, cls=cls, learning_starts=25)
    read = logged(agent, tmp_path)
    agent.learn(100, log_interval=1)
    entries = [entry for entry in read() if entry.get("search/decisions")]
    assert [entry["search/decisions"] for entry in entries] == [25, 75]
    for entry in entries:
        assert entry["search/model_error"] == 0
        assert entry["search/invalid_rollouts"] == 0
        assert entry["search/simulated_steps"] == entry["search/decisions"] * 9
        assert entry["search/value_gain"] > 0 and entry["search/beam_std"] > 0
        assert entry["search/ms_per_decision"] > 0


def test_a_training_ends_with_one_line_of_what_it_took(make_agent, capsys):
    agent = make_agent(verbose=1, search_share=0.0, learning_starts=10)
    for schedule, says in (("0", "0%"), ("1", "50%")):
        agent.search_share = float(schedule)
        agent.learn(20, reset_num_timesteps=True)
        lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Trained")]
        assert len(lines) == 1 and f"; {says} of the decisions were searched." in lines[0]
    assert f"with {agent.n_simulated_steps:,} simulated steps" in lines[0]
    assert "Trained for 20 environment steps" in lines[0]
    agent.verbose = 0
    agent.learn(5, reset_num_timesteps=False)
    assert "Trained" not in capsys.readouterr().out


def test_an_edited_environment_is_followed(make_agent, tmp_path):
    """Domain randomisation: the simulator's copy of the model must not stay behind."""
    agent = make_agent("HalfCheetah-v5")
    read = logged(agent, tmp_path)
    agent.learn(30)
    model = agent.get_env().envs[0].unwrapped.model
    model.body_mass[:] *= 1.3
    with pytest.warns(UserWarning, match="edited"):
        agent.learn(10, reset_num_timesteps=False)
    assert agent.planner.model.kind == "mujoco"
    agent.logger.dump(1)
    agent.learn(20, reset_num_timesteps=False)
    agent.logger.dump(2)
    errors = [entry["search/model_error"] for entry in read()]
    assert errors[0] > 0 and errors[-1] == 0


def test_a_model_that_cannot_read_the_environment_any_more_is_rebuilt(make_agent, monkeypatch):
    agent = make_agent("Hopper-v5").learn(30)
    model = agent.planner.model
    read_roots, failures = model.read_roots, [ForwardModelError("the environment has another simulator now.")]

    def fail_once(env_indices):
        if failures:
            raise failures.pop()
        return read_roots(env_indices)

    monkeypatch.setattr(model, "read_roots", fail_once)
    with pytest.warns(UserWarning, match=r"another simulator now\..*rebuilt"):
        agent.learn(10, reset_num_timesteps=False)
    assert agent.n_decisions == 20 and agent.planner.model is model


class RandomPush(gym.Wrapper):
    """Adds a random push to every action: the same action does not give the same step."""

    def step(self, action):
        return self.env.step(action + self.np_random.uniform(-0.5, 0.5, size=1).astype(np.float32))


def test_random_dynamics_are_simulated_with_generators_of_their_own(make_agent):
    agent = make_agent(RandomPush(gym.make("Pendulum-v1")))
    agent.learn(40)
    assert not agent.planner.model.deterministic
    assert agent.n_simulated_steps == 20 * 3 * 2 * 2


def test_a_tree_does_not_follow_the_luckiest_draw_once_dynamics_turn_out_random(make_agent, monkeypatch):
    """The batched simulator is given up for copies first, which are found to be random then."""
    agent = make_agent(
        "InvertedPendulum-v5", strategy="tree", n_simulations=1, search_kwargs=dict(branching=2)
    )
    agent.learn(30)
    assert agent.planner.model.kind == "mujoco"
    step = InvertedPendulumEnv.step
    gust = "step", lambda self, action: step(self, action + self.np_random.normal(scale=0.3, size=1))
    monkeypatch.setattr(InvertedPendulumEnv, *gust)
    with pytest.warns(UserWarning), pytest.raises(ValueError, match="the luckiest draw would win"):
        agent.learn(30, reset_num_timesteps=False)


def test_monitor_file_counts_only_real_episodes(make_agent, tmp_path):
    env = Monitor(gym.make("Pendulum-v1"), str(tmp_path / "run"))
    make_agent(env, rollout_depth=1).learn(410)
    rows = (tmp_path / "run.monitor.csv").read_text().splitlines()[2:]
    assert [row.split(",")[1] for row in rows] == ["200", "200"]


@pytest.mark.parametrize("cls", SEARCHING)
def test_callbacks_and_set_env(make_agent, tmp_path, cls):
    agent = make_agent("Pendulum-v1", cls=cls, verbose=0)
    callbacks = CallbackList(
        [
            CheckpointCallback(25, str(tmp_path)),
            EvalCallback(make_vec_env("Pendulum-v1", 1), n_eval_episodes=1, eval_freq=30, verbose=0),
        ]
    )
    agent.learn(60, callback=callbacks)
    assert (tmp_path / "rl_model_50_steps.zip").exists()
    agent.set_env(make_vec_env("Pendulum-v1", 1, seed=5))
    agent.learn(30, reset_num_timesteps=False)
    assert agent.n_decisions == 70 and agent.num_timesteps == 90


def test_environments_are_wrapped_in_place(make_agent):
    env = make_vec_env("Pendulum-v1", 2)
    agent = make_agent(env)
    assert all(isinstance(inner, SnapshotEnvWrapper) for inner in env.envs)
    assert agent.get_env() is env


def test_an_environment_that_moved_on_is_noticed(make_agent):
    agent = make_agent("Pendulum-v1").learn(30)
    agent.get_env().step(np.zeros((1, 1), dtype=np.float32))
    with pytest.raises(ValueError, match="present states"):
        agent._sample_action(0)
