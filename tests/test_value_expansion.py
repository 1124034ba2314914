"""Targets of the critics that go on in the simulator, against a plain loop over the environment."""

from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium.envs.mujoco import inverted_pendulum_v5
from sb3_contrib.common.torch_layers import BatchRenorm1d
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_mcbs import MCBSDDPG, MCBSSAC, MCBSTD3, MCBSTQC, MCBSCrossQ, SearchPolicy
from sb3_mcbs.agents.expanded_buffer import ExpandedReplayBuffer
from sb3_mcbs.models import ForwardModelError
from sb3_mcbs.networks.functions import STOCHASTIC, policy_function, soft_policy_function
from tests.conftest import SEARCHING, snapshot_vec_env

AGENTS = SEARCHING
STEPS = 3
GAMMA = 0.9


class Snapshots(BaseCallback):
    """Takes a snapshot of every environment after every step, as the replay buffer's rows are counted."""

    def __init__(self) -> None:
        super().__init__()
        self.taken: list[list] = []

    def _on_step(self) -> bool:
        self.taken.append(self.training_env.env_method("snapshot"))
        return True


class FixedRows:
    """Stands for a generator that draws known places of a replay buffer."""

    def __init__(self, rows, envs):
        self.draws = [np.asarray(rows), np.asarray(envs)]

    def integers(self, low, high, size):
        return self.draws.pop(0)

    def standard_normal(self, shape, dtype):
        return np.zeros(shape, dtype)  # the actor's mean, whose entropy counts all the same


def trained(make_agent, env_id="Hopper-v5", n_envs=2, cls=MCBSTD3, env=None, **settings):
    settings = dict(value_expansion=STEPS, gamma=GAMMA, search_share=0.5) | settings
    if cls in (MCBSTD3, MCBSDDPG):
        n_actions = make_agent(env_id).action_space.shape[0]
        settings["action_noise"] = NormalActionNoise(np.zeros(n_actions), 0.3 * np.ones(n_actions))
    agent = make_agent(env or snapshot_vec_env(env_id, n_envs), cls=cls, **settings)
    snapshots = Snapshots()
    agent.learn(60 * n_envs, callback=snapshots)
    return agent, snapshots.taken


def entropy(agent, observations, actions):
    """What actions add to the value, ``-ent_coef * log pi(a|s)``, as SB3 computes it."""
    agent.policy.set_training_mode(False)
    with th.no_grad():
        mean, log_std, more = agent.actor.get_action_dist_params(th.as_tensor(observations))
        distribution = agent.actor.action_dist.proba_distribution(mean, log_std, **more)
        learned = agent.log_ent_coef is not None
        coefficient = agent.log_ent_coef.exp() if learned else agent.ent_coef_tensor
        return (-coefficient * distribution.log_prob(th.as_tensor(actions))).numpy()


def go_on(agent, env, snapshot, reward, next_observation):
    """The return of a transition that goes on with the target actor, by the environment's own step.

    :return: return, how many steps, whether it terminated, last observation.
    """
    policy, normalizer = policy_function(agent, target=True), agent.get_vec_normalize_env()

    def seen(observation):
        observation = np.asarray(observation)[None]
        return observation if normalizer is None else normalizer.normalize_obs(observation)

    def scaled(reward):
        return reward if normalizer is None else float(normalizer.normalize_reward(np.array(reward)))

    env.restore(snapshot)
    total, observation, terminated = scaled(reward), next_observation, False
    for length in range(1, STEPS + 1):
        scaled_action = policy(seen(observation))
        bonus = entropy(agent, seen(observation), scaled_action)[0] if isinstance(agent, STOCHASTIC) else 0.0
        observation, reward, terminated, _, _ = env.step(agent.policy.unscale_action(scaled_action)[0])
        total += GAMMA**length * (scaled(reward) + bonus)
        if terminated:
            return total, length + 1, True, observation
    return total, STEPS + 1, False, observation


