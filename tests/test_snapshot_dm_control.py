"""dm_control's suite through Shimmy: exact snapshots, restores and clones."""

import pickle
import threading
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from sb3_mcbs import SearchPolicy, SnapshotEnvWrapper
from sb3_mcbs.models.probing import probe_randomness
from sb3_mcbs.snapshot.spaces import random_action, values_of

with pytest.MonkeyPatch.context() as _patch, warnings.catch_warnings():
    _patch.setenv("MUJOCO_GL", "disabled")  # dm_control looks for a renderer when it is imported
    warnings.simplefilter("ignore")  # GLFW misses a display
    pytest.importorskip("dm_control", reason="dm_control is not installed")
    pytest.importorskip("shimmy", reason="shimmy is not installed")
    from dm_control import mujoco as dm_mujoco
    from dm_control.mujoco.wrapper.mjbindings import sizes
    from dm_control.rl import control
    from dm_control.suite import base

N_BEFORE, N_AFTER = 60, 25


@pytest.fixture(scope="module", autouse=True)
def _fields_of_mujoco_4():
    """dm_control 1.0.50 lists fields that MuJoCo 4.0 no longer has."""
    with pytest.MonkeyPatch.context() as patch:
        for struct, cls in (("mjmodel", mujoco.MjModel), ("mjdata", mujoco.MjData)):
            for name in sizes.array_sizes[struct].keys() - set(dir(cls)):
                patch.delitem(sizes.array_sizes[struct], name)
        yield


def make(task: str) -> SnapshotEnvWrapper:
    return SnapshotEnvWrapper(gym.make(f"dm_control/{task}-v0"))


def physics_of(env: gym.Env):
    return env.unwrapped._env.physics


def actions_for(env: gym.Env, n: int = N_BEFORE + N_AFTER) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [random_action(env.action_space, rng) for _ in range(n)]


def content(observation) -> list[bytes]:
    return [value.tobytes() for value in values_of(observation)]


def future(env: gym.Env, actions: list[np.ndarray]) -> list:
    """What steps give, and where the simulator and the task's generator are then."""
    seen: list = []
    for action in actions:
        observation, *rest, info = env.step(action)
        seen.append((content(observation), *rest, info["timestep.discount"]))
    data = physics_of(env).data
    seen.append([getattr(data, name).tobytes() for name in ("xpos", "cvel", "qacc_warmstart", "sensordata")])
    _, keys, *places = env.unwrapped._env.task.random.get_state()
    return [*seen, keys.tobytes(), places]


@pytest.mark.parametrize(
    "task",
    [
        "cheetah-run",
        "walker-walk",
        "hopper-hop",
        "finger-spin",
        "ball_in_cup-catch",
        "manipulator-bring_ball",
    ],
)
def test_same_future_after_a_restore_in_a_clone_and_in_another_instance(task):
    env = make(task)
    actions = actions_for(env)
    env.reset(seed=3)
    for action in actions[:N_BEFORE]:
        env.step(action)
    state = env.snapshot()
    expected = future(env, actions[N_BEFORE:])

    for _ in range(3):
        env.restore(state)
        assert future(env, actions[N_BEFORE:]) == expected
    env.restore(state)
    clone = env.clone()
    assert future(clone, actions[N_BEFORE:]) == expected
    assert future(env, actions[N_BEFORE:]) == expected  # the clone's steps did not move it

    other = make(task)
    other.reset(seed=9)
    other.step(actions[0])
    other.restore(pickle.loads(pickle.dumps(state)))
    assert future(other, actions[N_BEFORE:]) == expected

    episodes = []
    for target in (env, clone, other):
        target.restore(state)
        observation, _ = target.reset()  # the task draws from its own generator
        episodes.append((content(observation), future(target, actions[:N_AFTER])))
    assert episodes[0] == episodes[1] == episodes[2]


def test_a_clone_has_physics_of_its_own():
    env = make("cheetah-run")
    env.reset(seed=0)
    physics = physics_of(env)
    physics._contexts = contexts = ("stands for a renderer",)
    state = env.snapshot()
    clone = env.clone()
    env.restore(state)
    copied = physics_of(clone)
    assert physics._contexts is contexts and copied._contexts is None
    del physics._contexts
    assert isinstance(copied._contexts_lock, type(threading.Lock()))
    assert copied._contexts_lock is not physics._contexts_lock
    assert type(copied) is type(physics) and type(copied.data) is dm_mujoco.wrapper.MjData
    assert copied.data.ptr.model is copied.model.ptr is not physics.model.ptr
    for path in ("data.qpos", "data.xpos", "model.body_mass"):
        struct, name = path.split(".")
        its = getattr(getattr(copied.named, struct), name)
        assert np.shares_memory(its[:], getattr(getattr(copied, struct), name))
        assert repr(its) == repr(getattr(getattr(physics.named, struct), name))
    assert np.shares_memory(copied._warnings, copied.data.ptr.warning.number)

    before = physics.data.qpos.copy()
    with copied.reset_context():
        copied.named.data.qpos["bthigh"] = 0.5
    assert copied.data.qpos[copied.model.name2id("bthigh", "joint")] == 0.5
    assert np.array_equal(physics.data.qpos, before)
    clone.close()
    env.step(env.action_space.sample())


def test_edited_models_and_failed_simulations_are_put_back():
    env = make("hopper-hop")
    actions = actions_for(env)
    env.reset(seed=0)
    physics = physics_of(env)
    physics.named.model.body_mass["torso"] *= 2
    state = env.snapshot()
    expected = future(env, actions[:10])
    physics.named.model.body_mass["torso"] /= 2
    physics.model.opt.gravity[2] = -1
    physics.data.qvel[:] = 1e20
    with pytest.raises(control.PhysicsError):
        env.step(actions[0])
    env.restore(state)
    assert future(env, actions[:10]) == expected
    clone = env.clone()
    assert physics_of(clone).named.model.body_mass["torso"] == physics.named.model.body_mass["torso"]


