"""Snapshots of real environments: what follows a restore is bit-identical, wherever it is restored."""

import os
import pickle
import random
import subprocess
import sys

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.wrappers import (
    DelayObservation,
    FrameStackObservation,
    NormalizeObservation,
    NormalizeReward,
    RecordEpisodeStatistics,
    StickyAction,
    TimeAwareObservation,
)
from stable_baselines3.common.monitor import Monitor

from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotMismatchError

MUJOCO = [
    name
    for name, spec in gym.registry.items()
    if str(spec.entry_point).startswith("gymnasium.envs.mujoco.") and name.endswith(("-v4", "-v5"))
]
# Gymnasium refuses to make it with MuJoCo 3 or later.
MUJOCO.remove("Pusher-v4")
IDS = [*MUJOCO, "Pendulum-v1", "MountainCarContinuous-v0"]

pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore:.*The environment .* is out of date"
)


def exact(value):
    """Return a value in a form that compares equal only if every bit is equal."""
    if isinstance(value, dict):
        return {key: exact(item) for key, item in value.items() if key != "t"}
    if isinstance(value, tuple | list):
        return [exact(item) for item in value]
    array = np.asarray(value)
    return array.dtype.str, array.shape, array.tobytes()


def follow(env, actions):
    """Step an environment and return everything that it says."""
    return [exact(env.step(action)) for action in actions]


def actions_for(env, n, seed=0):
    rng = np.random.default_rng(seed)
    space = env.action_space
    return [rng.uniform(space.low, space.high).astype(space.dtype) for _ in range(n)]


def make(name, *wrappers, **arguments):
    env = gym.make(name, **arguments)
    for wrapper in wrappers:
        env = wrapper(env)
    return SnapshotEnvWrapper(env)


def all_data(data):
    """Return every array and number of an ``MjData``."""
    fields = {}
    for name in dir(type(data)):
        # MuJoCo cannot set the signature, which says what was compiled and takes no part in the simulation.
        if not name.startswith("_") and name not in ("signature", "model"):
            value = getattr(data, name)
            if isinstance(value, np.ndarray | bool | int | float):
                fields[name] = exact(value)
    fields["warnings"] = [(item.lastinfo, item.number) for item in data.warning]
    fields["contacts"] = [exact([contact.dist, contact.pos, contact.geom]) for contact in data.contact]
    return fields


@pytest.mark.parametrize("name", IDS)
def test_same_future_everywhere(name):
    env, other = make(name), make(name)
    before, after = actions_for(env, 12), actions_for(env, 5, seed=1)
    env.reset(seed=3)
    at_reset = env.snapshot()
    from_reset = follow(env, before)
    middle = env.snapshot()
    expected = follow(env, after)
    assert from_reset[-5:] != expected

    for _ in range(2):
        env.restore(middle)
        assert follow(env, after) == expected
    other.reset(seed=4)
    follow(other, after)
    other.restore(middle)
    clone = other.clone()
    assert follow(other, after) == expected
    assert follow(clone, after) == expected
    clone.restore(pickle.loads(pickle.dumps(middle)))
    assert follow(clone, after) == expected
    other.restore(at_reset)
    assert follow(other, before) == from_reset


@pytest.mark.parametrize("name", ["HalfCheetah-v5", "Pendulum-v1", "Reacher-v5"])
def test_next_episodes_are_the_same_too(name):
    env, other = make(name), make(name)
    env.reset(seed=0)
    env.action_space.seed(5)
    env.action_space.sample()
    state = env.snapshot()
    expected = exact([env.action_space.sample(), env.reset(), env.reset()])
    other.reset(seed=1)
    other.restore(state)
    assert exact([other.action_space.sample(), other.reset(), other.reset()]) == expected


def test_another_process(tmp_path):
    work = {}
    for name in ("HalfCheetah-v5", "Ant-v5", "Reacher-v4", "Pendulum-v1"):
        env = make(name, Monitor, NormalizeObservation)
        actions = actions_for(env, 10)
        env.reset(seed=2)
        follow(env, actions[:5])
        state = env.snapshot()
        work[name] = (state, actions[5:], [result[:4] for result in follow(env, actions[5:])])
    path = tmp_path / "work.pkl"
    path.write_bytes(pickle.dumps(work))
    script = (
        "import pickle, sys; sys.path.insert(0, sys.argv[2]); import test_snapshot as t\n"
        "for name, (state, actions, expected) in pickle.load(open(sys.argv[1], 'rb')).items():\n"
        "    env = t.make(name, t.Monitor, t.NormalizeObservation); env.restore(state)\n"
        "    assert [r[:4] for r in t.follow(env, actions)] == expected, name\n"
    )
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script, path, os.path.dirname(__file__)], check=True
    )


