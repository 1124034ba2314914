"""Plans of the cross-entropy method: shifted from decision to decision, dropped where an episode ended."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_mcbs import CEMSettings, SearchPolicy, SnapshotEnvWrapper
from sb3_mcbs.search import Roots, WarmStart, search
from tests.checkpoint_helpers import assert_resumed_is_exact
from tests.conftest import snapshot_vec_env
from tests.fake_model import LineWorld
from tests.test_search import AGENT

PLANS = np.arange(1, 13, dtype=np.float32).reshape(2, 3, 2)


def kept(clocks) -> WarmStart:
    memory = WarmStart(2, 3, 2)
    memory.keep(PLANS, [0, 1], clocks)
    return memory


def test_plans_are_shifted_by_the_steps_since_then():
    memory = kept([(1, 5), (4, 0)])
    np.testing.assert_array_equal(memory.recall([0, 1], [(1, 5), (4, 0)]), PLANS)
    recalled = memory.recall([0, 1], [(1, 6), (4, 2)])
    np.testing.assert_array_equal(recalled[0], [*PLANS[0, 1:], [0, 0]])
    np.testing.assert_array_equal(recalled[1], [PLANS[1, 2], [0, 0], [0, 0]])
    assert not memory.recall([0, 1], [(1, 8), (4, 1000)]).any(), "nothing is left of them"


def test_plans_are_dropped_where_an_episode_ended():
    memory = kept([(1, 5), (4, 0)])
    recalled = memory.recall([0, 1], [(2, 6), (4, 1)])
    assert not recalled[0].any() and recalled[1].any()
    assert not memory.recall([0, 1], [(1, 4), (5, 1)]).any(), "nor is a plan recalled from the future"
    assert not WarmStart(2, 3, 2).recall([0, 1], [(0, 0), (0, 0)]).any(), "nor one that never was"


def test_the_state_is_plain_and_independent_of_earlier_resets():
    memory = kept([(7, 5), (4, 2)])
    state = memory.state([(7, 6), (5, 0)])
    assert state["ages"] == [1, -1]
    other = WarmStart(2, 3, 2)
    other.set_state(state, [(1, 0), (1, 0)])  # just restored from a snapshot
    recalled = other.recall([0, 1], [(1, 0), (1, 0)])
    np.testing.assert_array_equal(recalled[0], memory.recall([0, 1], [(7, 6), (5, 0)])[0])
    assert not recalled[1].any()
    assert other.recall([0, 1], [(1, 1), (1, 1)])[0, 0].tolist() == PLANS[0, 2].tolist()
    assert not other.recall([0, 1], [(2, 0), (2, 0)]).any()


def test_a_wrapper_tells_moments_apart():
    env = SnapshotEnvWrapper(gym.make("Pendulum-v1"))
    clocks = [env.episode_clock]
    env.reset(seed=0)
    clocks.append(env.episode_clock)
    snapshot = env.snapshot()
    for _ in range(2):
        env.step(env.action_space.sample())
        clocks.append(env.episode_clock)
    env.restore(snapshot)
    clocks.append(env.episode_clock)
    assert clocks == [(0, 0), (1, 0), (1, 1), (1, 2), (2, 0)]
    env.close()


def test_decisions_start_around_what_is_left_of_the_last_plan():
    """The first plan of a round is the mean, so it shows what was remembered."""
    settings = CEMSettings(8, 3, beam_noise=0.3)
    memory, rng, x = WarmStart(1, 3, 1), np.random.default_rng(0), 1.0
    for moment in [(1, 0), (1, 1), (1, 2), (2, 0), (2, 2)]:
        expected = AGENT.policy(np.array([[x]])) + memory.recall([0], [moment])[:, 0]
        roots, plans = Roots(LineWorld(), [x], np.array([[x]])), memory.recall([0], [moment])
        result = search(roots, AGENT, settings, rng, plans=plans)
        memory.keep(result.plans, [0], [moment])
        np.testing.assert_allclose(result.candidates[0, 0], np.clip(expected[0], -1, 1), rtol=1e-6)
        is_policy = result.candidates[0, 0] == AGENT.policy(np.array([[x]]))[0]
        assert is_policy == (moment in [(1, 0), (2, 0)])
        x = float(result.first_step.observations[0, 0])


CEM = dict(
    strategy="cem",
    beam_width=4,
    rollout_depth=3,
    search_kwargs=dict(n_rounds=2),
    n_simulations=1,
    beam_noise=0.3,
)


def recalled(planner) -> np.ndarray:
    everywhere = planner._all_envs
    return planner._warm_start.recall(everywhere, planner._clocks(everywhere))


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_episodes_of_vectorized_environments(make_agent, vec_env_cls):
    """Each environment's episodes end at other times, and end by themselves."""
    agent = make_agent("InvertedPendulum-v5", rollout_depth=0, n_simulations=1)
    env = snapshot_vec_env("InvertedPendulum-v5", 2, vec_env_cls=vec_env_cls)
    policy = SearchPolicy(agent, env, seed=0, **CEM)
    observations = env.reset()
    assert not recalled(policy.planner).any()
    ends = [0, 0]
    for _ in range(25):
        policy.predict(observations)
        # Full force to either side, so that both poles fall, one after the other.
        observations, _, dones, _ = env.step(np.array([[3.0], [-2.0]], dtype=np.float32))
        np.testing.assert_array_equal(recalled(policy.planner).any(axis=(1, 2)), ~dones)
        ends = [count + int(done) for count, done in zip(ends, dones, strict=True)]
    assert min(ends) > 0
    env.reset()
    assert not recalled(policy.planner).any()
    policy.close()
    env.close()


