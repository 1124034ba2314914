"""Snapshots of environments that simulate with PyBullet. They run where it is installed."""

import gc
import multiprocessing
import pickle
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import TD3
from stable_baselines3.common.vec_env import DummyVecEnv

import sb3_mcbs
from sb3_mcbs import MCBSTD3, SearchPolicy, SnapshotEnvWrapper
from sb3_mcbs.snapshot import BulletAdapter, SnapshotMismatchError, SnapshotUnsupportedError, register_adapter
from sb3_mcbs.snapshot.bullet_handles import Handle, uses_bullet
from sb3_mcbs.snapshot.bullet_world import read_world
from sb3_mcbs.snapshot.registry import find_adapter

pytest.importorskip("pybullet", reason="PyBullet is not installed")

import pybullet as p

from tests import bullet_envs
from tests.bullet_envs import Ball, HeavyBall, LazyBall, LoadedBall, Pile, WindowBall, WorldBall

PENDULUM, CHEETAH, HOPPER = (f"{name}BulletEnv-v0" for name in ("InvertedPendulum", "HalfCheetah", "Hopper"))
SMALL = dict(beam_width=2, n_simulations=2, rollout_depth=2)


BALLS = [Ball, LazyBall, bullet_envs.ReconnectingBall, bullet_envs.NestedBall, LoadedBall]


@pytest.fixture(autouse=True)
def no_servers():
    """Each test starts and ends without a server."""
    _end_all()
    yield
    _end_all()


def _end_all():
    gc.collect()
    for server in _servers():
        p.disconnect(server)


def _servers():
    return [number for number in range(40) if p.isConnected(number)]


def _make(name_or_class):
    if isinstance(name_or_class, str):
        pytest.importorskip("pybullet_envs_gymnasium", reason="pybullet_envs_gymnasium is not installed")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return SnapshotEnvWrapper(gym.make(name_or_class))
    return SnapshotEnvWrapper(name_or_class())


def _actions(env, n, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (n, *env.action_space.shape)).astype(np.float32)


def _run(env, actions):
    seen = []
    for action in actions:
        observation, reward, terminated, *_ = env.step(action.copy())
        seen.append((observation.tobytes(), float(reward), bool(terminated)))
        if terminated:
            break
    return seen


def _started(name_or_class, n=6):
    env = _make(name_or_class)
    env.reset(seed=1)
    _run(env, _actions(env, n, seed=1))
    return env


def _server(env):
    unwrapped = env.unwrapped
    return unwrapped.client if hasattr(unwrapped, "client") else unwrapped.physicsClientId


@pytest.mark.parametrize("made", [*BALLS, PENDULUM, CHEETAH, HOPPER])
def test_same_future_everywhere(made):
    env = _started(made)
    actions, state = _actions(env, 12), env.snapshot()
    expected = _run(env, actions)
    env.restore(state)
    clone = env.clone()
    assert _run(clone, actions) == expected  # the clone, alone
    assert _run(env, actions) == expected  # and it has not moved the original
    clone.reset(seed=8)
    clone.restore(state)
    assert _run(clone, actions) == expected
    other = _make(made)  # another instance, never reset, and from a pickle
    other.restore(pickle.loads(pickle.dumps(state)))
    assert _run(other, actions) == expected
    env.reset(seed=9)  # another episode
    _run(env, _actions(env, 3))
    env.restore(state)
    assert _run(env, actions) == expected


@pytest.mark.parametrize("made", [LazyBall, LoadedBall, PENDULUM])
def test_clones_have_a_server_of_their_own_which_ends_with_them(made):
    env = _started(made)
    env.verify()  # its contacts leave empty entries in what PyBullet saves
    world = read_world(_server(env))
    clone, dropped = env.clone(), env.clone()
    assert len({int(_server(each)) for each in (env, clone, dropped)}) == 3
    _run(clone, _actions(env, 3))
    clone.close()
    del dropped
    gc.collect()
    assert _servers() == [int(_server(env))]
    assert read_world(_server(env)) == world


def test_numbers_that_are_free_again_may_be_used_by_others():
    env = _started(PENDULUM)
    clone = env.clone()
    freed = int(_server(clone))
    clone.close()
    assert p.connect(p.DIRECT) == freed
    del clone
    gc.collect()
    assert p.isConnected(freed)


def test_a_clone_goes_on_as_the_original_after_a_reset():
    env = _started(PENDULUM)
    clone = env.clone()
    for _ in range(2):
        assert (env.reset()[0] == clone.reset()[0]).all()
        actions = _actions(env, 5)
        assert _run(env, actions) == _run(clone, actions)


