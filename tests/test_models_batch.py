"""How the batch model keeps, copies and drops rows, and when it is taken at all."""

import csv
import logging
import os
import pickle
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import mujoco
import numba.core.caching
import numpy as np
import pytest
import torch
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_mcbs.models import (
    EnvPoolModel,
    Family,
    ForwardModelError,
    LocalEnvironments,
    MujocoBatchModel,
    make_forward_model,
)
from sb3_mcbs.models.compiled_rows import Rows, step_rows
from sb3_mcbs.models.compiling import fingerprint, specialize
from sb3_mcbs.models.libmujoco import INTEGRATION
from sb3_mcbs.models.mujoco_batch import available_cpus
from sb3_mcbs.models.simulator import Simulator
from sb3_mcbs.snapshot import SnapshotEnvWrapper

RNG = np.random.default_rng(0)


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo writes a log file where it runs when a simulation diverges."""
    monkeypatch.chdir(tmp_path)


def cheetah(**kwargs) -> SnapshotEnvWrapper:
    env = SnapshotEnvWrapper(gym.make("HalfCheetah-v5", **kwargs))
    env.reset(seed=0)
    return env


def actions_for(env: gym.Env, rows: int, seed: int = 0) -> np.ndarray:
    space = env.unwrapped.action_space
    rng = np.random.default_rng(seed)
    return rng.uniform(space.low, space.high, size=(rows, *space.shape)).astype(np.float32)


def start(model, rows: int, env_index: int = 0) -> None:
    model.set_roots(model.read_roots([env_index]), np.zeros(rows, dtype=int), np.random.default_rng(0))


def test_select_copies_drops_and_grows() -> None:
    env = SnapshotEnvWrapper(gym.make("Ant-v5"))
    env.reset(seed=0)
    model = MujocoBatchModel(LocalEnvironments([env]), n_threads=1)
    start(model, 4)
    model.step(actions_for(env, 4))
    index = np.repeat([0, 2, 3], [1, 50, 60])
    model.select(index)
    assert model.n_rows == 111
    grown = model.step(np.repeat(actions_for(env, 1, seed=1), 111, axis=0))
    # The same two steps without any copying.
    start(model, 4)
    model.step(actions_for(env, 4))
    plain = model.step(np.repeat(actions_for(env, 1, seed=1), 4, axis=0))
    np.testing.assert_array_equal(grown.observations, plain.observations[index])
    np.testing.assert_array_equal(grown.rewards, plain.rewards[index])
    assert not np.array_equal(plain.rewards[0], plain.rewards[2])


def test_roots_of_several_environments_and_a_subset() -> None:
    envs = [cheetah() for _ in range(3)]
    for number, env in enumerate(envs):
        env.reset(seed=number)
    model = MujocoBatchModel(LocalEnvironments(envs), n_threads=1)
    model.set_roots(model.read_roots([2, 0]), np.array([0, 0, 1]), RNG)
    actions = actions_for(envs[0], 3)
    found = model.step(actions)
    np.testing.assert_array_equal(found.observations[1], envs[2].step(actions[1])[0])
    np.testing.assert_array_equal(found.observations[2], envs[0].step(actions[2])[0])


def test_there_may_be_no_rows() -> None:
    env = cheetah()
    model = MujocoBatchModel(LocalEnvironments([env]), n_threads=2)
    start(model, 0)
    assert model.step(np.zeros((0, 6), dtype=np.float32)).observations.shape == (0, 17)


def test_an_old_root_stays_good() -> None:
    env = cheetah()
    model = MujocoBatchModel(LocalEnvironments([env]), n_threads=1)
    root = model.read_roots([0])
    actions = actions_for(env, 2)
    first = env.step(actions[0])[0]
    env.step(actions[1])
    model.set_roots(root, np.zeros(1, dtype=int), RNG)
    np.testing.assert_array_equal(model.step(actions[:1]).observations[0], first)


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Humanoid-v5"])
@pytest.mark.parametrize("how", ["action", "velocity"])
def test_only_the_row_that_diverges_becomes_invalid(env_id: str, how: str) -> None:
    env = SnapshotEnvWrapper(gym.make(env_id))
    env.reset(seed=0)
    model = MujocoBatchModel(LocalEnvironments([env]), n_threads=2)
    root = model.read_roots([0])[0]
    bad_root, actions = root.copy(), actions_for(env, 3)
    if how == "action":
        actions[1] = np.nan
    else:
        bad_root[1 + env.unwrapped.model.nq] = 1e11
    model.set_roots([root, bad_root, root], np.arange(3), RNG)
    undisturbed_actions = actions_for(env, 3)
    found = model.step(actions)
    np.testing.assert_array_equal(found.valid, [True, False, True])
    if how == "velocity":
        assert np.isfinite(found.observations).all(), "MuJoCo resets itself: finite numbers prove nothing"
    model.select(np.array([0, 1, 1, 2]))
    np.testing.assert_array_equal(model.step(actions_for(env, 4)).valid, [True, False, False, True])
    model.set_roots([root], np.zeros(3, dtype=int), RNG)
    again = model.step(undisturbed_actions)
    assert again.valid.all()
    np.testing.assert_array_equal(again.observations[[0, 2]], found.observations[[0, 2]])


def test_divergence_after_the_end_does_not_invalidate_the_row() -> None:
    env = SnapshotEnvWrapper(gym.make("InvertedPendulum-v5"))
    env.reset(seed=0)
    model = MujocoBatchModel(LocalEnvironments([env]), n_threads=1)
    start(model, 2)
    push = np.array([[3.0], [0.0]], dtype=np.float32)
    for _ in range(30):
        ended = model.step(push).terminated
        if ended[0]:
            break
    np.testing.assert_array_equal(ended, [True, False])
    np.testing.assert_array_equal(model.step(np.full((2, 1), np.nan, dtype=np.float32)).valid, [True, False])


def _heights(env, kept, data, action, observation):
    observation[:] = data.qpos[2::7]
    return 0.0, False


def falling_balls(memory: str) -> tuple[mujoco.MjModel, Rows, Simulator]:
    """Two rows of many balls on a floor, with little memory for their contacts."""
    places = [(x * 0.05, y * 0.05) for x in range(6) for y in range(6)]
    balls = "".join(f'<body pos="{x} {y} .05"><freejoint/><geom size=".06"/></body>' for x, y in places)
    floor = '<geom type="plane" size="5 5 1"/>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><size memory="{memory}"/><worldbody>{floor}{balls}</worldbody></mujoco>'
    )
    data, size = mujoco.MjData(model), mujoco.mj_stateSize(model, INTEGRATION)
    rows = Rows(
        np.zeros((2, size)),
        np.zeros((2, 0)),
        np.zeros((2, len(places))),
        np.zeros(2),
        *np.zeros((2, 2), dtype=bool),
    )
    mujoco.mj_getState(model, data, rows.states[0], INTEGRATION)
    rows.states[1] = rows.states[0]
    family = Family(lambda env: {}, ("qpos",), _heights)
    return model, rows, Simulator(family, "Balls", {"dt": 0.002}, model, 1, 1)


def test_a_full_contact_buffer_is_no_divergence() -> None:
    model, rows, simulator = falling_balls("60K")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert data.warning.number[mujoco.mjtWarning.mjWARN_CONTACTFULL] > 0
    actions = np.zeros((2, 0))
    simulator.run(step_rows, 2, rows, actions)
    np.testing.assert_array_equal(rows.valid, [True, True])
    assert rows.observations[0].tobytes() == data.qpos[2::7].tobytes()
    rows.states[1, 1] = np.nan
    simulator.run(step_rows, 2, rows, actions)
    np.testing.assert_array_equal(rows.valid, [True, False])


def test_an_error_of_mujoco_makes_the_row_invalid() -> None:
    model, rows, simulator = falling_balls("30K")
    with pytest.raises(mujoco.FatalError):
        mujoco.mj_step(model, mujoco.MjData(model))
    before = rows.states.copy()
    for _ in range(3):
        simulator.run(step_rows, 2, rows, np.zeros((2, 0)))
        np.testing.assert_array_equal(rows.valid, [False, False])
    np.testing.assert_array_equal(rows.states, before)


def test_plain_python_gives_the_same_numbers_as_compiled_code(tmp_path: Path) -> None:
    env = SnapshotEnvWrapper(gym.make("Humanoid-v5"))
    env.reset(seed=0)
    model = MujocoBatchModel(LocalEnvironments([env]), n_threads=2)
    start(model, 3)
    actions = actions_for(env, 3)
    expected = model.step(actions)
    roots, results = tmp_path / "roots.npy", tmp_path / "results.npy"
    np.save(roots, model.read_roots([0])[0])
    script = (
        "import sys, gymnasium, numpy as np\n"
        "from sb3_mcbs.models import LocalEnvironments, MujocoBatchModel\n"
        "from sb3_mcbs.snapshot import SnapshotEnvWrapper\n"
        "env = SnapshotEnvWrapper(gymnasium.make('Humanoid-v5'))\n"
        "env.reset(seed=0)\n"
        "model = MujocoBatchModel(LocalEnvironments([env]), n_threads=2)\n"
        "model.set_roots([np.load(sys.argv[1])], np.zeros(3, dtype=int), None)\n"
        "step = model.step(np.load(sys.argv[2]))\n"
        "np.save(sys.argv[3], np.column_stack([step.observations, step.rewards]))\n"
    )
    given = tmp_path / "actions.npy"
    np.save(given, actions)
    command = [sys.executable, "-c", script, str(roots), str(given), str(results)]
    subprocess.run(command, check=True, env={**os.environ, "NUMBA_DISABLE_JIT": "1"})
    found = np.load(results)
    assert found.tobytes() == np.column_stack([expected.observations, expected.rewards]).tobytes()


@pytest.mark.slow
def test_the_second_process_finds_the_code_on_disk(tmp_path: Path) -> None:
    script = (
        "import logging, gymnasium\n"
        "logging.basicConfig(level=logging.INFO)\n"
        "from sb3_mcbs.models import LocalEnvironments, MujocoBatchModel, compiling\n"
        "from sb3_mcbs.snapshot import SnapshotEnvWrapper\n"
        "env = SnapshotEnvWrapper(gymnasium.make('InvertedPendulum-v5'))\n"
        "MujocoBatchModel(LocalEnvironments([env]), n_threads=1)\n"
    )
    variables = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", script]
    runs = [
        subprocess.run(command, check=True, env=variables, capture_output=True, text=True) for _ in range(2)
    ]
    assert ["compiling the look-ahead" in run.stderr for run in runs] == [True, False]


def _plus_something(value: int) -> int:
    return value + something


something = 0


def test_without_a_folder_to_write_the_log_says_that_nothing_is_kept(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(numba.core.caching.CacheImpl, "_locator_classes", [])
    with caplog.at_level(logging.INFO, logger="sb3_mcbs"):
        plus_two, plus_three = (specialize(_plus_something, "test", something=n) for n in (2, 3))
    assert (plus_two(1), plus_three(1)) == (3, 4)
    assert caplog.text.count("Compiled code is not kept") == 1


def test_a_changed_helper_gives_another_name_in_the_cache() -> None:
    def calls(helper: Callable[[int], int]) -> Callable[[int], int]:
        return lambda value: helper(value)

    prints = {fingerprint(calls(helper)) for helper in (lambda v: v + 1, lambda v: v + 2, lambda v: v - 1)}
    assert len(prints) == 3
    assert fingerprint(calls(lambda v: v + 1)) in prints


def test_mistakes_are_explained() -> None:
    env = cheetah()
    environments = LocalEnvironments([env])
    model = MujocoBatchModel(environments, n_threads=1)
    start(model, 2)
    with pytest.raises(ValueError, match=r"\(2, 6\).*got \(3, 6\)"):
        model.step(np.zeros((3, 6), dtype=np.float32))
    with pytest.raises(ValueError, match="read by another model"):
        model.set_roots([np.zeros(3)], np.zeros(1, dtype=int), RNG)
    with pytest.raises(ValueError, match="n_threads"):
        MujocoBatchModel(environments, n_threads=-1)
    with pytest.raises(ValueError, match="'auto', 'mujoco', 'pool'"):
        make_forward_model(environments, "batch")
    with pytest.raises(ForwardModelError, match=r"environment 0 is .*SnapshotEnvWrapper"):
        LocalEnvironments([env.env])


# Which environments are taken ------------------------------------------------------------------


class GenerousCheetah(HalfCheetahEnv):
    """Overrides a reward method."""

    def _get_rew(self, x_velocity, action):
        reward, info = super()._get_rew(x_velocity, action)
        return reward + 1, info


class RenamedCheetah(HalfCheetahEnv):
    """Overrides nothing, which no one can know."""


def _monkeypatched() -> gym.Env:
    env = gym.make("HalfCheetah-v5")
    env.unwrapped.control_cost = lambda action: 0.0
    return env


def _wrapper_monkeypatched() -> gym.Env:
    env = gym.wrappers.TimeLimit(HalfCheetahEnv(), 10)
    env.step = lambda action: env.env.step(-action)
    return env


REFUSED = {
    "GenerousCheetah is not a known family": lambda: GenerousCheetah(),
    "RenamedCheetah is not a known family": lambda: gym.wrappers.TimeLimit(RenamedCheetah(), 5),
    "HalfCheetahEnv.control_cost was replaced": _monkeypatched,
    "TimeLimit.step was replaced": _wrapper_monkeypatched,
    "the wrapper ClipAction": lambda: gym.wrappers.ClipAction(gym.make("HalfCheetah-v5")),
    "the wrapper FrameStackObservation": lambda: gym.wrappers.FrameStackObservation(
        gym.make("HalfCheetah-v5"), 2
    ),
    "the wrapper NormalizeReward": lambda: gym.wrappers.NormalizeReward(gym.make("HalfCheetah-v5")),
    "PendulumEnv is not a known family": lambda: gym.make("Pendulum-v1"),
}


@pytest.mark.parametrize("reason", REFUSED)
def test_what_may_differ_lands_on_the_pool(reason: str, caplog: pytest.LogCaptureFixture) -> None:
    env = SnapshotEnvWrapper(REFUSED[reason]())
    with caplog.at_level(logging.INFO, logger="sb3_mcbs"):
        model = make_forward_model(LocalEnvironments([env]))
    assert isinstance(model, EnvPoolModel)
    assert reason in model.description
    assert reason in caplog.text
    expected_level = "INFO" if "Pendulum" in reason else "WARNING"
    chosen = [record for record in caplog.records if record.getMessage().startswith("look-ahead")]
    assert [record.levelname for record in chosen] == [expected_level]
    with pytest.raises(ForwardModelError, match=r"environment 0: \w"):
        make_forward_model(LocalEnvironments([env]), "mujoco")
    env.reset(seed=0)
    action = actions_for(env, 1)
    start(model, 1)
    observation, reward, *_ = env.step(action[0])
    found = model.step(action)
    np.testing.assert_array_equal(found.observations[0], observation)
    assert found.rewards[0] == reward


def test_the_check_finds_what_no_inspection_can(monkeypatch: pytest.MonkeyPatch) -> None:
    real = HalfCheetahEnv.control_cost
    monkeypatch.setattr(HalfCheetahEnv, "control_cost", lambda self, action: real(self, action) * (1 + 1e-6))
    model = make_forward_model(LocalEnvironments([cheetah()]))
    assert isinstance(model, EnvPoolModel)
    assert "the check failed" in model.description
    assert "reward" in model.description


def _patched_time_limit(env: gym.Env) -> gym.Env:
    from rl_zoo3.gym_patches import PatchedTimeLimit

    return PatchedTimeLimit(env, 7)


def _gymnasium_time_limit(env: gym.Env) -> gym.Env:
    # The registry and the package hand out RL Zoo's class once RL Zoo has been imported.
    kind = next(k for k in gym.wrappers.TimeLimit.__mro__ if k.__module__ == "gymnasium.wrappers.common")
    return kind(env, 7)


TRANSPARENT = {
    "Monitor": Monitor,
    "RL Zoo's TimeLimit": _patched_time_limit,
    "Gymnasium's TimeLimit": _gymnasium_time_limit,
    "RecordEpisodeStatistics": gym.wrappers.RecordEpisodeStatistics,
    "OrderEnforcing": gym.wrappers.OrderEnforcing,
    "a second snapshot wrapper": lambda env: gym.wrappers.OrderEnforcing(SnapshotEnvWrapper(env)),
}


@pytest.mark.parametrize("name", TRANSPARENT)
def test_wrappers_that_change_nothing_keep_the_batch(name: str) -> None:
    env = SnapshotEnvWrapper(TRANSPARENT[name](gym.make("HalfCheetah-v5")))
    model = make_forward_model(LocalEnvironments([env]))
    assert isinstance(model, MujocoBatchModel)
    assert model.description.startswith("MuJoCo batch of HalfCheetahEnv")


@pytest.mark.parametrize("difference", ["ctrl_cost_weight", "frame_skip", "MuJoCo models", "class"])
def test_environments_that_differ_are_not_mixed(difference: str) -> None:
    first, second = gym.make("HalfCheetah-v5"), gym.make("HalfCheetah-v5")
    if difference == "ctrl_cost_weight":
        second = gym.make("HalfCheetah-v5", ctrl_cost_weight=0.2)
    elif difference == "frame_skip":
        second = gym.make("HalfCheetah-v5", frame_skip=3)
    elif difference == "MuJoCo models":
        second.unwrapped.model.body_mass[2] *= 1.1
    else:
        second = gym.make("HalfCheetah-v4")
    envs = [SnapshotEnvWrapper(first), SnapshotEnvWrapper(second)]
    model = make_forward_model(LocalEnvironments(envs))
    assert isinstance(model, EnvPoolModel)
    assert f"environments 0 and 1 differ in their {difference}" in model.description
    for number, env in enumerate(envs):
        env.reset(seed=number)
    actions = actions_for(first, 2)
    model.set_roots(model.read_roots([0, 1]), np.arange(2), RNG)
    found = model.step(actions)
    for number, env in enumerate(envs):
        np.testing.assert_array_equal(found.observations[number], env.step(actions[number])[0])


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Ant-v5"])
def test_refresh_follows_an_edited_model(env_id: str) -> None:
    env = SnapshotEnvWrapper(gym.make(env_id))
    env.reset(seed=0)
    model = MujocoBatchModel(LocalEnvironments([env]), n_threads=1)
    action = actions_for(env, 1)
    env.unwrapped.model.body_mass[:] *= 1.3
    env.unwrapped._ctrl_cost_weight = 0.25
    snapshot = env.snapshot()
    observation, reward, *_ = env.step(action[0])
    env.restore(snapshot)
    start(model, 1)
    assert not np.array_equal(model.step(action).observations[0], observation), "it simulates its own copy"
    model.refresh()
    start(model, 1)
    found = model.step(action)
    np.testing.assert_array_equal(found.observations[0], observation)
    assert found.rewards[0] == reward
    env.unwrapped.step = lambda action: None
    with pytest.raises(ForwardModelError, match=r"(AntEnv|HalfCheetahEnv)\.step was replaced"):
        model.refresh()


def test_an_edited_model_is_simulated_as_it_was_when_the_model_was_made() -> None:
    env = cheetah()
    env.unwrapped.model.geom_friction[:, 0] = 0.05
    model = make_forward_model(LocalEnvironments([env]), "mujoco", n_threads=1)
    start(model, 1)
    for step in range(20):
        action = actions_for(env, 1, seed=step)
        np.testing.assert_array_equal(model.step(action).observations[0], env.step(action[0])[0])


@pytest.mark.parametrize("kind", ["auto", "pool"])
def test_nothing_outside_is_touched(kind: str, tmp_path: Path) -> None:
    """Making a model and looking ahead change no state that anybody else can see."""

    folder = tmp_path / "monitor"
    folder.mkdir()

    def make(name: str) -> Monitor:
        return Monitor(gym.make("HalfCheetah-v5", max_episode_steps=12), str(folder / name))

    vec_envs = [
        DummyVecEnv([lambda name=name: SnapshotEnvWrapper(make(name))]) for name in ("watched", "twin")
    ]
    for vec_env in vec_envs:
        vec_env.seed(7)

    def outside() -> list[bytes]:
        torch_state = torch.get_rng_state().numpy()
        states = [
            random.getstate(),
            np.random.get_state(),
            torch_state,
            vec_envs[0]._seeds,
            vec_envs[0]._options,
        ]
        space = vec_envs[0].envs[0].action_space
        states.append(space.np_random.bit_generator.state)
        files = [path.read_bytes() for path in sorted(folder.iterdir())]
        return [pickle.dumps(state) for state in states] + files

    before = outside()
    model = make_forward_model(LocalEnvironments(vec_envs[0].envs), kind, n_threads=1)
    assert outside() == before
    assert vec_envs[0].reset().tobytes() == vec_envs[1].reset().tobytes()
    for step in range(30):
        before = outside()
        start(model, 2)
        for ahead in range(3):
            model.step(actions_for(vec_envs[0].envs[0], model.n_rows, seed=ahead))
            model.select(np.repeat(np.arange(2), 2))
        assert outside() == before
        results = [vec_env.step(actions_for(vec_envs[0].envs[0], 1, seed=step)) for vec_env in vec_envs]
        for watched, twin in zip(results[0][:3], results[1][:3], strict=True):
            assert watched.tobytes() == twin.tobytes()
    model.close()
    assert outside()[0:3] == before[0:3]
    rows = []
    for path in sorted(folder.iterdir()):
        with path.open() as file:
            file.readline()
            rows.append([(row["r"], row["l"]) for row in csv.DictReader(file)])
    assert len(rows[0]) == 2
    assert rows[0] == rows[1]


def test_simulation_takes_no_more_threads_than_omp_num_threads_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    cores = available_cpus()
    for words, expected in {"1": 1, str(cores + 7): cores, "0": cores, "many": cores}.items():
        monkeypatch.setenv("OMP_NUM_THREADS", words)
        assert available_cpus() == expected