def test_a_seed_gives_the_same_returns_whatever_was_before(make_agent):
    """An episode is the same whether or not another one, whose plans are dropped, came before."""
    agent = make_agent(rollout_depth=0, n_simulations=1)
    env = snapshot_vec_env("Pendulum-v1", env_kwargs=dict(max_episode_steps=15))

    def episode(policy, seed):
        policy.rng = np.random.default_rng(3)
        env.seed(seed)
        return evaluate_policy(policy, env, 1)[0]

    policy = SearchPolicy(agent, env, **CEM)
    first, other, again = (episode(policy, seed) for seed in (1, 2, 1))
    assert first == again != other
    assert policy.planner.memory["plans"]["plans"].any(), "there were plans to be dropped"
    policy.close()


def test_a_restored_search_goes_on_as_if_it_had_never_stopped(make_agent):
    agent = make_agent("InvertedPendulum-v5", rollout_depth=0, n_simulations=1)

    def start():
        env = DummyVecEnv([lambda: SnapshotEnvWrapper(gym.make("InvertedPendulum-v5"))])
        env.seed(0)
        return env, SearchPolicy(agent, env, seed=0, **CEM), env.reset()

    env, policy, observations = start()
    for _ in range(3):
        actions, _ = policy.predict(observations)
        observations, *_ = env.step(actions)
    memory, snapshot = policy.planner.memory, env.envs[0].snapshot()
    assert memory["plans"]["ages"] == [1] and memory["plans"]["plans"].any()

    env_b, policy_b, _ = start()
    env_b.envs[0].restore(snapshot)
    policy_b.planner.memory = memory
    policy_b.rng.bit_generator.state = policy.rng.bit_generator.state
    np.testing.assert_array_equal(recalled(policy_b.planner), recalled(policy.planner))
    expected, _ = policy.predict(observations)
    actions, _ = policy_b.predict(observations)
    np.testing.assert_array_equal(actions, expected)
    for strategy in ("beam", "tree"):
        other = SearchPolicy(agent, env, strategy=strategy, rollout_depth=2)
        assert other.planner.memory["plans"] is None
        other.close()


@pytest.mark.parametrize("strategy", ["tree", "cem"])
def test_agents_train_with_every_strategy(make_agent, strategy, make_dict_env):
    agent = make_agent(
        make_dict_env(),
        policy="MultiInputPolicy",
        strategy=strategy,
        beam_width=6,
        search_kwargs=dict(branching=2, n_proposals=18) if strategy == "tree" else dict(n_proposals=18),
    )
    agent.learn(28)  # later this actor is at its limits, where the best plan is to leave it alone
    assert agent.n_decisions == 8 and agent.n_simulated_steps > 0
    state = agent.planner.memory["plans"]
    if strategy == "tree":
        assert state is None
    else:
        assert state["ages"] == [1] and state["plans"].any()


@pytest.mark.parametrize("env_id, n_envs", [("Pendulum-v1", 1), ("InvertedPendulum-v5", 2)])
def test_a_run_that_is_resumed_remembers_its_plans(make_agent, tmp_path, env_id, n_envs, monkeypatch):
    restored = []
    set_state = WarmStart.set_state
    monkeypatch.setattr(
        WarmStart,
        "set_state",
        lambda self, state, now: restored.append(state) or set_state(self, state, now),
    )
    search = {**CEM, "rollout_depth": 2, "search_kwargs": {"n_rounds": 1}, "buffer_size": 200}

    def make(folder):
        return make_agent(snapshot_vec_env(env_id, n_envs), **search)

    whole, resumed = assert_resumed_is_exact(
        make, tmp_path, 90, 65, make_env=lambda folder: snapshot_vec_env(env_id, n_envs)
    )
    (state,) = restored
    assert state["ages"] == [1] * n_envs and state["plans"].any(axis=(1, 2)).all()
    np.testing.assert_array_equal(*(recalled(agent.planner) for agent in (whole, resumed)))