@pytest.mark.parametrize("name", ["Ant-v5", "Reacher-v4"])
def test_whole_simulator_is_restored(name):
    env = make(name)
    env.reset(seed=0)
    follow(env, actions_for(env, 30))
    state, expected = env.snapshot(), all_data(env.unwrapped.data)
    sent = pickle.loads(pickle.dumps(state))
    for given in (state, sent):
        follow(env, actions_for(env, 4))
        assert all_data(env.unwrapped.data) != expected
        env.restore(given)
        assert all_data(env.unwrapped.data) == expected
    assert all_data(env.clone().unwrapped.data) == expected


def test_edited_model_is_part_of_the_state():
    env, fresh = make("HalfCheetah-v5"), make("HalfCheetah-v5")
    env.reset(seed=0)
    fresh.reset(seed=0)
    actions = actions_for(env, 5)
    plain, plain_future = env.snapshot(), follow(fresh, actions)
    model = env.unwrapped.model
    model.body_mass[1] *= 2
    model.opt.gravity[2] = -3.0
    model.opt.timestep = 0.011
    edited = env.snapshot()
    clone = env.clone()
    edited_future = follow(env, actions)
    assert edited_future != plain_future
    assert follow(clone, actions) == edited_future

    fresh.restore(edited)
    assert fresh.unwrapped.model.opt.timestep == 0.011
    assert follow(fresh, actions) == edited_future
    env.restore(plain)
    assert follow(env, actions) == plain_future
    env.restore(pickle.loads(pickle.dumps(edited)))
    assert follow(env, actions) == edited_future
    # An edit after a snapshot must not be taken for the model that the snapshot shares with earlier ones.
    model.body_mass[2] *= 3
    env.restore(edited)
    assert follow(env, actions) == edited_future


STACKS = {
    "time": [TimeAwareObservation],
    "frames": [lambda env: FrameStackObservation(env, 3)],
    "normal": [NormalizeObservation, NormalizeReward],
    "delay": [lambda env: DelayObservation(env, 2)],
    "sticky": [lambda env: StickyAction(env, 0.5)],
    "statistics": [RecordEpisodeStatistics],
    "monitor": [Monitor],
    "all": [
        Monitor,
        TimeAwareObservation,
        NormalizeObservation,
        lambda env: DelayObservation(env, 1),
        NormalizeReward,
    ],
}


@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("name", ["Pendulum-v1", "Hopper-v5"])
def test_stateful_wrappers(name, stack):
    env, other = (make(name, *STACKS[stack], max_episode_steps=12) for _ in range(2))
    env.reset(seed=0)
    actions = actions_for(env, 12)
    follow(env, actions[:8])
    state = env.snapshot()
    expected = follow(env, actions[8:])  # to the time limit
    other.reset(seed=1)
    follow(other, actions[:2])
    for target in (env, other):
        target.restore(state)
        assert follow(target, actions[8:]) == expected
    env.restore(state)
    clone = env.clone()
    assert [result[:3] for result in follow(clone, actions[8:])] == [result[:3] for result in expected]


def test_both_time_limits():
    from rl_zoo3.gym_patches import PatchedTimeLimit

    # Importing RL Zoo, here or earlier, puts its class in place of Gymnasium's.
    original = PatchedTimeLimit.__mro__[1]
    assert original.__module__ == "gymnasium.wrappers.common"
    envs = [
        SnapshotEnvWrapper(limit(gym.make("Pendulum-v1").unwrapped, max_episode_steps=4))
        for limit in (original, PatchedTimeLimit)
    ]
    for source, target in (envs, envs[::-1]):
        source.reset(seed=0)
        actions = actions_for(source, 4)
        follow(source, actions[:2])
        target.reset(seed=1)
        target.restore(source.snapshot())
        ends = [target.step(action)[3] for action in actions[2:]]
        assert ends == [False, True]


def test_monitor_is_restored_and_left_out_of_clones(tmp_path):
    file = tmp_path / "0.monitor.csv"
    env = make("Pendulum-v1", lambda env: Monitor(env, str(file)), max_episode_steps=6)
    env.reset(seed=0)
    actions = actions_for(env, 6)
    follow(env, actions[:3])
    written = file.read_bytes()
    state = env.snapshot()
    monitor = env.env
    rewards = list(monitor.rewards)

    clone = env.clone()
    assert not isinstance(clone.env, Monitor)
    for _ in range(2):  # Monitor would refuse to go on after the time limit
        follow(clone, actions)
    clone.restore(state)
    assert file.read_bytes() == written
    assert monitor.rewards == rewards

    results = [env.step(action) for action in actions[3:]]
    assert monitor.needs_reset
    env.restore(state)
    assert monitor.rewards == rewards and not monitor.needs_reset
    again = [env.step(action) for action in actions[3:]]
    assert again[-1][4]["episode"]["r"] == results[-1][4]["episode"]["r"]
    for without in (clone.snapshot(), env.snapshot(monitor=False)):
        with pytest.raises(SnapshotMismatchError, match="Monitor"):
            env.restore(without)
    env.close()


