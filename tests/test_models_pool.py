"""The pool of environment copies: any environment, any wrapper, any dynamics."""

import gc
import logging
import random
import weakref
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import (
    FrameStackObservation,
    NormalizeObservation,
    NormalizeReward,
    TimeAwareObservation,
    TimeLimit,
)

from sb3_mcbs.models import EnvPoolModel, ForwardModelError, LocalEnvironments, MujocoBatchModel
from sb3_mcbs.snapshot import SnapshotEnvWrapper

RNG = np.random.default_rng(0)


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo writes a log file where it runs when a simulation diverges."""
    monkeypatch.chdir(tmp_path)


class PointEnv(gym.Env):
    """A point with Dict observations that can be made to misbehave.

    :param noise: ``"own"`` draws from ``np_random``, ``"numpy"`` and ``"python"`` from global generators.
    """

    def __init__(self, noise: str = "none") -> None:
        self.noise = noise
        box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space = spaces.Dict({"place": box, "age": spaces.Box(0, 1000, (), np.int64)})
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.place, self.age = np.zeros(2, np.float32), 0

    def _observe(self) -> dict:
        return {"place": self.place, "age": np.int64(self.age)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.age = self.np_random.normal(size=2).astype(np.float32), 0
        return self._observe(), {}

    def step(self, action):
        if action[0] > 0.99:
            raise RuntimeError("the point broke")
        self.age += 1
        # In place: whoever keeps this observation without copying it sees it change.
        self.place += action + self._draw()
        if action[0] < -0.99:
            self.place[0] = np.nan
        return self._observe(), float(self.place[0]), bool(self.age == 4 and action[1] > 0.99), False, {}

    def _draw(self) -> float:
        draws = {"own": self.np_random.random, "numpy": np.random.random, "python": random.random}
        return np.float32(draws[self.noise]()) if self.noise in draws else np.float32(0)


def point(noise: str = "none", steps: int = 100) -> SnapshotEnvWrapper:
    env = SnapshotEnvWrapper(TimeLimit(PointEnv(noise), steps))
    env.reset(seed=0)
    return env


def small_actions(rows: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.5, 0.5, size=(rows, 2)).astype(np.float32)


def start(model, rows: int, rng: np.random.Generator | int = 0) -> None:
    model.set_roots(model.read_roots([0]), np.zeros(rows, dtype=int), np.random.default_rng(rng))


WRAPPED = {
    "Pendulum": lambda: gym.make("Pendulum-v1"),
    "stacked": lambda: FrameStackObservation(gym.make("HalfCheetah-v5"), 3),
    "normalised": lambda: NormalizeReward(NormalizeObservation(gym.make("Hopper-v5"))),
    "time-aware": lambda: TimeAwareObservation(gym.make("Pendulum-v1")),
    "contact forces": lambda: gym.make("Ant-v5"),
}


@pytest.mark.parametrize("name", WRAPPED)
def test_copies_do_what_the_environment_does(name: str) -> None:
    env = SnapshotEnvWrapper(WRAPPED[name]())
    model = EnvPoolModel(LocalEnvironments([env]))
    assert model.deterministic
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(3):
        env.step(env.action_space.low * 0.3)
    start(model, 3)
    for step in range(6):
        actions = rng.uniform(
            env.action_space.low, env.action_space.high, (model.n_rows, *env.action_space.shape)
        )
        actions = actions.astype(np.float32)
        actions[-1] = actions[0]
        found = model.step(actions)
        observation, reward, terminated, _, _ = env.step(actions[0])
        for row in (0, -1):
            assert found.observations.dtype == observation.dtype
            assert found.observations[row].tobytes() == observation.tobytes()
            assert found.rewards[row] == reward
            assert found.terminated[row] == terminated
        assert found.valid.all()
        if step == 2:
            # Row 1 is dropped, the two that follow the real environment are copied.
            model.select(np.array([0, 0, 2, 2]))
    assert model.n_rows == 4
    model.close()


def test_the_pool_and_the_batch_agree() -> None:
    env = SnapshotEnvWrapper(gym.make("Walker2d-v5"))
    env.reset(seed=0)
    models = [EnvPoolModel(LocalEnvironments([env])), MujocoBatchModel(LocalEnvironments([env]), n_threads=1)]
    space = env.action_space
    actions = np.random.default_rng(0).uniform(space.low, space.high, (4, 6, *space.shape)).astype(np.float32)
    results = []
    for model in models:
        start(model, 3)
        found = [model.step(actions[0][:3])]
        model.select(np.repeat(np.arange(3), 2))
        results.append(found + [model.step(action) for action in actions[1:]])
    for ours, theirs in zip(*results, strict=True):
        for left, right in zip(ours[:4], theirs[:4], strict=True):
            assert left.tobytes() == right.tobytes()


def test_dict_observations() -> None:
    env = point()
    model = EnvPoolModel(LocalEnvironments([env]))
    start(model, 2)
    actions = small_actions(2)
    first = model.step(actions)
    kept = {key: value.copy() for key, value in first.observations.items()}
    model.step(actions)
    observation, *_ = env.step(actions[1])
    assert set(first.observations) == {"place", "age"}
    for key, values in first.observations.items():
        np.testing.assert_array_equal(values, kept[key])
        np.testing.assert_array_equal(values[1], observation[key])
        assert values.dtype == observation[key].dtype


def test_a_time_limit_ends_nothing() -> None:
    env = point(steps=3)
    model = EnvPoolModel(LocalEnvironments([env]))
    start(model, 2)
    for step in range(8):
        found = model.step(small_actions(2))
        assert not found.terminated.any()
        assert found.valid.all()
        np.testing.assert_array_equal(found.observations["age"], step + 1)


def test_a_row_that_terminated_stays_terminated() -> None:
    env = point()
    model = EnvPoolModel(LocalEnvironments([env]))
    start(model, 2)
    actions = np.array([[0, 1], [0, 0]], dtype=np.float32)
    for _ in range(4):
        found = model.step(actions)
    np.testing.assert_array_equal(found.terminated, [True, False])
    model.select(np.array([0, 0, 1]))
    # What would raise in an environment that goes on is not even tried.
    after = model.step(np.array([[1, 0], [0, 0], [0, 0]], dtype=np.float32))
    np.testing.assert_array_equal(after.terminated, [True, True, False])
    np.testing.assert_array_equal(after.observations["age"], [4, 4, 5])
    np.testing.assert_array_equal(after.rewards[:2], 0)
    assert after.valid.all()
    last_place = after.observations["place"][0].copy()
    # The copy behind the row that is dropped serves another row from now on.
    model.select(np.array([1, 2, 2, 2]))
    np.testing.assert_array_equal(model.step(small_actions(4)).observations["place"][0], last_place)


@pytest.mark.parametrize(("action", "message"), [(1.0, "the point broke"), (-1.0, None)])
def test_errors_and_nan_make_one_row_invalid(
    action: float, message: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    model = EnvPoolModel(LocalEnvironments([point()]))
    start(model, 3)
    actions = small_actions(3)
    actions[1, 0] = action
    with caplog.at_level(logging.WARNING, logger="sb3_mcbs"):
        for _ in range(2):
            np.testing.assert_array_equal(model.step(actions).valid, [True, False, True])
    assert [record.levelname for record in caplog.records] == (["WARNING"] if message else [])
    assert message is None or message in caplog.text
    model.select(np.array([0, 1, 1]))
    np.testing.assert_array_equal(model.step(small_actions(3)).valid, [True, False, False])
    start(model, 3)
    assert model.step(small_actions(3)).valid.all(), "copies are of use again after new roots"
    start(model, 3)
    assert not model.step(actions).valid.all()
    assert len(caplog.records) == (1 if message else 0), "one warning is enough"


def test_a_mujoco_copy_that_resets_itself_is_invalid() -> None:
    env = SnapshotEnvWrapper(gym.make("HalfCheetah-v5"))
    env.reset(seed=0)
    model = EnvPoolModel(LocalEnvironments([env]))
    root = model.read_roots([0])
    env.unwrapped.data.qvel[0] = 1e11
    bad_root = model.read_roots([0])
    for _ in range(2):
        model.set_roots(root + bad_root, np.array([0, 1, 1]), RNG)
        for _ in range(2):
            found = model.step(np.zeros((3, 6), dtype=np.float32))
            np.testing.assert_array_equal(found.valid, [True, False, False])
            assert np.isfinite(found.observations).all()


def test_what_the_environment_went_through_does_not_count() -> None:
    env = SnapshotEnvWrapper(gym.make("HalfCheetah-v5"))
    env.reset(seed=0)
    env.unwrapped.data.warning.number[:] = 1
    for model in (EnvPoolModel(LocalEnvironments([env])), MujocoBatchModel(LocalEnvironments([env]))):
        start(model, 2)
        assert model.step(np.zeros((2, 6), dtype=np.float32)).valid.all()


@pytest.mark.parametrize("noise", ["own", "numpy", "python"])
def test_random_dynamics(noise: str) -> None:
    """Rows draw from the look-ahead's generator alone, and nobody else notices."""
    envs = [point(noise), point(noise)]
    model = EnvPoolModel(LocalEnvironments(envs[:1]))
    assert not model.deterministic
    assert "random dynamics" in model.description
    actions = np.zeros((40, 2), dtype=np.float32)

    def look_ahead(rng: int) -> np.ndarray:
        start(model, 20, rng)
        model.step(actions[:20])
        model.select(np.repeat(np.arange(20), 2))
        return model.step(actions).observations["place"][:, 0]

    np.random.seed(5)
    random.seed(5)
    global_states = str(np.random.get_state()), random.getstate()
    places = look_ahead(1)
    assert (str(np.random.get_state()), random.getstate()) == global_states
    assert len(np.unique(places)) == 40, "every row draws for itself, copies of rows too"
    np.testing.assert_array_equal(look_ahead(1), places)
    assert not np.array_equal(look_ahead(2), places)
    # The look-ahead did not foresee what the real environment draws, and did not use it up.
    following = []
    for env in envs:
        np.random.seed(5)
        random.seed(5)
        following.append([env.step(actions[0])[0]["place"][0].item() for _ in range(2)])
        if env is envs[0]:
            assert following[0][1] not in places
    assert following[0] == following[1]


