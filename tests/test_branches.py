"""Simulated transitions of the current actor, against a plain loop over the environment."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs import MCBSSAC, MCBSTD3, MCBSCrossQ
from sb3_mcbs.agents.branches import Branches, n_rollouts
from sb3_mcbs.networks.functions import STOCHASTIC, target_actor
from tests.conftest import SEARCHING, snapshot_vec_env
from tests.test_value_expansion import GAMMA, STEPS, trained

LENGTH = 7


class KnownDraws:
    """Stands for a generator: rows, environments and lengths in this order, and no noise."""

    def __init__(self, *draws):
        self.draws = [np.asarray(draw) for draw in draws]

    def integers(self, low, high, size):
        return self.draws.pop(0)

    def standard_normal(self, shape, dtype):
        return np.zeros(shape, dtype)


def plain_loop(agent, env, snapshot, observation):
    """Follow the actor for ``STEPS`` steps.

    :return: for each step, from last to first: observation before, action, return to the end, discount,
        whether it terminated there, last observation.
    """
    act, normalizer = target_actor(agent), agent.get_vec_normalize_env()
    env.restore(snapshot)
    steps, terminated = [], False
    while len(steps) < STEPS and not terminated:
        before = observation
        seen = before[None] if normalizer is None else normalizer.normalize_obs(before[None])
        action, bonus = act(seen.astype(np.float32), KnownDraws())
        observation, reward, terminated, _, _ = env.step(agent.policy.unscale_action(action)[0])
        reward = reward if normalizer is None else float(normalizer.normalize_reward(np.array(reward)))
        steps.append([before, action[0], reward, bonus[0]])
    found, value = [], 0.0
    for number, (before, action, reward, bonus) in enumerate(reversed(steps), start=1):
        value = reward + GAMMA * value
        found.append((before, action, value, GAMMA**number, terminated, observation))
        value += bonus
    return found


@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("cls", [MCBSTD3, MCBSCrossQ])
def test_transitions_are_those_of_a_plain_loop(make_agent, cls, normalized):
    vec_env = VecNormalize(snapshot_vec_env("Hopper-v5", 2)) if normalized else None
    agent, taken = trained(make_agent, "Hopper-v5", cls=cls, env=vec_env, search_share=0.1)
    buffer, env = agent.replay_buffer, snapshot_vec_env("Hopper-v5").envs[0]
    env.reset(seed=0)
    rows, envs = (index.ravel() for index in np.meshgrid(np.arange(buffer.size()), np.arange(2)))
    branches = Branches(buffer, len(rows), STEPS, LENGTH)
    begun = buffer.expansion_held[rows, envs]
    draws = KnownDraws(rows, envs, np.full(begun.sum(), LENGTH))
    branches.go_on(buffer, agent, target_actor(agent), draws, agent.get_vec_normalize_env())
    expected = [
        plain_loop(agent, env, taken[row][number], buffer.next_observations[row, number])
        for row, number in zip(rows[begun], envs[begun], strict=True)
    ]
    assert any(steps[0][4] for steps in expected) and not all(begun), "ends of episodes are covered"
    # Steps are added from last to first.
    at = 0
    for number in reversed(range(STEPS)):
        for steps in expected:
            if len(steps) <= number:
                continue
            before, action, value, discount, terminated, last = steps[::-1][number]
            found = [array[at] for array in branches.transitions]
            np.testing.assert_allclose(found[0], before, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(found[1], action, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(found[2], last, rtol=1e-4, atol=1e-5)
            assert found[3] == terminated
            assert found[4] == pytest.approx(value, rel=1e-4, abs=1e-4)
            assert found[5] == pytest.approx(discount)
            at += 1
    assert branches.n_added == at
    ended = np.array([steps[0][4] for steps in expected])
    np.testing.assert_array_equal(branches.left[begun], np.where(ended, 0, LENGTH - STEPS))
    assert not branches.left[~begun].any()


def test_branches_go_on_where_they_were(make_agent):
    agent, _ = trained(make_agent, "HalfCheetah-v5", n_envs=1, cls=MCBSCrossQ, search_share=0.0)
    buffer, rng = agent.replay_buffer, np.random.default_rng(0)
    act, branches = target_actor(agent), Branches(buffer, 4, 2, 4)
    branches.go_on(buffer, agent, act, KnownDraws([1, 2, 3, 4], [0] * 4, [1, 2, 3, 4]), None)
    middle, left = branches.observations.copy(), branches.left.copy()
    assert left.tolist() == [-1, 0, 1, 2]
    branches.go_on(buffer, agent, act, rng, None)
    first = branches.transitions[0][12:16]  # of eight transitions the last step's come first
    goes_on = left > 0
    np.testing.assert_array_equal(first[goes_on], middle[goes_on])
    assert not np.isclose(first[~goes_on], middle[~goes_on]).all(axis=1).any()
    np.testing.assert_array_equal(branches.left, [2, 2, -1, 0])


def test_the_latest_transitions_are_kept(make_agent, monkeypatch):
    monkeypatch.setattr("sb3_mcbs.agents.branches.KEPT_UPDATES", 3)
    agent, _ = trained(make_agent, "HalfCheetah-v5", n_envs=1, search_share=0.0)
    branches = Branches(agent.replay_buffer, 5, 1, 50)
    rng = np.random.default_rng(0)
    last = []
    for _ in range(7):
        branches.go_on(agent.replay_buffer, agent, target_actor(agent), rng, None)
        last.append(branches.observations.copy())
    assert branches.n_added > len(branches) == 15
    held = {row.tobytes() for row in branches.transitions[2]}
    assert {row.tobytes() for row in np.concatenate(last[-3:])} <= held


@pytest.mark.parametrize("branch_length", [0, LENGTH])
def test_what_was_simulated_ahead_is_used_once_and_with_its_settings(make_agent, branch_length):
    agent, _ = trained(make_agent, "HalfCheetah-v5", n_envs=1, search_share=0.0, branch_length=branch_length)
    buffer = agent.replay_buffer

    def n_simulated(call):
        before = agent.n_simulated_steps
        call()
        return agent.n_simulated_steps - before

    def sample():
        return buffer.sample(16)

    ahead = buffer.next_simulation(16, None)
    assert n_simulated(ahead) > 0 == n_simulated(sample) < n_simulated(sample)
    for name, value in dict(gamma=0.5, value_expansion=1).items():
        buffer.next_simulation(16, None)()
        setattr(agent, name, value)
        assert n_simulated(sample) > 0
    buffer.next_simulation(16, None)()
    agent.set_env(snapshot_vec_env("HalfCheetah-v5"))
    assert n_simulated(sample) > 0
    buffer.next_simulation(16, None)()
    agent.branch_length = agent.value_expansion = 0
    assert n_simulated(sample) == n_simulated(buffer.next_simulation(16, None)) == 0
    agent.value_expansion, agent.branch_length = 1, branch_length
    assert n_simulated(sample) > 0  # not what an old actor did


def test_a_batch_can_be_sampled_on_a_device_while_another_waits_on_the_cpu(make_agent):
    agent, _ = trained(make_agent, "HalfCheetah-v5", n_envs=1, search_share=0.0)
    buffer = agent.replay_buffer
    buffer.next_simulation(16, None)()
    buffer.device = th.device("meta")  # as a GPU's, without numbers
    assert {field.device.type for field in buffer.sample(16)} == {"meta"}


@pytest.mark.parametrize(("n_sampled", "n_steps", "n"), [(128, 2, 32), (128, 1, 64), (100, 3, 17), (1, 5, 1)])
def test_transitions_are_used_twice(n_sampled, n_steps, n):
    assert n_rollouts(n_sampled, n_steps) == n


@pytest.mark.parametrize("cls", SEARCHING)
def test_agents_learn_from_both_parts(make_agent, cls, monkeypatch):
    batches = []
    sample = Branches.sample
    monkeypatch.setattr(Branches, "sample", lambda *a: batches.append(sample(*a)) or batches[-1])
    agent, _ = trained(
        make_agent,
        "HalfCheetah-v5",
        1,
        cls,
        batch_size=32,
        expanded_share=0.25,
        branch_length=9,
        search_share=0.0,
    )
    assert len(batches) == agent._n_updates and all(len(batch.actions) == 8 for batch in batches)
    # 60 executed steps are simulated too, to compare them.
    assert agent.n_simulated_steps == 60 + agent._n_updates * n_rollouts(8, STEPS) * STEPS
    noisy = np.concatenate([batch.actions for batch in batches])
    exact = target_actor(agent)(batches[-1].observations.numpy(), KnownDraws())[0]
    assert abs(noisy).max() <= 1 and not np.allclose(noisy[-8:], exact, atol=1e-3), "actions are explored"
    assert (cls in STOCHASTIC) or agent.beam_noise > 0


def test_a_changed_setting_begins_anew(make_agent, tmp_path):
    agent, _ = trained(make_agent, "HalfCheetah-v5", n_envs=1, branch_length=9, search_share=0.0)
    before = agent.branches
    agent.branch_length = 12
    agent.learn(10, reset_num_timesteps=False)
    assert agent.branches is not before and agent.branches.shape[2] == 12
    agent.branch_length = 0
    agent.learn(10, reset_num_timesteps=False)
    assert agent.branches is None, "switched on again, they would be those of an old actor"
    agent.save(tmp_path / "agent")
    loaded = MCBSTD3.load(tmp_path / "agent", env=agent.get_env())
    assert loaded.branches is None and loaded.branch_length == 0


def test_batches_of_another_size_do_not_begin_anew(make_agent):
    agent, _ = trained(make_agent, "HalfCheetah-v5", n_envs=1, branch_length=9, search_share=0.0)
    before, n_added = agent.branches, agent.branches.n_added
    assert len(agent.replay_buffer.sample(6).actions) == 6
    assert agent.branches is before and before.n_added > n_added


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (dict(branch_length=5), "value_expansion above 0"),
        (dict(branch_length=1, value_expansion=2), r"at least value_expansion \(2\)"),
        (dict(branch_length=-1, value_expansion=2), "branch_length"),
    ],
)
def test_what_does_not_go_together_is_refused(make_agent, settings, words):
    with pytest.raises(ValueError, match=words):
        make_agent("InvertedPendulum-v5", **settings)


@pytest.mark.parametrize("cls", [MCBSTD3, MCBSSAC])
def test_a_step_that_diverges_is_left_out(make_agent, cls, monkeypatch):
    agent, _ = trained(make_agent, "HalfCheetah-v5", n_envs=1, cls=cls, search_share=0.0)
    model = agent.planner.model
    step = model.step

    def diverging(actions):
        found = step(actions)
        found.observations[0], found.rewards[0], found.valid[0] = np.nan, np.inf, False
        return found

    monkeypatch.setattr(model, "step", diverging)
    branches = Branches(agent.replay_buffer, 4, 2, 50)
    for _ in range(3):
        branches.go_on(agent.replay_buffer, agent, target_actor(agent), np.random.default_rng(0), None)
    assert branches.n_added == 3 * 3 * 2 and branches.left[0] == 0
    assert all(np.isfinite(column).all() for column in branches.transitions)