def test_what_a_monitor_remembers_can_be_left_out():
    """Its history grows with every episode, and so would the price of a pool's decisions."""
    env = make("Pendulum-v1", NormalizeObservation, Monitor, NormalizeReward, max_episode_steps=3)
    clone, sizes = env.clone(), []
    for seed in range(40):
        env.reset(seed=seed)
        state = env.snapshot(monitor=False)
        sizes.append(len(pickle.dumps(state)))
        clone.restore(state)
        steps = [follow(each, actions_for(env, 3)) for each in (env, clone)]
        assert [step[:4] for step in steps[0]] == [step[:4] for step in steps[1]]  # Monitor adds to the info
    assert len(env.get_wrapper_attr("episode_returns")) == 40 and max(sizes) < sizes[0] + 50


def test_clone_touches_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = make("HalfCheetah-v5", Monitor, render_mode="rgb_array")
    env.reset(seed=0)
    env.unwrapped.own_flag = [1]
    actions = actions_for(env, 6)
    follow(env, actions[:3])
    files = sorted(tmp_path.iterdir())  # MuJoCo logs its warnings where it runs
    before = pickle.dumps(exact(all_data(env.unwrapped.data)))
    generators = env.np_random.bit_generator.state
    global_state = random.getstate(), exact(np.random.get_state()[1]), exact(torch.get_rng_state().numpy())
    live = env.snapshot()
    env.restore(live)
    expected = follow(env, actions[3:])
    env.restore(live)

    clone = env.clone()
    clone.unwrapped.own_flag.append(2)
    clone.unwrapped.model.body_mass[:] = 1
    clone.reset()
    follow(clone, actions)
    clone.restore(live, rng=np.random.default_rng(0))
    assert clone.render_mode is None and clone.unwrapped.render_mode is None
    assert env.unwrapped.render_mode == "rgb_array"
    assert (
        random.getstate(),
        exact(np.random.get_state()[1]),
        exact(torch.get_rng_state().numpy()),
    ) == global_state
    assert pickle.dumps(exact(all_data(env.unwrapped.data))) == before
    assert env.np_random.bit_generator.state == generators
    assert env.unwrapped.own_flag == [1]
    assert follow(env, actions[3:]) == expected
    assert sorted(tmp_path.iterdir()) == files
    clone.close()


def test_wrapping_twice_and_last_observation():
    env = make("Pendulum-v1")
    assert SnapshotEnvWrapper(env) is env
    assert env.last_observation is None
    observation, _ = env.reset(seed=0)
    state = env.snapshot()
    kept = observation.copy()
    observation[:] = 7
    assert np.array_equal(env.last_observation, kept)
    stepped = env.step(actions_for(env, 1)[0])[0]
    assert np.array_equal(env.last_observation, stepped)
    env.restore(state)
    assert np.array_equal(env.last_observation, kept)
    assert env.apply(lambda wrapper, number: (wrapper, number), 3) == (env, 3)


def test_mismatches_are_named_and_change_nothing(tmp_path):
    env = make("HalfCheetah-v5")
    env.reset(seed=0)
    xml = tmp_path / "other.xml"
    spec = mujoco.MjSpec.from_file(env.unwrapped.fullpath)
    spec.worldbody.add_body(name="extra").add_geom(name="extra", size=[0.1, 0, 0], pos=[0, 0, 9])
    xml.write_text(spec.to_xml())
    others = {
        "this environment is a .*HalfCheetahEnv": make("Hopper-v5"),
        r"\(17,\).*\(18,\)|\(18,\).*\(17,\)": make(
            "HalfCheetah-v5", exclude_current_positions_from_observation=False
        ),
        "TimeLimit > OrderEnforcing": make("HalfCheetah-v5", disable_env_checker=True),
        "nbody": make("HalfCheetah-v5", xml_file=str(xml)),
    }
    actions = actions_for(env, 3)
    state = env.snapshot()
    expected = follow(env, actions)
    env.restore(state)
    for message, other in others.items():
        other.reset(seed=1)
        with pytest.raises(SnapshotMismatchError, match=message):
            env.restore(other.snapshot())
    assert follow(env, actions) == expected
    with pytest.raises(TypeError, match="Snapshot"):
        env.restore("state")
    with pytest.raises(ValueError, match="rng"):
        env.restore(state, rng="new")
