"""Environments in worker processes are simulated as those of this process are."""

import gc
import traceback
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import RescaleAction
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_mcbs.models import (
    EnvPoolModel,
    ForwardModelError,
    LocalEnvironments,
    WorkerEnvironments,
    WorkerError,
    make_forward_model,
)
from sb3_mcbs.models.copies import _COPIES
from sb3_mcbs.snapshot import SnapshotEnvWrapper


class Unpackable(Exception):
    """Can be pickled, but not unpickled."""

    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} and {two}")


def fail(wrapper: SnapshotEnvWrapper, how: str) -> Any:
    if how == "plainly":
        raise ZeroDivisionError("on purpose")
    if how == "oddly":
        raise Unpackable(1, 2)
    return lambda: None


def describe(wrapper: SnapshotEnvWrapper, *args: Any) -> tuple:
    return (type(wrapper).__name__, *args)


def count_pools(wrapper: SnapshotEnvWrapper) -> int:
    return len(_COPIES.get(wrapper, {}))


@pytest.fixture(scope="module")
def workers() -> Iterator[SubprocVecEnv]:
    vec_env = make_vec_env("HalfCheetah-v5", 2, vec_env_cls=SubprocVecEnv, wrapper_class=SnapshotEnvWrapper)
    yield vec_env
    vec_env.close()


@pytest.mark.parametrize("kind", ["mujoco", "pool"])
def test_both_places_give_the_same_numbers(workers: SubprocVecEnv, kind: str) -> None:
    local = make_vec_env("HalfCheetah-v5", 2, vec_env_cls=DummyVecEnv, wrapper_class=SnapshotEnvWrapper)
    space, results = local.action_space, []
    for vec_env, environments in (
        (local, LocalEnvironments(local.envs)),
        (workers, WorkerEnvironments(workers)),
    ):
        vec_env.seed(3)
        seen = [vec_env.reset()]
        model = make_forward_model(environments, kind, n_threads=1)
        assert len(environments) == 2
        assert model.deterministic
        rng = np.random.default_rng(0)
        for env_indices in ([0, 1], [1]):
            model.set_roots(model.read_roots(env_indices), np.repeat(np.arange(len(env_indices)), 3), rng)
            for _ in range(2):
                actions = rng.uniform(space.low, space.high, (model.n_rows, *space.shape)).astype(np.float32)
                seen += [array.copy() for array in model.step(actions)[:4]]
                model.select(np.repeat(np.arange(0, model.n_rows, 2), 2))
            real = vec_env.step(actions[[0, -1]])
            seen += [real[0], real[1].astype(np.float32)]
        model.refresh()
        assert model.n_rows == 0
        model.close()
        results.append(seen)
    for ours, theirs in zip(*results, strict=True):
        assert ours.tobytes() == theirs.tobytes()


def test_what_was_predicted_happens(workers: SubprocVecEnv) -> None:
    model = make_forward_model(WorkerEnvironments(workers))
    assert model.kind == "mujoco"
    workers.reset()
    model.set_roots(model.read_roots([0, 1]), np.arange(2), np.random.default_rng())
    actions = np.full((2, 6), 0.3, dtype=np.float32)
    predicted = model.step(actions)
    observations, rewards, *_ = workers.step(actions)
    np.testing.assert_array_equal(predicted.observations, observations)
    np.testing.assert_array_equal(predicted.rewards, rewards)
    model.close()


def test_errors_of_workers_surface_and_leave_them_usable(workers: SubprocVecEnv) -> None:
    environments = WorkerEnvironments(VecNormalize(workers))
    with pytest.raises(ZeroDivisionError, match="on purpose") as caught:
        environments.apply([0, 1], fail, "plainly")
    assert "environment 0" in str(caught.value.__cause__)
    assert "in fail" in str(caught.value.__cause__)
    with pytest.raises(RuntimeError, match="Unpackable: 1 and 2"):
        environments.apply([1], fail, "oddly")
    with pytest.raises((AttributeError, TypeError), match=r"lambda|local"):
        environments.apply([0], fail, "with a result that cannot be sent")
    assert environments.apply([1, 0], describe, "x") == [("SnapshotEnvWrapper", "x")] * 2
    assert environments.apply_each([1, 0], describe, [(1,), (0,)]) == [
        ("SnapshotEnvWrapper", 1),
        ("SnapshotEnvWrapper", 0),
    ]