def test_clones_have_no_window(monkeypatch):
    env = _started(WindowBall)
    monkeypatch.setattr(WindowBall, "mode", p.GUI)
    clone = env.clone()
    assert p.getConnectionInfo(clone.unwrapped.client)["connectionMethod"] == p.DIRECT


def _in_another_process(connection, state, actions):
    env = Ball()
    wrapped = SnapshotEnvWrapper(env)
    wrapped.restore(state)
    connection.send(_run(wrapped, actions))


def test_another_process():
    env = _started(Ball)
    actions, state = _actions(env, 8), env.snapshot()
    here, there = multiprocessing.get_context("fork").Pipe()
    work = multiprocessing.get_context("fork").Process(
        target=_in_another_process, args=(there, state, actions)
    )
    work.start()
    assert here.poll(20) and here.recv() == _run(env, actions)
    work.join()


def test_what_was_captured_before_the_first_reset():
    env = _make(PENDULUM)
    unused = env.snapshot()  # after the check, which resets it
    assert env.unwrapped.physicsClientId == -1 and not _servers()
    first = env.reset(seed=3)[0]
    env.restore(unused)
    assert not hasattr(env.unwrapped, "_p")
    assert (env.reset(seed=3)[0] == first).all()


def test_a_wrapper_that_holds_the_server():
    class Client(gym.Wrapper):
        def __init__(self, env):
            super().__init__(env)
            self.client = None

        def reset(self, **arguments):
            result = self.env.reset(**arguments)
            self.client = self.unwrapped._p
            return result

        def step(self, action):
            observation, *_, info = self.env.step(action)
            return observation, float(self.client.getNumBodies()), False, False, info

    _make(PENDULUM).close()
    env = SnapshotEnvWrapper(Client(gym.make(PENDULUM)))
    env.reset(seed=0)
    clone = env.clone()
    assert clone.env.client is clone.unwrapped._p is not env.unwrapped._p
    actions = _actions(env, 4)
    assert _run(clone, actions) == _run(env, actions)


def test_generators_may_be_seeded_afresh():
    env = _started(PENDULUM)
    state = env.snapshot()
    starts = []
    for seed in (1, 1, 2):
        env.restore(state, rng=np.random.default_rng(seed))
        starts.append(env.reset()[0].tobytes())
    assert starts[0] == starts[1] != starts[2]


@pytest.mark.parametrize("made", [HeavyBall, Pile])
def test_what_is_not_saved_is_replayed(made):
    with pytest.warns(UserWarning, match="repeating the episode"):
        env = _started(made, 20)
        actions, state = _actions(env, 10), env.snapshot()
        expected = _run(env, actions)
        env.restore(state)
    clone = env.clone()
    assert _run(clone, actions) == expected == _run(env, actions)


@pytest.mark.filterwarnings("ignore:The simulator of:UserWarning")
def test_refused_where_nothing_is_exact():
    with pytest.raises(
        SnapshotUnsupportedError, match=r"(?s)Captured another way.*resetSimulation.*ensemble"
    ):
        _started(bullet_envs.ForgetfulPile, 20).snapshot()


def test_state_alone_refuses_what_it_cannot_put_back():
    class Registered(HeavyBall):
        pass

    register_adapter(lambda obj: isinstance(obj, Registered), BulletAdapter(method="state"))
    env = SnapshotEnvWrapper(Registered(), verify=False)
    env.reset(seed=0)
    state = env.snapshot()
    env.step(np.ones(1))
    heavy = env.snapshot()
    with pytest.raises(SnapshotMismatchError, match=r"changeDynamics.*method=\"replay\""):
        env.reset(seed=0)
        env.restore(heavy)
    env.restore(state)
    with pytest.raises(SnapshotUnsupportedError, match="changeDynamics"):
        _ = SnapshotEnvWrapper(Registered()).snapshot()


def test_handles_of_other_names():
    env = _started(WorldBall)
    with pytest.raises(SnapshotUnsupportedError, match=r"no handle.*BulletAdapter\(client="):
        env.snapshot()
    register_adapter(lambda obj: isinstance(obj, WorldBall), BulletAdapter(client="world"))
    env = _started(WorldBall)
    actions = _actions(env, 5)
    assert _run(env.clone(), actions) == _run(env, actions)
    with pytest.raises(TypeError, match="client"):
        BulletAdapter(client=3)
    with pytest.raises(ValueError, match="method"):
        BulletAdapter(method="copy")