def test_a_deterministic_pool_draws_nothing() -> None:
    model = EnvPoolModel(LocalEnvironments([point()]))
    assert model.deterministic
    rng = np.random.default_rng(3)
    before = rng.bit_generator.state
    start(model, 2)
    model.set_roots(model.read_roots([0]), np.zeros(2, dtype=int), rng)
    model.step(small_actions(2))
    assert rng.bit_generator.state == before


def test_copies_carry_what_was_edited() -> None:
    env = SnapshotEnvWrapper(gym.make("HalfCheetah-v5"))
    env.reset(seed=0)
    env.unwrapped.model.body_mass[:] *= 1.5
    model = EnvPoolModel(LocalEnvironments([env]))
    action = np.full((1, 6), 0.5, dtype=np.float32)
    for edit in (lambda: None, lambda: env.unwrapped.model.geom_friction.fill(0.1)):
        edit()
        model.refresh()
        start(model, 1)
        predicted = model.step(action).observations[0]
        np.testing.assert_array_equal(predicted, env.step(action[0])[0])


def test_an_environment_that_exchanges_its_simulator() -> None:
    env = SnapshotEnvWrapper(gym.make("Swimmer-v5"))
    env.reset(seed=0)
    environments = LocalEnvironments([env])
    pool, batch = EnvPoolModel(environments), MujocoBatchModel(environments, n_threads=1)
    start(pool, 2)
    base, action = env.unwrapped, np.full((1, 2), 0.7, dtype=np.float32)
    spec = mujoco.MjSpec.from_file(base.fullpath)
    spec.body("torso").add_site(name="a mark that was not there")
    spec.bodies[2].add_joint(name="one more", axis=[0, 0, 1], damping=1)
    base.model = spec.compile()
    base.data = mujoco.MjData(base.model)
    base.init_qpos, base.init_qvel = base.data.qpos.copy(), base.data.qvel.copy()
    env.reset(seed=1)
    with pytest.raises(ForwardModelError, match=r"another MuJoCo model .*call refresh"):
        batch.read_roots([0])
    batch.refresh()
    predicted = []
    for model in (pool, batch):
        start(model, 1)
        predicted.append(model.step(action).observations[0])
    observation = env.step(action[0])[0]
    for ours in predicted:
        np.testing.assert_array_equal(ours, observation)