def test_no_look_ahead_in_the_middle_of_a_step(workers: SubprocVecEnv) -> None:
    workers.reset()
    environments = WorkerEnvironments(workers)
    workers.step_async(np.zeros((2, 6), dtype=np.float32))
    with pytest.raises(ForwardModelError, match="in the middle of a step"):
        environments.apply([0], describe)
    with pytest.raises(ForwardModelError, match="in the middle of a step"):
        WorkerEnvironments(workers)
    workers.step_wait()


def test_closing_after_the_workers_have_ended() -> None:
    vec_env = SubprocVecEnv([lambda: SnapshotEnvWrapper(gym.make("Pendulum-v1"))], start_method="fork")
    model = make_forward_model(WorkerEnvironments(vec_env))
    vec_env.close()
    with pytest.raises(ForwardModelError, match="was closed"):
        model.read_roots([0])
    model.close()


def test_an_environment_without_the_wrapper_is_refused() -> None:
    vec_env = SubprocVecEnv([lambda: gym.make("Pendulum-v1")], start_method="fork")
    with pytest.raises(ForwardModelError, match=r"env_wrapper: sb3_mcbs\.SnapshotEnvWrapper"):
        WorkerEnvironments(vec_env)
    vec_env.close()
    with pytest.raises(ForwardModelError, match="expected a SubprocVecEnv, got DummyVecEnv"):
        WorkerEnvironments(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))


def test_a_wrapper_that_is_not_outermost_is_refused() -> None:
    def half_as_strong(env: gym.Env) -> gym.Env:
        return RescaleAction(env, np.float32(-1), np.float32(1))

    def pendulum() -> gym.Env:
        return gym.make("Pendulum-v1")

    makers = [
        lambda: SnapshotEnvWrapper(Monitor(half_as_strong(SnapshotEnvWrapper(pendulum())))),
        lambda: half_as_strong(SnapshotEnvWrapper(pendulum())),
        lambda: half_as_strong(pendulum()),
        lambda: Monitor(SnapshotEnvWrapper(half_as_strong(pendulum()))),
    ]
    vec_env = SubprocVecEnv(makers, start_method="fork")
    outside = r"environments \[1, 3\] have Monitor, RescaleAction outside of their SnapshotEnvWrapper"
    with pytest.raises(ForwardModelError, match=rf"\[2\] were made without .* and {outside}"):
        WorkerEnvironments(vec_env)
    vec_env.reset()  # the workers live on
    vec_env.close()
    vec_env = SubprocVecEnv(makers[:1], start_method="fork")
    assert WorkerEnvironments(vec_env).apply([0], describe) == [("SnapshotEnvWrapper",)]
    vec_env.close()


def test_copies_in_workers_go_after_their_pool_has_gone(workers: SubprocVecEnv) -> None:
    workers.reset()
    environments = WorkerEnvironments(workers)
    kept = EnvPoolModel(environments)
    before = environments.apply([0, 1], count_pools)
    forgotten = EnvPoolModel(WorkerEnvironments(workers))
    # Workers that are stepping cannot be told.
    workers.step_async(np.zeros((2, 6), dtype=np.float32))
    del forgotten
    gc.collect()
    workers.step_wait()
    assert environments.apply([0, 1], count_pools) == before
    kept.set_roots(kept.read_roots([0]), np.zeros(2, dtype=int), np.random.default_rng())
    assert kept.step(np.zeros((2, 6), dtype=np.float32)).valid.all()
    kept.close()


def test_a_worker_that_has_ended_is_reported() -> None:
    wrapped = [lambda: SnapshotEnvWrapper(gym.make("Pendulum-v1"))]
    vec_env = SubprocVecEnv(wrapped, start_method="fork")
    environments = WorkerEnvironments(vec_env)
    vec_env.processes[0].kill()
    vec_env.processes[0].join()
    with pytest.raises(WorkerError, match=r"environment 0 was killed by SIGKILL \(exit code -9\)") as caught:
        environments.apply([0], describe)
    # Python 3.12.1 crashes later if the error keeps the buffer that could not be sent.
    assert isinstance(caught.value.__cause__, BrokenPipeError)
    frames = [frame for frame, _ in traceback.walk_tb(caught.value.__cause__.__traceback__)]
    assert "_send" in [frame.f_code.co_name for frame in frames]
    assert not [frame for frame in frames if any(isinstance(x, memoryview) for x in frame.f_locals.values())]
    vec_env.close()
