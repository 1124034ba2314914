"""Nothing that a run holds is left out without a reason: not even what a later SB3 might add."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, ProgressBarCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import SubprocVecEnv, VecMonitor, VecNormalize

from sb3_mcbs import MCBS, MCBSTD3, ExactCheckpointCallback, SearchPolicy, resume
from sb3_mcbs.checkpoints import CheckpointError
from sb3_mcbs.checkpoints.components import NOT_STATE, components, not_state_of
from sb3_mcbs.checkpoints.state import RUN, RunState
from sb3_mcbs.networks.gradient_steps import GradientSteps
from tests.checkpoint_helpers import crash, learn
from tests.test_checkpoints import make_env, maker

VALUES = [1, [2.5, np.arange(3)], {"a": (None, "text")}, np.random.default_rng(5)]


def equal(left, right) -> bool:
    if isinstance(left, np.random.Generator):
        return left.bit_generator.state == right.bit_generator.state
    if isinstance(left, list):
        return len(left) == len(right) and all(map(equal, left, right))
    return np.array_equal(left, right) if isinstance(left, np.ndarray) else left == right


class Probe(BaseCallback):
    """Gives every part of a run, and every layer of its environments, an attribute that nobody knows."""

    not_checkpointed = ("found",)

    def __init__(self) -> None:
        super().__init__()
        self.found: dict = {}

    def parts(self) -> dict:
        parts = components(self.model, self.locals["callback"])
        for name in ("agent.env", "evaluation"):
            env = self.model.env if name == "agent.env" else self.locals["callback"].callbacks[1].eval_env
            layer = env.unwrapped.envs[0]
            while isinstance(layer, gym.Wrapper):
                parts[f"{name} {type(layer).__name__}"] = layer.env
                layer = layer.env
        return parts

    def _on_step(self) -> bool:
        if self.num_timesteps == 75:
            for part in self.parts().values():
                part.hidden_state = [*VALUES]
        if self.num_timesteps == 110:
            self.found = {name: getattr(part, "hidden_state", None) for name, part in self.parts().items()}
        return True


def evaluation(probe=None):
    def more(folder):
        env = VecNormalize(VecMonitor(make_vec_env("Pendulum-v1", 1, seed=7)), training=False)
        return [EvalCallback(env, n_eval_episodes=1, eval_freq=30, verbose=0), probe or Probe()]

    return more


def test_every_attribute_of_every_part_is_captured(tmp_path):
    make = maker(MCBSTD3, wrap=lambda env: VecNormalize(VecMonitor(env)))
    crash(make, tmp_path, 150, 105, evaluation())
    probe = Probe()
    agent = resume(tmp_path / "checkpoints", make_vec_env_again(tmp_path))
    learn(agent, tmp_path, 150, more=evaluation(probe)(tmp_path))
    names = " ".join(probe.found)
    for part in (
        "policy.actor.mu.0",
        "replay_buffer",
        "logger",
        "layers[2]",
        "TimeLimit",
        "Monitor",
        "callbacks[1]",
    ):
        assert part in names
    missing = [name for name, value in probe.found.items() if value is None or not equal(value, VALUES)]
    assert missing == []


def make_vec_env_again(folder):
    return VecNormalize(VecMonitor(make_env(folder)))


def all_kinds_of_runs(folder):
    """Runs that have, between them, everything that is left out."""
    make = maker(MCBSTD3, n_envs=2, vec_env_cls=SubprocVecEnv, wrap=lambda env: VecNormalize(VecMonitor(env)))
    agent = make(folder)
    agent.set_logger(configure(str(folder), ["stdout", "csv", "tensorboard"]))
    evaluation = EvalCallback(make_vec_env("Pendulum-v1", 1))
    evaluation.init_callback(SearchPolicy(agent, evaluation.eval_env))
    yield agent, CallbackList([evaluation, ProgressBarCallback(), ExactCheckpointCallback(10, folder)])
    agent.env.close()
    agent = maker(SAC, use_sde=True)(folder)
    agent.learn(30)
    yield agent, CallbackList([Probe()])


def test_every_attribute_is_captured_or_left_out_for_a_reason(tmp_path):
    left_out: set[tuple[type, str]] = set()
    all_reasons = dict(NOT_STATE)
    for agent, callback in all_kinds_of_runs(tmp_path):
        callback.model = agent
        for each in callback.callbacks:
            each.model = vars(each).get("model", agent)
        run = RunState(agent, callback)
        captured = run.capture().json[RUN]["attributes"]
        for name, part in components(agent, callback).items():
            for cls in type(part).__mro__:
                if isinstance(vars(cls).get("not_checkpointed"), dict):
                    all_reasons[cls] = vars(cls)["not_checkpointed"]
            not_state = not_state_of(part)
            content = captured[name]["dict"]
            assert {key for key, _ in content} == set(vars(part)) - not_state, name
            for cls, reasons in all_reasons.items():
                if isinstance(part, cls):
                    left_out |= {(cls, attribute) for attribute in set(vars(part)) & set(reasons)}
    assert {MCBS, GradientSteps, SearchPolicy, ExactCheckpointCallback} < all_reasons.keys()
    assert all(reason for reasons in all_reasons.values() for reason in reasons.values())
    only_at_times = {"_stopped_run", "_checked_env", "pbar", "store", "_settings", "_vec_env"}
    expected = {
        (cls, name) for cls, reasons in all_reasons.items() for name in reasons if name not in only_at_times
    }
    assert expected - left_out == set(), "a reason for an attribute that is no longer there"


def test_the_runs_parts_are_not_skipped_by_their_own_list(tmp_path):
    """not_checkpointed is for attributes that somebody named, and nothing else."""
    agent = maker(SAC)(tmp_path)
    callback = ExactCheckpointCallback(10, tmp_path)
    callback.model = agent
    assert {"n_calls", "num_timesteps", "save_freq", "_next_save", "_rows_added"} & not_state_of(
        callback
    ) == set()


class LateProbe(Probe):
    not_checkpointed = ("late",)


def test_a_class_adds_to_what_its_bases_leave_out():
    assert {"found", "late"} <= not_state_of(LateProbe())


class Chooser(BaseCallback):
    """Holds a function or a class: from step 30 on another one than before."""

    not_checkpointed = ("then",)

    def __init__(self, first, then) -> None:
        super().__init__()
        self.held, self.then = [first], then

    def _on_step(self) -> bool:
        if self.num_timesteps == 30:
            self.held = [self.then]
        return True


@pytest.mark.parametrize(
    ("first", "then"),
    [(print, open), (lambda: 1, lambda: 2), (SAC, Probe)],
    ids=["compiled", "lambda", "class"],
)
def test_functions_and_classes_are_found_again_by_name(first, then, tmp_path):
    crash(maker(SAC), tmp_path, 90, 65, lambda folder: [Chooser(first, then)])
    agent = resume(tmp_path / "checkpoints", make_env(tmp_path), classes=[then])
    chooser = Chooser(first, None)
    learn(agent, tmp_path, 90, more=[chooser])
    assert agent.num_timesteps == 90 and len(chooser.held) == 1
    assert chooser.held[0] is then


def test_what_cannot_be_written_is_named_before_training(tmp_path):
    agent, probe = maker(SAC)(tmp_path), Probe()
    probe.odd = {"key": iter([1])}
    with pytest.raises(CheckpointError, match=r"Probe\.odd\['key'\].*list_iterator.*register_state"):
        learn(agent, tmp_path, 50, more=[probe])
    assert agent.num_timesteps == 0