def test_roots_of_several_environments() -> None:
    envs = [point(), point(), point()]
    for number, env in enumerate(envs):
        env.reset(seed=number)
    model = EnvPoolModel(LocalEnvironments(envs))
    roots = model.read_roots([2, 0])
    model.set_roots(roots, np.array([0, 0, 1]), RNG)
    model.select(np.array([1, 2, 2]))
    actions = small_actions(3)
    places = model.step(actions).observations["place"]
    np.testing.assert_array_equal(places[0], envs[2].step(actions[0])[0]["place"])
    np.testing.assert_array_equal(places[2], envs[0].step(actions[2])[0]["place"])
    # Every row of one environment is dropped.
    model.select(np.array([1, 1]))
    assert model.step(actions[:2]).observations["place"].shape == (2, 2)
    with pytest.raises(ValueError, match="must follow each other"):
        model.set_roots([roots[0], roots[1], roots[0]], np.arange(3), RNG)
    with pytest.raises(ValueError, match="one action for each of 2 rows, got 3"):
        model.set_roots(roots, np.arange(2), RNG)
        model.step(actions)


def test_copies_go_with_their_pool(monkeypatch: pytest.MonkeyPatch) -> None:
    closed = []
    monkeypatch.setattr(PointEnv, "close", lambda env: closed.append(env))
    env = point()
    kept, forgotten = (EnvPoolModel(LocalEnvironments([env])) for _ in range(2))
    for model in (kept, forgotten):
        start(model, 3)
    closed.clear()
    del model, forgotten
    gc.collect()
    assert len(closed) == 3 and env.unwrapped not in closed
    assert kept.step(small_actions(3)).valid.all()
    env.step(small_actions(1)[0])
    kept.close()
    assert len(closed) == 6


def test_a_pool_is_not_kept_by_its_environment() -> None:
    env = point()
    model = EnvPoolModel(LocalEnvironments([env]))
    env.planner = model
    gone = weakref.ref(model), weakref.ref(env)
    del env, model
    gc.collect()
    assert [what() for what in gone] == [None, None]
