"""Runs that stop in the middle and go on, for the tests of exact checkpoints."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_mcbs import ExactCheckpointCallback, resume
from tests.conftest import assert_same_parameters


class Crash(RuntimeError):
    pass


class CrashAt(BaseCallback):
    """Raises in the middle of a run."""

    not_checkpointed = ("step",)

    def __init__(self, step: int | None = None) -> None:
        super().__init__()
        self.step = step

    def _on_step(self) -> bool:
        if self.step is not None and self.num_timesteps >= self.step:
            raise Crash
        return True


MakeAgent = Callable[[Path], OffPolicyAlgorithm]


def learn(
    agent, folder: Path, steps: int, crash_at: int | None = None, more=(), save_freq: int = 40, **learn_kwargs
):
    """The one call of learn() that a run and its continuation share."""
    callbacks = [ExactCheckpointCallback(save_freq, folder / "checkpoints"), *more, CrashAt(crash_at)]
    return agent.learn(steps, callback=callbacks, **learn_kwargs)


def crash(
    make_agent: MakeAgent, folder: Path, steps: int, crash_at: int, more=lambda folder: (), **kwargs
) -> None:
    """Begin a run and lose it."""
    agent = make_agent(folder)
    try:
        learn(agent, folder, steps, crash_at, more(folder), **kwargs)
    except Crash:
        agent.env.close()
        return
    raise AssertionError("the run should have crashed")


def assert_resumed_is_exact(
    make_agent: MakeAgent,
    tmp_path: Path,
    steps: int = 150,
    crash_at: int = 105,
    more=lambda folder: (),
    make_env: Callable[[Path], VecEnv] | None = None,
    classes=(),
    **kwargs,
) -> tuple[OffPolicyAlgorithm, OffPolicyAlgorithm]:
    """Compare a run that was lost and resumed with one that was not.

    :return: both agents.
    """
    whole = learn(
        make_agent(tmp_path / "whole"), tmp_path / "whole", steps, more=more(tmp_path / "whole"), **kwargs
    )
    crash(make_agent, tmp_path / "lost", steps, crash_at, more, **kwargs)
    env = None if make_env is None else make_env(tmp_path / "lost")
    resumed = resume(tmp_path / "lost" / "checkpoints", env, classes=classes)
    learn(resumed, tmp_path / "lost", steps, more=more(tmp_path / "lost"), **kwargs)
    assert type(resumed) is type(whole)
    assert_same_runs(whole, resumed)
    return whole, resumed


def assert_same_runs(left: OffPolicyAlgorithm, right: OffPolicyAlgorithm) -> None:
    assert_same_parameters(left, right)
    for name in (
        "num_timesteps",
        "_episode_num",
        "_n_updates",
        "_total_timesteps",
        "_num_timesteps_at_start",
    ):
        assert getattr(left, name) == getattr(right, name), name
    assert [info["r"] for info in left.ep_info_buffer] == [info["r"] for info in right.ep_info_buffer]
    ours, theirs = vars(left.replay_buffer), vars(right.replay_buffer)
    assert left.replay_buffer.pos == right.replay_buffer.pos
    for name, value in ours.items():
        parts = value.items() if isinstance(value, dict) else [(None, value)]
        for key, array in parts:
            if isinstance(array, np.ndarray) and not array.dtype.hasobject:
                other = theirs[name] if key is None else theirs[name][key]
                np.testing.assert_array_equal(array, other, err_msg=f"{name} {key}")
    assert_same_optimizers(left, right)
    for name in ("log_ent_coef", "ent_coef_tensor"):
        assert getattr(left, name, None) == getattr(right, name, None), name
    # What comes next is equal too: the generators are where they were.
    assert left.action_space.sample().tolist() == right.action_space.sample().tolist()


def assert_same_optimizers(left, right) -> None:
    for part in ("actor", "critic"):
        ours = getattr(left, part).optimizer.state_dict()["state"]
        theirs = getattr(right, part).optimizer.state_dict()["state"]
        assert ours.keys() == theirs.keys()
        for index in ours:
            for name in ours[index]:
                assert (ours[index][name] == theirs[index][name]).all(), (part, index, name)
