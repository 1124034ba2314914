"""Collects rollouts as SB3 does, but does not store faulty steps."""

import inspect
import logging
import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import MaybeCallback, RolloutReturn
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecNormalize, unwrap_vec_normalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn, VecEnvWrapper
from stable_baselines3.her import HerReplayBuffer

from sb3_mcbs.agents.faults import NonFiniteError, broken_row, check_observations, is_finite
from sb3_mcbs.models.workers import await_answers
from sb3_mcbs.snapshot import SIMULATION_DIVERGED
from sb3_mcbs.types import map_arrays

logger = logging.getLogger("sb3_mcbs")


class CheckedRollouts(OffPolicyAlgorithm):
    """An agent whose environments are checked at every step.

    Values that are not finite end the training with an error. A step in which a simulation diverged is not
    stored, nor, as in SB3, the step in which a callback stopped the training. The steps before and after it
    are kept apart.
    """

    #: Number of steps in which a simulation diverged.
    n_diverged_steps = 0
    _checked_env: "VecCheckFinite | None" = None

    def collect_rollouts(self, env: VecEnv, *args: Any, **kwargs: Any) -> RolloutReturn:
        if self._checked_env is None or self._checked_env.venv is not env:
            self._checked_env = VecCheckFinite(env)
        self._leave_out_unstored()  # left from the original's step, if a callback copied this agent
        try:
            return super().collect_rollouts(self._checked_env, *args, **kwargs)
        finally:
            self._leave_out_unstored()

    def _leave_out_unstored(self) -> None:
        assert self._checked_env is not None and self.replay_buffer is not None
        if self._checked_env.unstored is not None:
            new_obs, reward, dones = self._checked_env.unstored
            self._checked_env.unstored = None
            self._record_rewards(reward, dones)
            leave_out_step(self, self.replay_buffer, new_obs)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **kwargs: Any,
    ) -> tuple[int, BaseCallback]:
        will_reset = reset_num_timesteps or self._last_obs is None
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)
        check_observations(self._last_obs)
        if will_reset:
            self._checked_env = None
            self._begin_episodes()
        return result

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        assert self._checked_env is not None
        self._checked_env.unstored = None
        self._record_rewards(reward, dones)
        diverged = [index for index, info in enumerate(infos) if SIMULATION_DIVERGED in info]
        if diverged and self.n_diverged_steps == 0:
            warn_of_divergence(buffer_action, diverged, self.num_timesteps)
        self.n_diverged_steps += len(diverged)
        self.logger.record("rollout/diverged_steps", self.n_diverged_steps)
        if diverged:
            leave_out_step(self, replay_buffer, new_obs)
        else:
            self._store_valid_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def _store_valid_transition(self, *transition: Any) -> None:
        """Store a step without faults.

        :param transition: the arguments of :meth:`_store_transition`.
        """
        super()._store_transition(*transition)

    def _record_rewards(self, reward: np.ndarray, dones: np.ndarray) -> None:
        """Record a step, whether it is stored or not.

        :param reward: ``[n_envs]``, as the agent got them.
        :param dones: ``[n_envs]``, whether an episode ended.
        """

    def _begin_episodes(self) -> None:
        """Begin new episodes after a reset of all environments."""


class VecCheckFinite(VecEnvWrapper):
    """Checks observations and rewards before callbacks or the agent see them.

    :param venv: the environments, with all their wrappers.

    :ivar unstored: observations, rewards and dones of the last step, until it is stored.
    """

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.unstored: tuple[Any, np.ndarray, np.ndarray] | None = None
        self._normalizer = unwrap_vec_normalize(venv)
        self._actions = np.zeros(0)

    def __getstate__(self) -> dict[str, Any]:
        # SB3's wrappers keep the members of their class, which cannot be copied.
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

        :raises NonFiniteError: if an observation or a reward is not finite. The statistics of
            ``VecNormalize`` are then restored.
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
            "The transition was not stored. Check what the environment computes with this action "
            "(stable_baselines3.common.env_checker.check_env helps), and let it end the episode instead."
        )


class _Statistics:
    """A snapshot of ``VecNormalize`` statistics: references suffice, since updates create new arrays."""

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


def _what_is_not_finite(
    observations: Any, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]
) -> tuple[int, str] | None:
    """Find an environment that returned values that are not finite.

    :return: its index, and what it returned; None if all values are finite.
    """
    if not is_finite(rewards):
        index = int(np.flatnonzero(~np.isfinite(rewards))[0])
        return index, f"the reward {rewards[index]}"
    broken = broken_row(observations)
    if broken is None and dones.any():
        for index in np.flatnonzero(dones).tolist():
            last = infos[index].get("terminal_observation")
            if last is None or SIMULATION_DIVERGED in infos[index]:
                continue
            rows = map_arrays(lambda part: np.asarray(part)[None], last)
            found = broken_row(rows)
            if found is not None:
                return index, f"the last observation {found[1]}, which is not finite,"
    return None if broken is None else (broken[0], f"the observation {broken[1]}, which is not finite,")


def break_trajectories(buffer: ReplayBuffer) -> None:
    """Separate the last stored step from the next one.

    Call this when a step is left out. Otherwise n-step returns, and goals from the future of an episode,
    would cross the gap. The last stored step then counts as truncated, so its target still bootstraps.

    :param buffer: the replay buffer, in which a step is left out for all environments.
    """
    if buffer.pos == 0 and not buffer.full:
        return
    last = buffer.pos - 1  # -1 is the last row, if the buffer has just wrapped around
    for env in np.flatnonzero(buffer.dones[last] == 0).tolist():
        buffer.dones[last, env] = 1
        # A buffer without separate next observations loses this one, so it cannot bootstrap.
        buffer.timeouts[last, env] = not buffer.optimize_memory_usage
        if isinstance(buffer, HerReplayBuffer):
            buffer._compute_episode_length(env)


def leave_out_step(agent: OffPolicyAlgorithm, buffer: ReplayBuffer, new_obs: Any) -> None:
    """Continue after a step that is not stored.

    A row of the buffer holds the step of all environments, so it is left out for all.

    :param agent: the agent that took the step.
    :param buffer: the agent's replay buffer.
    :param new_obs: ``[n_envs, *]``, the agent's next observations.
    """
    break_trajectories(buffer)
    agent._last_obs = new_obs
    if agent._vec_normalize_env is not None:
        agent._last_original_obs = agent._vec_normalize_env.get_original_obs()


def warn_of_divergence(actions: np.ndarray, diverged: list[int], step: int) -> None:
    """Warn that the simulation of an environment diverged for the first time.

    :param actions: ``[n_envs, act_dim]`` in [-1, 1].
    :param diverged: indices of the environments.
    :param step: environment steps so far.
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