@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize(
    ("env_id", "cls"), [("Hopper-v5", MCBSTD3), ("HalfCheetah-v5", MCBSSAC), ("HalfCheetah-v5", MCBSCrossQ)]
)
def test_samples_are_those_of_a_plain_loop(make_agent, env_id, cls, normalized):
    vec_env = VecNormalize(snapshot_vec_env(env_id, 2)) if normalized else snapshot_vec_env(env_id, 2)
    agent, taken = trained(make_agent, env_id, cls=cls, env=vec_env)
    buffer, env = agent.replay_buffer, snapshot_vec_env(env_id).envs[0]
    env.reset(seed=0)
    rows, envs = (index.ravel() for index in np.meshgrid(np.arange(buffer.size()), np.arange(2)))
    before = agent.n_simulated_steps
    sample = buffer.sample_expanded(len(rows), FixedRows(rows, envs), agent.get_vec_normalize_env())
    simulated, n_terminated, n_ended = 0, 0, 0
    for index, (row, number) in enumerate(zip(rows, envs, strict=True)):
        reward, last = buffer.rewards[row, number], buffer.next_observations[row, number]
        if buffer.dones[row, number]:  # nothing follows
            expected = reward if not normalized else vec_env.normalize_reward(reward)
            length, terminated = 1, not buffer.timeouts[row, number]
            n_ended += 1
        else:
            expected, length, terminated, last = go_on(agent, env, taken[row][number], reward, last)
            simulated += length - 1
            n_terminated += terminated
        assert sample.rewards[index].item() == pytest.approx(expected, rel=1e-4, abs=1e-4)
        assert sample.discounts[index].item() == pytest.approx(GAMMA**length)
        assert sample.dones[index].item() == terminated
        seen = last if not normalized else vec_env.normalize_obs(last)
        np.testing.assert_allclose(sample.next_observations[index], seen, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(sample.actions, buffer.actions[rows, envs])
    assert agent.n_simulated_steps - before == simulated
    for number in (n_terminated, n_ended):
        assert (number > 0) == (env_id == "Hopper-v5"), "terminations are covered where there are any"


@pytest.mark.parametrize("cls", AGENTS)
def test_agents_learn_from_both_parts(make_agent, cls, monkeypatch):
    sizes = []
    sample = ExpandedReplayBuffer.sample_expanded
    monkeypatch.setattr(
        ExpandedReplayBuffer,
        "sample_expanded",
        lambda self, n, *args: sizes.append(n) or sample(self, n, *args),
    )
    agent, _ = trained(make_agent, n_envs=1, cls=cls, batch_size=32, expanded_share=0.25)
    assert set(sizes) == {8} and agent._n_updates == len(sizes)


def test_with_worker_processes(make_agent):
    env = snapshot_vec_env("Hopper-v5", 2, vec_env_cls=SubprocVecEnv)
    agent, _ = trained(make_agent, env=env, expanded_share=0.5)
    assert agent.replay_buffer.expansion_held.any()
    env.close()


def test_nothing_else_is_drawn_differently(make_agent):
    """The search, the noise and the environments see no difference as long as nothing is learned."""
    plain, expanded = (
        trained(make_agent, n_envs=1, value_expansion=steps, gradient_steps=0)[0] for steps in (0, STEPS)
    )
    np.testing.assert_array_equal(plain.replay_buffer.actions, expanded.replay_buffer.actions)
    np.testing.assert_array_equal(plain.replay_buffer.rewards, expanded.replay_buffer.rewards)


def test_states_are_saved_with_the_replay_buffer(make_agent, tmp_path):
    agent, _ = trained(make_agent)
    agent.save(tmp_path / "agent")
    agent.save_replay_buffer(tmp_path / "buffer")
    loaded = MCBSTD3.load(tmp_path / "agent", env=agent.get_env())
    assert loaded.value_expansion == STEPS
    loaded.load_replay_buffer(tmp_path / "buffer")
    for name in ("expansion_states", "expansion_held"):
        np.testing.assert_array_equal(getattr(loaded.replay_buffer, name), getattr(agent.replay_buffer, name))
    loaded.learn(20, reset_num_timesteps=False)


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        (dict(value_expansion=-1), ValueError, "value_expansion"),
        (dict(value_expansion=1.5), TypeError, "value_expansion"),
        (dict(value_expansion=1, expanded_share=0.0), ValueError, "expanded_share above 0"),
        (dict(value_expansion=1, rollout_depth=0, n_simulations=1), ValueError, "rollout_depth of 1"),
        (dict(value_expansion=1, forward_model="ensemble"), ValueError, "does without"),
        (
            dict(
                value_expansion=1,
                optimize_memory_usage=True,
                replay_buffer_kwargs=dict(handle_timeout_termination=False),
            ),
            ValueError,
            "optimize_memory_usage",
        ),
        (dict(value_expansion=1, forward_model="pool"), ForwardModelError, "batched MuJoCo"),
    ],
)
def test_what_does_not_go_together_is_refused(make_agent, settings, error, words):
    with pytest.raises(error, match=words):
        make_agent("InvertedPendulum-v5", **settings)


def test_an_edited_simulator_is_followed_without_any_search(make_agent):
    agent = make_agent("InvertedPendulum-v5", value_expansion=1, search_share=0.0)
    agent.learn(40)
    assert agent.logger.name_to_value["search/model_error"] == 0.0 and agent.n_decisions == 0
    agent.get_env().envs[0].unwrapped.model.actuator_gear[:] *= 0.1
    with pytest.warns(UserWarning, match="edited"):
        agent.learn(10, reset_num_timesteps=False)
    env, model = agent.get_env().envs[0], agent.planner.model
    model.set_roots(agent.planner.read_states(), np.zeros(1, int), np.random.default_rng(0))
    action = np.array([[2.0]], dtype=np.float32)
    np.testing.assert_array_equal(model.step(action).observations[0], env.step(action[0])[0])


