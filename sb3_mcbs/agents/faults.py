"""What goes wrong while an agent acts in its environments: noticed, named, kept out of what it learns."""

import inspect
import logging
import math
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecNormalize,
    unwrap_vec_normalize,
)
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn, VecEnvWrapper
from stable_baselines3.her import HerReplayBuffer

from sb3_mcbs.models.workers import await_answers, worker_error
from sb3_mcbs.search.interface import SearchResult
from sb3_mcbs.snapshot import SIMULATION_DIVERGED
from sb3_mcbs.types import ForwardModel, Observations, map_arrays

logger = logging.getLogger("sb3_mcbs")

_LOOPS_OVER_ENVIRONMENTS = (DummyVecEnv.step_wait.__code__, DummyVecEnv.reset.__code__)


class NonFiniteError(ValueError):
    """An environment or a network gave a number that is NaN or infinite."""


@contextmanager
def environment_named(vec_env: VecEnv) -> Iterator[None]:
    """Say of an error which of several environments it came from.

    An error of an environment in this process is raised as it is, with a note.

    :param vec_env: the environments that are stepped inside.
    :raises WorkerError: if the worker process of an environment has ended; one that hangs is not noticed.
    :raises ValueError: see :func:`check_whole`.
    """
    check_whole(vec_env)
    try:
        yield
    except Exception as error:
        base = vec_env.unwrapped
        if isinstance(base, SubprocVecEnv) and isinstance(error, EOFError | OSError):
            reason = worker_error(base)
            if reason is not None:
                raise reason from error
        for frame, _ in traceback.walk_tb(error.__traceback__):
            if frame.f_code in _LOOPS_OVER_ENVIRONMENTS and frame.f_locals["self"] is base:
                error.add_note(
                    f"This happened in environment {frame.f_locals['env_idx']} of {base.num_envs}."
                )
        raise


def check_whole(vec_env: VecEnv) -> None:
    """Refuse wrappers around nothing.

    :param vec_env: the environments.
    :raises ValueError: if there are none, as in a copy of a ``VecNormalize``.
    """
    layer: Any = vec_env
    while isinstance(layer, VecEnvWrapper):
        name, layer = type(layer).__name__, vars(layer).get("venv")
        if layer is None:
            raise ValueError(
                f"There are no environments in this {name}: SB3 leaves them out of its copies. Give it some "
                "with set_venv(...), or the agent others with set_env(...)."
            )