BALLS = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 1"/>
    <body name="a" pos="0 0 1"><freejoint/><geom name="a" size=".1"/></body>
    <body name="b" pos="1 0 .5"><freejoint/><geom name="b" size=".1"/></body>
    <body name="c" pos="2 0 .2"><joint name="c" type="slide" axis="0 0 1"/><geom name="c" size=".1"/></body>
  </worldbody>
  <actuator><motor name="c" joint="c" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


class Watch(base.Task):
    """Looks at another ball in each episode, through all kinds of views that it keeps."""

    def initialize_episode(self, physics):
        self.ball = self.random.choice(["a", "b", "c"])
        self.named = physics.named
        self.views = [
            physics.data.qpos,
            physics.data.qvel[:3],
            physics.named.data.xpos[self.ball],
            physics.data.xpos[physics.model.name2id(self.ball, "body")],
        ]
        self.parts = [
            physics.named.data.xpos if self.ball == "a" else physics.named.data.geom_xpos,
            physics.named.data.qvel,
            physics.data.ptr.body(self.ball),
            physics.named.data,
        ]
        super().initialize_episode(physics)

    def get_observation(self, physics):
        indexer, speeds, body, data = self.parts
        values = [*self.views, indexer[self.ball], speeds[:], body.xpos, data.xquat[self.ball]]
        return {"seen": np.concatenate([np.ravel(value) for value in (*values, self.named.data.qpos["c"])])}

    def get_reward(self, physics):
        return float(self.views[2][2])


def make_watch(task: type = Watch) -> SnapshotEnvWrapper:
    environment = control.Environment(dm_mujoco.Physics.from_xml_string(BALLS), task(random=0), time_limit=9)
    environment.reset()
    return SnapshotEnvWrapper(gym.make("dm_control/compatibility-env-v0", env=environment))


def test_views_that_tasks_keep_are_put_back_and_belong_to_the_clone():
    env = make_watch()
    actions = actions_for(env, 30)
    states, futures = [], []
    for seed in range(4):
        env.reset(seed=seed)
        env.step(actions[0])
        states.append(env.snapshot())
        futures.append(future(env, actions))
    assert len({env.restore(state) or env.unwrapped._env.task.ball for state in states}) > 1
    clone, other = env.clone(), make_watch()
    other.reset(seed=7)
    for state, expected in zip(states, futures, strict=True):
        for target in (env, clone, other):
            target.restore(pickle.loads(pickle.dumps(state)) if target is other else state)
            task, physics = target.unwrapped._env.task, physics_of(target)
            assert np.shares_memory(task.views[2], physics.data.xpos)
            assert task.named is physics.named and task.parts[3] is physics.named.data
            assert future(target, actions) == expected


class Reload(Watch):
    """Loads the model anew in each episode."""

    def initialize_episode(self, physics):
        physics.reload_from_xml_string(BALLS)
        super().initialize_episode(physics)


def test_reloaded_physics_keep_their_named_views():
    env = make_watch(Reload)
    actions = actions_for(env, 20)
    env.reset(seed=0)
    data = physics_of(env).data
    state = env.snapshot()  # checks the environment, which resets it
    assert physics_of(env).data is data
    assert np.shares_memory(physics_of(env).named.data.qpos[:], data.qpos)
    expected = future(env, actions)
    env.reset(seed=1)
    assert physics_of(env).data is not data
    for target in (env, env.clone()):
        target.restore(state)
        physics = physics_of(target)
        assert np.shares_memory(physics.named.data.qpos[:], physics.data.qpos)
        assert future(target, actions) == expected


def test_random_numbers_of_the_task_are_kept_or_seeded_afresh():
    env = make("reacher-easy")
    env.reset(seed=0)
    state = env.snapshot()
    first = content(env.reset()[0])
    env.restore(state, rng="keep")
    assert content(env.reset()[0]) != first
    targets = []
    for seed in (1, 1, 2):
        env.restore(state, rng=np.random.default_rng(seed))
        targets.append(content(env.reset()[0]))
    assert targets[0] == targets[1] != targets[2]
    assert first not in targets


@pytest.mark.parametrize("policy", ["MultiInputPolicy", "MlpPolicy"])
def test_agents_look_ahead_in_deterministic_copies(make_agent, policy):
    env = gym.make("dm_control/hopper-hop-v0")
    if policy == "MlpPolicy":
        env = gym.wrappers.FlattenObservation(env)
    agent = make_agent(env, policy)
    agent.learn(60)
    assert "deterministic dynamics" in agent.planner.description
    vec_env = agent.get_env()
    observation = vec_env.reset()
    chosen = [SearchPolicy(agent, vec_env, seed=0).predict(observation)[0] for _ in range(2)]
    assert np.array_equal(*chosen) and chosen[0].shape == (1, 4)


def test_wrappers_of_dm_control_are_captured():
    from dm_control import suite
    from dm_control.suite.wrappers import action_noise, action_scale

    scaled = action_scale.Wrapper(suite.load("cheetah", "run"), minimum=-2, maximum=2)
    env = SnapshotEnvWrapper(gym.make("dm_control/compatibility-env-v0", env=action_noise.Wrapper(scaled)))
    env.reset(seed=0)
    actions = actions_for(env, 20)
    state = env.snapshot()
    expected = future(env, actions)
    env.restore(state)
    clone = env.clone()
    assert future(env, actions) == future(clone, actions) == expected
    randomness = probe_randomness(env)
    assert randomness is not None and randomness.any and not randomness.shared