@pytest.mark.parametrize("branch_length", [0, 6])
def test_states_of_a_simulator_with_others_are_dropped(make_agent, branch_length, tmp_path):
    agent = make_agent(
        "InvertedPendulum-v5", value_expansion=2, search_share=0.0, branch_length=branch_length
    ).learn(40)
    model = Path(inverted_pendulum_v5.__file__).parent / "assets" / "inverted_pendulum.xml"
    ball = '<body pos="0 0 5"><geom type="sphere" size="0.1" contype="0" conaffinity="0"/></body>'
    (tmp_path / "ball.xml").write_text(model.read_text().replace("</worldbody>", ball + "</worldbody>"))
    env_kwargs = {"xml_file": str(tmp_path / "ball.xml")}
    agent.set_env(snapshot_vec_env("InvertedPendulum-v5", env_kwargs=env_kwargs))
    assert not agent.replay_buffer.expansion_held.any()
    agent.train(1, batch_size=16)
    agent.learn(30, reset_num_timesteps=False)
    held = agent.replay_buffer.expansion_held
    assert held[40:70].any() and not held[:40].any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("cls", AGENTS)
def test_every_executed_action_is_as_it_is_simulated(make_agent, cls, dtype):
    errors = []
    noise = NormalActionNoise(np.zeros(3), 0.3 * np.ones(3), dtype=dtype)
    vec_env = VecNormalize(snapshot_vec_env("Hopper-v5", 2))
    agent = make_agent(vec_env, cls=cls, value_expansion=1, search_share=0.5, action_noise=noise)
    verify = agent.planner.verify
    agent.planner.verify = lambda *step: errors.append(verify(*step)) or errors[-1]
    agent.learn(200)
    assert errors == [0.0] * 100, "warm-up, searched and not searched, the last step of an episode"
    assert agent.replay_buffer.dones.any()


@pytest.mark.parametrize(
    "cls, sde, ent_coef",
    [
        (MCBSSAC, False, 0.2),
        (MCBSTQC, False, "auto_0.2"),
        (MCBSSAC, False, "auto_0.2"),
        (MCBSSAC, True, 0.2),
        (MCBSCrossQ, False, "auto_0.2"),
        (MCBSCrossQ, True, 0.2),
    ],
)
def test_soft_actions_and_their_entropy_are_sb3s(make_agent, cls, sde, ent_coef):
    agent = make_agent("Hopper-v5", cls=cls, use_sde=sde, ent_coef=ent_coef)
    observations = (
        np.random.default_rng(0).normal(size=(4000, 11)).astype(np.float32)[:1].repeat(4000, axis=0)
    )
    draw = soft_policy_function(agent)
    actions, bonus = draw(observations, np.random.default_rng(1))
    again, _ = draw(observations, np.random.default_rng(1))
    np.testing.assert_array_equal(actions, again)
    np.testing.assert_allclose(bonus, entropy(agent, observations, actions), rtol=1e-3, atol=1e-3)
    if sde:  # its exploration matrix is drawn once for all rows
        agent.actor.reset_noise(4000)
    theirs, log_prob = agent.actor.action_log_prob(th.as_tensor(observations))
    np.testing.assert_allclose(actions.mean(axis=0), theirs.detach().mean(dim=0), atol=0.05)
    np.testing.assert_allclose(actions.std(axis=0), theirs.detach().std(dim=0), atol=0.05)
    assert bonus.mean() == pytest.approx(-0.2 * log_prob.mean().item(), abs=0.05)


def test_statistics_of_crossq_are_of_its_own_batches_only(make_agent):
    """Neither expansion, which CrossQ's ``train`` asks for in training mode, nor a search is a batch."""
    agent, _ = trained(make_agent, cls=MCBSCrossQ)
    env = snapshot_vec_env("Hopper-v5")
    SearchPolicy(agent, env, seed=0).predict(env.reset())

    def batches(network):
        return {int(layer.steps) for layer in network.modules() if isinstance(layer, BatchRenorm1d)}

    assert agent.n_decisions > 0 and agent._n_updates > agent.policy_delay
    assert batches(agent.critic) == {agent._n_updates}
    assert batches(agent.actor) == {agent._n_updates // agent.policy_delay}


def test_rows_that_somebody_else_adds_are_not_expanded(make_agent):
    agent = make_agent("InvertedPendulum-v5", value_expansion=2, expanded_share=1.0)
    agent.env.reset()
    row = np.zeros((1, 4), dtype=np.float32)
    for _ in range(20):
        agent.replay_buffer.add(row, row, np.zeros((1, 1)), np.ones(1), [False], [{}])
    assert not agent.replay_buffer.expansion_held.any()
    assert (agent.replay_buffer.sample(16).rewards == 1).all()


def test_a_replay_buffer_is_handed_on_to_an_agent_without_expansion(make_agent):
    expanding, plain = make_agent("InvertedPendulum-v5", value_expansion=2), make_agent("InvertedPendulum-v5")
    plain.replay_buffer = expanding.learn(40).replay_buffer
    plain.learn(30)
    assert type(plain.replay_buffer) is ReplayBuffer and plain.replay_buffer.pos == 70
    assert not hasattr(plain.replay_buffer, "expansion_states")
