"""Learning from the search's rollouts."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_mcbs import MCBSTD3
from sb3_mcbs.agents.rollout_replay import RolloutReplay
from sb3_mcbs.search import Rollouts, SearchSettings, beam_search, draw_noise
from tests.checkpoint_helpers import assert_resumed_is_exact
from tests.conftest import SEARCHING, snapshot_vec_env
from tests.fake_model import LineWorld
from tests.test_search import AGENT, policy

GAMMA = 0.9


@pytest.mark.parametrize("limit", [np.inf, 1.4, 0.5], ids=["endless", "terminates", "terminates-at-once"])
@pytest.mark.parametrize("width, depth, sims", [(1, 1, 1), (6, 3, 5), (4, 1, 3), (3, 7, 2)])
@pytest.mark.parametrize("spread", [0.0, 1e-9], ids=["shared-first-step", "random"])
def test_what_is_recorded_is_what_the_rollouts_went_through(width, depth, sims, limit, spread):
    model = LineWorld(limit, bad_action=0.9, spread=spread)
    settings = SearchSettings(width, depth, sims, beam_noise=0.5)
    roots = [0.3, -1.2, 1.0]
    noise = draw_noise(np.random.default_rng(0), settings, len(roots), 1)
    observations, rng = np.asarray(roots)[:, None], np.random.default_rng(1)
    result = beam_search(model, roots, observations, AGENT, settings, noise, rng, record=True)
    rollouts = result.rollouts
    for env, root in enumerate(roots):
        for number in range(width * sims):
            candidate, simulation = divmod(number, sims)
            action, x = result.candidates[env, candidate, 0], root
            np.testing.assert_array_equal(rollouts.actions[env, number], [action])
            rewards, valid, terminated = [], True, False
            for step in range(depth):
                x += float(action)
                rewards.append(-(x**2))
                valid, terminated = action <= 0.9, abs(x) > limit
                if not valid or terminated:
                    break
                eta = noise.rollout[step, env, candidate, simulation, 0]
                action = np.clip(policy(np.array([[x]]))[0, 0] + eta, -1, 1)
            assert rollouts.lengths[env, number] == (len(rewards) if valid else 0)
            if valid:
                padded = [*rewards, *[0.0] * (depth - len(rewards))]
                np.testing.assert_allclose(rollouts.rewards[env, number], padded, rtol=1e-5, atol=1e-7)
                assert rollouts.terminated[env, number] == terminated
                np.testing.assert_allclose(rollouts.observations[env, number], [x], rtol=1e-5, atol=1e-7)
    unrecorded = beam_search(model, roots, observations, AGENT, settings, noise, rng)
    assert unrecorded.rollouts is None


class Numbers:
    """A replay buffer with rollouts of made-up numbers that tell where they are from."""

    def __init__(self, size: int, n_envs: int, n_rollouts: int, depth: int) -> None:
        env = snapshot_vec_env("Pendulum-v1", n_envs)
        spaces = env.observation_space, env.action_space
        self.buffer = ReplayBuffer(size * n_envs, *spaces, device="cpu", n_envs=n_envs)
        self.store = RolloutReplay(self.buffer, n_rollouts, depth)
        self.shape = (n_envs, n_rollouts)
        self.depth, self.rng = depth, np.random.default_rng(0)

    def add(self, lengths) -> None:
        shape, rng = self.shape, self.rng
        lengths = np.broadcast_to(lengths, shape)
        rollouts = Rollouts(
            rng.normal(size=(*shape, 1)).astype(np.float32),
            rng.normal(size=(*shape, self.depth)) * (np.arange(self.depth) < lengths[..., None]),
            lengths,
            rng.random(shape) < 0.5,
            rng.normal(size=(*shape, 3)).astype(np.float32),
        )
        self.store.put(self.buffer.pos, rollouts if lengths.any() else None)
        observations = rng.normal(size=(shape[0], 3)).astype(np.float32)
        nothing = np.zeros(shape[0])
        self.buffer.add(observations, observations, nothing, nothing, nothing, [{}] * shape[0])


@pytest.mark.parametrize("sparse", [False, True])
def test_samples_are_transitions_of_several_steps(sparse):
    numbers = Numbers(size=300, n_envs=2, n_rollouts=3, depth=4)
    for step in range(280):
        lengths = numbers.rng.integers(0, 5, (2, 3)) if step % (100 if sparse else 2) == 1 else 0
        numbers.add(lengths)
    buffer, rng = numbers.buffer, np.random.default_rng(5)
    samples = numbers.store.sample(3000, GAMMA, rng, None)
    by_action = {}
    for row, env, k in zip(*np.nonzero(buffer.rollout_lengths), strict=True):
        by_action[float(buffer.rollout_actions[row, env, k, 0])] = (row, env, k)
    assert len(by_action) == numbers.store.count
    drawn = {float(action) for action in samples.actions[:, 0]}
    assert drawn <= by_action.keys() and len(drawn) > 0.9 * min(len(by_action), 3000 / 3)
    for i in range(0, 3000, 7):
        place = by_action[float(samples.actions[i, 0])]
        length = buffer.rollout_lengths[place]
        rewards = buffer.rollout_rewards[place][:length]
        value = sum(GAMMA**step * reward for step, reward in enumerate(rewards))
        np.testing.assert_allclose(samples.rewards[i, 0], value, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(samples.discounts[i, 0], GAMMA**length, rtol=1e-6)
        assert samples.dones[i, 0] == buffer.rollout_terminated[place]
        np.testing.assert_array_equal(samples.observations[i], buffer.observations[place[:2]])
        np.testing.assert_array_equal(samples.next_observations[i], buffer.rollout_observations[place])


def test_a_full_buffer_forgets_the_rollouts_of_overwritten_rows():
    numbers = Numbers(size=10, n_envs=2, n_rollouts=3, depth=2)
    for _ in range(7):
        numbers.add(2)
    assert numbers.store.count == 42
    for _ in range(6):
        numbers.add(0)
    assert numbers.store.count == 24 and np.count_nonzero(numbers.buffer.rollout_lengths) == 24
    numbers.add([[1, 0, 1], [0, 0, 1]])
    assert numbers.store.count == 21
    for _ in range(10):
        numbers.add(0)
    assert numbers.store.count == 0


def batches_of(agent, monkeypatch):
    """What the gradient steps are given, by the number of rollouts in it."""
    drawn = []
    sample = RolloutReplay.sample

    def spy(store, n, gamma, rng, env):
        drawn.append((n, sample(store, n, gamma, rng, env)))
        return drawn[-1][1]

    monkeypatch.setattr(RolloutReplay, "sample", spy)
    return drawn


@pytest.mark.parametrize("cls", SEARCHING)
@pytest.mark.parametrize("share, n_steps", [(0.25, 1), (0.5, 3), (1.0, 1)])
def test_agents_learn_from_rollouts(make_agent, monkeypatch, cls, share, n_steps):
    agent = make_agent(snapshot_vec_env("Pendulum-v1", 2), cls=cls, rollout_replay=share, n_steps=n_steps)
    drawn = batches_of(agent, monkeypatch)
    buffer = agent.replay_buffer
    agent.learn(60)
    assert agent.replay_buffer is buffer
    assert {n for n, _ in drawn} == {round(16 * share)} and len(drawn) == agent._n_updates > 15
    # Rollouts are no experience: neither environment steps nor rows grow by them.
    assert (agent.num_timesteps, buffer.pos) == (60, 30)
    assert agent.logger.name_to_value["search/stored_rollouts"] == 20 * 2 * 3 * 2
    assert agent.n_simulated_steps == 20 * 2 * (3 + 3 * 2)


def test_the_fast_update_uses_them_as_sb3s_does(make_agent):
    agents = [make_agent(rollout_replay=0.5, fast_update=fast, gradient_steps=0) for fast in (True, False)]
    for agent in agents:
        agent.set_random_seed(1)
        agent.learn(40)
        agent.set_random_seed(2)
        agent.train(4, 16)
    for ours, theirs in zip(*(agent.policy.parameters() for agent in agents), strict=True):
        th.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("cls", SEARCHING)
def test_every_environment_is_simulated_but_only_scheduled_ones_are_executed(make_agent, cls):
    agents = [
        make_agent(
            snapshot_vec_env("Pendulum-v1", 2),
            cls=cls,
            search_share=0.0,
            rollout_replay=share,
            gradient_steps=0,
            action_noise=NormalActionNoise(np.zeros(1), 0.2 * np.ones(1)),
        )
        for share in (0.0, 0.5)
    ]
    for agent in agents:
        agent.set_random_seed(1)
        agent.learn(60)
    plain, learning = agents
    np.testing.assert_array_equal(plain.replay_buffer.actions, learning.replay_buffer.actions)
    assert plain.n_decisions == 0 and learning.n_decisions == 40
    lengths = learning.replay_buffer.rollout_lengths
    assert (lengths[10:30, :, :6] == 2).all() and not lengths[:10].any(), "none of the random actions before"


@pytest.mark.parametrize("cls", SEARCHING)
def test_normalised_and_dict_observations(make_agent, make_dict_env, cls):
    env = VecNormalize(DummyVecEnv([make_dict_env]))
    agent = make_agent(env, cls=cls, policy="MultiInputPolicy", rollout_replay=0.5)
    agent.learn(60)
    store = agent._simulated_batches._rollout_replay()
    buffer = agent.replay_buffer
    last = buffer.rollout_observations["angle"][40, 0, 0]
    assert abs(np.linalg.norm(last) - 1) < 1e-5, "as the environment returns them, not normalised"
    samples = store.sample(50, agent.gamma, np.random.default_rng(0), env)
    raw = store.sample(50, agent.gamma, np.random.default_rng(0), None)
    expected = env.normalize_obs({key: value.numpy() for key, value in raw.next_observations.items()})
    for key, value in samples.next_observations.items():
        np.testing.assert_allclose(value, expected[key], rtol=1e-5)
    scale = np.sqrt(env.ret_rms.var + env.epsilon)
    np.testing.assert_allclose(samples.rewards, raw.rewards / scale, rtol=1e-4)


@pytest.mark.parametrize("cls", SEARCHING)
def test_rollouts_are_saved_with_the_replay_buffer(make_agent, tmp_path, cls):
    agent = make_agent(cls=cls, rollout_replay=0.5)
    agent.learn(60)
    agent.save(tmp_path / "agent")
    agent.save_replay_buffer(tmp_path / "buffer")
    loaded = cls.load(tmp_path / "agent", env=snapshot_vec_env("Pendulum-v1"))
    assert loaded.rollout_replay == 0.5 and loaded._simulated_batches._rollout_replay().count == 0
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert (
        loaded._simulated_batches._rollout_replay().count
        == agent._simulated_batches._rollout_replay().count
        > 0
    )
    for name in ("actions", "rewards", "lengths", "terminated", "observations"):
        np.testing.assert_array_equal(
            getattr(loaded.replay_buffer, f"rollout_{name}"), getattr(agent.replay_buffer, f"rollout_{name}")
        )
    loaded.learn(30, reset_num_timesteps=False)


def test_rollouts_of_another_size_are_not_dropped_silently(make_agent, tmp_path, caplog):
    agent = make_agent(rollout_replay=0.5).learn(60)
    agent.save(tmp_path / "agent")
    agent.save_replay_buffer(tmp_path / "buffer")
    loaded = MCBSTD3.load(tmp_path / "agent", env=snapshot_vec_env("Pendulum-v1"), beam_width=2)
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.learn(30, reset_num_timesteps=False)
    assert "rollouts of the replay buffer are dropped" in caplog.text


@pytest.mark.parametrize(
    "cls, env_id, n_envs, size",
    [(MCBSTD3, "InvertedPendulum-v5", 2, 2000), *((cls, "Pendulum-v1", 1, 100) for cls in SEARCHING)],
)
def test_a_resumed_run_learns_from_the_same_rollouts(make_agent, tmp_path, cls, env_id, n_envs, size):
    def make_env(folder):
        return snapshot_vec_env(env_id, n_envs)

    def make(folder):
        noise = NormalActionNoise(np.zeros(1), 0.2 * np.ones(1))
        settings = dict(rollout_replay=0.5, search_share=0.5, action_noise=noise, buffer_size=size)
        return make_agent(make_env(folder), cls=cls, **settings)

    whole, resumed = assert_resumed_is_exact(make, tmp_path, 180, 130, make_env=make_env)
    assert (
        whole._simulated_batches._rollout_replay().count
        == resumed._simulated_batches._rollout_replay().count
        > 0
    )
    assert whole.rollout_rng.bit_generator.state == resumed.rollout_rng.bit_generator.state


@pytest.mark.parametrize(
    "settings, words",
    [
        (dict(rollout_replay=1.1), "rollout_replay"),
        (dict(rollout_replay=np.nan), "rollout_replay"),
        (dict(rollout_replay=0.5, rollout_depth=0, n_simulations=1), "rollout_depth of 1"),
        (dict(rollout_replay=0.5, strategy="tree"), "strategy='beam'"),
        (dict(rollout_replay=0.5, time_budget=0.01), "strategy='beam'"),
    ],
)
@pytest.mark.parametrize("cls", SEARCHING)
def test_what_makes_no_sense_is_refused(make_agent, cls, settings, words):
    with pytest.raises(ValueError, match=words):
        make_agent(cls=cls, **settings)


class Counting(gym.Env):
    """A point whose observation has a discrete part, a plain int as Gymnasium's spaces sample it."""

    observation_space = spaces.Dict(x=spaces.Box(-10, 10, (2,), np.float32), count=spaces.Discrete(3))
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = np.zeros(2, dtype=np.float32), 0
        return self._observe(), {}

    def step(self, action):
        self.x, self.t = self.x + np.float32(0.1) * action[0], self.t + 1
        return self._observe(), -float(abs(self.x[0] - 1)), False, self.t >= 7, {}

    def _observe(self):
        return {"x": self.x.copy(), "count": self.t % 3}


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("cls", SEARCHING)
def test_discrete_parts_of_observations(make_agent, cls, share):
    agent = make_agent(DummyVecEnv([Counting] * 2), cls=cls, policy="MultiInputPolicy", rollout_replay=share)
    agent.learn(80)
    if share:
        held = agent.replay_buffer.rollout_observations["count"]
        assert held.shape[-1] == 1 and set(np.unique(held)) == {0, 1, 2}


def test_rollouts_whose_observation_is_overwritten_are_forgotten(make_agent, monkeypatch):
    """With optimize_memory_usage the last observation of a step is the first of the next row."""
    agent = make_agent(
        "InvertedPendulum-v5",
        buffer_size=40,
        rollout_replay=0.5,
        optimize_memory_usage=True,
        replay_buffer_kwargs=dict(handle_timeout_termination=False),
    )
    agent.learn(100)
    buffer = agent.replay_buffer
    assert buffer.full and not buffer.rollout_lengths[buffer.pos].any()
    assert buffer.rollout_count == np.count_nonzero(buffer.rollout_lengths) > 0
    searcher, held = agent._searcher, np.argwhere(buffer.rollout_lengths > 0)
    assert len(np.unique(held[:, 0])) == 39 and searcher is not None


@pytest.mark.parametrize("cls", SEARCHING)
def test_parts_are_never_more_than_the_batch(make_agent, cls):
    shares = dict(rollout_replay=0.5, value_expansion=1, expanded_share=0.5)
    agent = make_agent("InvertedPendulum-v5", cls=cls, batch_size=7, **shares)
    agent.learn(40)
    assert agent._n_updates > 0