def test_two_servers():
    class Doubled(Ball):
        def __init__(self):
            super().__init__()
            self.shadow = p.connect(p.DIRECT)

        def reset(self, *, seed=None, options=None):
            p.resetSimulation(physicsClientId=self.shadow)
            self.other = p.createMultiBody(1, basePosition=[0, 0, 5], physicsClientId=self.shadow)
            return super().reset(seed=seed)

        def step(self, action):
            observation, *_ = super().step(action)
            p.setGravity(0, 0, -float(observation[0]), physicsClientId=self.shadow)
            p.stepSimulation(physicsClientId=self.shadow)
            (_, _, height), _ = p.getBasePositionAndOrientation(self.other, physicsClientId=self.shadow)
            return observation, height, False, False, {}

    register_adapter(lambda obj: isinstance(obj, Doubled), BulletAdapter(client=("client", "shadow")))
    env = _started(lambda: Doubled())
    actions = _actions(env, 5)
    clone = env.clone()
    assert len(_servers()) == 4
    assert _run(clone, actions) == _run(env, actions)
    clone.close()
    assert len(_servers()) == 2


def test_servers_that_an_environment_is_given():
    gym.register("GivenBall-v0", bullet_envs.GivenBall)
    env = SnapshotEnvWrapper(gym.make("GivenBall-v0", server=p.connect(p.DIRECT)))
    env.reset(seed=0)
    with pytest.raises(SnapshotUnsupportedError, match="given its physics server"):
        env.clone()


def test_calls_that_name_no_server():
    env = _started(bullet_envs.DefaultBall)
    with pytest.raises(SnapshotUnsupportedError, match="physicsClientId"):
        env.clone()
    assert env.unwrapped.observe()[1] == 0  # it was reset


def test_a_server_that_is_gone():
    env = _started(Ball)
    state = env.snapshot()
    p.disconnect(env.unwrapped.client)
    for attempt in (env.snapshot, env.clone, lambda: env.restore(state)):
        with pytest.raises((SnapshotUnsupportedError, SnapshotMismatchError), match="not connected any more"):
            attempt()
    lazy = _started(LazyBall)
    actions, state = _actions(lazy, 4), lazy.snapshot()
    expected = _run(lazy, actions)
    lazy.close()
    with pytest.raises(SnapshotUnsupportedError, match="not connected any more"):
        lazy.snapshot()
    lazy.restore(state)  # it can connect again
    assert _run(lazy, actions) == expected


def test_real_time():
    env = _started(Ball)
    env.snapshot()
    p.setRealTimeSimulation(1, physicsClientId=env.unwrapped.client)
    with pytest.raises(SnapshotUnsupportedError, match="real time"):
        env.snapshot()
    p.setRealTimeSimulation(0, physicsClientId=env.unwrapped.client)


def test_recognition():
    assert all(uses_bullet(made()) for made in (Ball, LazyBall, WorldBall, bullet_envs.DefaultBall))
    assert not uses_bullet(gym.make("Pendulum-v1").unwrapped) and not uses_bullet(3)
    assert isinstance(find_adapter(_make(PENDULUM).unwrapped), BulletAdapter)
    handle = _started(Ball).unwrapped.client
    assert isinstance(handle, Handle) and type(pickle.loads(pickle.dumps(handle))) is int


class Hidden(gym.Env):
    """Uses PyBullet in a way that nobody can see."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self):
        self.number = len(_HIDDEN)
        _HIDDEN.append(BALLS[0]())

    def reset(self, *, seed=None, options=None):
        return _HIDDEN[self.number].reset(seed=seed)

    def step(self, action):
        return _HIDDEN[self.number].step(action)


_HIDDEN = []


def test_the_error_of_others_points_to_the_adapter():
    env = SnapshotEnvWrapper(Hidden())
    env.reset(seed=0)
    with pytest.raises(SnapshotUnsupportedError, match=r"PyBullet is imported.*Hidden.*BulletAdapter\("):
        env.snapshot()


def test_pybullet_is_never_imported():
    for path in (Path(sb3_mcbs.__file__).parent / "snapshot").glob("*.py"):
        assert "import pybullet" not in path.read_text()


def test_search_never_moves_the_world():
    _make(PENDULUM).close()
    vec_env = DummyVecEnv([lambda: gym.make(PENDULUM)])
    model = TD3("MlpPolicy", vec_env, policy_kwargs=dict(net_arch=[4]), device="cpu")
    policy = SearchPolicy(model, vec_env, seed=0, **SMALL)
    observation = vec_env.reset()
    policy.predict(observation)  # checks the environment
    server = int(vec_env.envs[0].unwrapped.physicsClientId)
    world = read_world(server)
    policy.predict(observation)
    assert read_world(server) == world


def test_training():
    _make(PENDULUM).close()
    networks = dict(policy_kwargs=dict(net_arch=[4]), device="cpu")
    agent = MCBSTD3("MlpPolicy", PENDULUM, learning_starts=20, seed=0, **networks, **SMALL)
    agent.learn(60)
    assert agent.num_timesteps == 60