class VecCheckFinite(VecEnvWrapper):
    """Environments whose observations and rewards are checked before anyone else sees them.

    :param venv: the environments, with all their wrappers.

    :ivar unstored: observations, rewards and dones of the last step, until it is stored.
    """

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.unstored: tuple[Any, np.ndarray, np.ndarray] | None = None
        self._normalizer = unwrap_vec_normalize(venv)
        self._actions = np.zeros(0)

    def __getstate__(self) -> dict[str, Any]:
        # SB3's wrappers note what their class has, which cannot be copied.
        return {name: value for name, value in vars(self).items() if name != "class_attributes"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, class_attributes=dict(inspect.getmembers(type(self))))

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Step the environments.

        :raises NonFiniteError: if an observation or a reward is not finite. The statistics of a
            ``VecNormalize`` are then as before the step.
        """
        normalizer = self._normalizer
        before = None if normalizer is None else _Statistics(normalizer)
        base = self.venv.unwrapped
        if isinstance(base, SubprocVecEnv):
            await_answers(base, range(self.num_envs))
        result = self.venv.step_wait()
        observations, rewards, dones, infos = result
        if normalizer is not None:
            observations, rewards = normalizer.old_obs, normalizer.old_reward
        reason = _what_is_not_finite(observations, rewards, dones, infos)
        if reason is None:
            self.unstored = result[:3]
            return result
        if before is not None:
            before.put_back()
        env_index, what = reason
        raise NonFiniteError(
            f"Environment {env_index} returned {what} after the action {self._actions[env_index].tolist()}. "
            "The transition was not stored. Find out with this action what the environment computes there "
            "(stable_baselines3.common.env_checker.check_env helps), and let it end the episode instead."
        )


class _Statistics:
    """The statistics of a ``VecNormalize`` at one moment, which it replaces rather than changes."""

    def __init__(self, normalizer: VecNormalize) -> None:
        observations = getattr(normalizer, "obs_rms", {})
        rms = [
            normalizer.ret_rms,
            *(observations.values() if isinstance(observations, dict) else [observations]),
        ]
        self._kept: list[tuple[RunningMeanStd, Any, Any, Any]] = [(r, r.mean, r.var, r.count) for r in rms]
        self._normalizer, self._returns = normalizer, normalizer.returns

    def put_back(self) -> None:
        for rms, mean, var, count in self._kept:
            rms.mean, rms.var, rms.count = mean, var, count
        self._normalizer.returns = self._returns


def check_observations(observations: Any) -> None:
    """Refuse observations of a reset that are not finite.

    :param observations: ``[n_envs, *]``, or a dict of such arrays.
    :raises NonFiniteError: names the environment.
    """
    broken = _broken_rows(observations)
    if broken is not None:
        raise NonFiniteError(
            f"Environment {broken[0]} is in a state whose observation is not finite: {broken[1]}. Find out "
            "what its reset, or its last step, computes there "
            "(stable_baselines3.common.env_checker.check_env helps)."
        )


def check_networks(
    policy: Callable[[Observations], np.ndarray],
    value: Callable[[Observations, np.ndarray], np.ndarray],
    observations: Observations,
) -> None:
    """Tell networks that diverged from rollouts that did.

    :param policy: the actor.
    :param value: the critics.
    :param observations: ``[n_envs, *]``, present observations.
    :raises NonFiniteError: if it is the networks, or the environments.
    """
    check_observations(observations)
    actions = policy(observations)
    if not is_finite(actions):
        answer = "The actor answers"
    elif not is_finite(value(observations, actions)):
        answer = "The critics answer"
    else:
        return
    raise NonFiniteError(
        f"{answer} the present observations with NaN or infinity: the networks have diverged, and no action "
        "can be chosen. Go back to an agent that was saved earlier, and train with a lower "
        "learning_rate, or with rewards and observations on a smaller scale (VecNormalize)."
    )


class InvalidDecisions:
    """Tells of decisions in a row in which every simulation was invalid: after 10, 100, 1000, ..."""

    def __init__(self) -> None:
        self._in_a_row = 0
        self._said_why = False

    def note(self, result: SearchResult, model: ForwardModel | None) -> None:
        """Count a decision.

        :param result: of the search.
        :param model: what simulated; ``None`` if nothing did.
        """
        if (result.chosen >= 0).any() or not result.invalid_rollouts:
            self._in_a_row = 0
            return
        before, self._in_a_row = self._in_a_row, self._in_a_row + len(result.chosen)
        if self._in_a_row < 10 or len(str(before)) == len(str(self._in_a_row)):
            return
        message = (
            f"All simulations of the last {self._in_a_row} decisions were invalid: nothing is chosen by "
            "search, and the policy's own actions are executed instead. "
        )
        error = "" if model is None else model.first_error
        if error:
            message += f"A copy of the environment raised {error.strip().splitlines()[-1]}"
        else:
            message += (
                "They diverged, or their observations, rewards or values were not finite. A smaller "
                "rollout_depth or beam_noise may help."
            )
        logger.error("%s%s", message, f"\n{error}" if error and not self._said_why else "")
        warnings.warn(message, stacklevel=5)
        self._said_why = True


def is_finite(values: np.ndarray) -> bool:
    """Whether all numbers are; quicker than asking for each, since a sum is finite only if its terms are.

    :param values: of any shape.
    """
    return bool(math.isfinite(values.sum(dtype=np.float64)) or np.isfinite(values).all())


def _broken_rows(observations: Any) -> tuple[int, str] | None:
    """Find an environment whose observation is not finite.

    :param observations: ``[n_envs, *]``, or a dict of such arrays.
    :return: its index, and the observation in words.
    """
    if isinstance(observations, dict):
        return next(filter(None, (_broken_rows(values) for values in observations.values())), None)
    values = np.asarray(observations)
    if values.dtype.kind != "f" or is_finite(values):
        return None
    index = int(np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))[0])
    return index, np.array2string(values[index], threshold=20)


def _what_is_not_finite(
    observations: Any, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]
) -> tuple[int, str] | None:
    """Find an environment that returned numbers that are not finite.

    :return: its index, and what it returned; None if all is well.
    """
    if not is_finite(rewards):
        index = int(np.flatnonzero(~np.isfinite(rewards))[0])
        return index, f"the reward {rewards[index]}"
    broken = _broken_rows(observations)
    if broken is None and dones.any():
        for index in np.flatnonzero(dones).tolist():
            last = infos[index].get("terminal_observation")
            if last is None or SIMULATION_DIVERGED in infos[index]:
                continue
            rows = map_arrays(lambda part: np.asarray(part)[None], last)
            found = _broken_rows(rows)
            if found is not None:
                return index, f"the last observation {found[1]}, which is not finite,"
    return None if broken is None else (broken[0], f"the observation {broken[1]}, which is not finite,")


def diverged_environments(infos: list[dict[str, Any]]) -> list[int]:
    """The environments whose simulation diverged in a step.

    :param infos: one per environment.
    """
    return [index for index, info in enumerate(infos) if SIMULATION_DIVERGED in info]


def break_trajectories(buffer: ReplayBuffer) -> None:
    """Keep what is stored next apart from what was stored last.

    To be called when a step is left out: otherwise returns over several steps, and goals from the future of
    an episode, would reach across the gap. What was stored last then counts as truncated, so that its
    value is still bootstrapped.

    :param buffer: where a step is left out for all environments.
    """
    if buffer.pos == 0 and not buffer.full:
        return
    last = buffer.pos - 1  # -1 is the last row, if the buffer has just begun anew
    for env in np.flatnonzero(buffer.dones[last] == 0).tolist():
        buffer.dones[last, env] = 1
        # A buffer without room of its own for next observations loses this one: no value can follow.
        buffer.timeouts[last, env] = not buffer.optimize_memory_usage
        if isinstance(buffer, HerReplayBuffer):
            buffer._compute_episode_length(env)


def leave_out_step(agent: OffPolicyAlgorithm, buffer: ReplayBuffer, new_obs: Any) -> None:
    """Go on after a step that is not stored.

    A row of the buffer holds the step of all environments, so it is left out for all.

    :param agent: the agent that did the step.
    :param buffer: where it would be stored.
    :param new_obs: ``[n_envs, *]``, what the agent acts on next.
    """
    break_trajectories(buffer)
    agent._last_obs = new_obs
    if agent._vec_normalize_env is not None:
        agent._last_original_obs = agent._vec_normalize_env.get_original_obs()


def warn_of_divergence(actions: np.ndarray, diverged: list[int], step: int) -> None:
    """Tell the user that the simulation of an environment diverged for the first time.

    :param actions: ``[n_envs, act_dim]`` in [-1, 1].
    :param diverged: the environments.
    :param step: how many steps were done.
    """
    env = diverged[0]
    message = (
        f"The simulation of environment {env} diverged at step {step}, after the action "
        f"{actions[env].tolist()} (scaled to [-1, 1]): the simulator reset itself. The transition is not "
        "stored and the episode ends as truncated. Further ones are counted in rollout/diverged_steps; if "
        "there are many, use a smaller time step or weaker actuators."
    )
    logger.warning(message)
    warnings.warn(message, stacklevel=3)
