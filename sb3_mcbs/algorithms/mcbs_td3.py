"""TD3 that looks ahead before it acts."""

import logging
import time
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn, Schedule
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from stable_baselines3.td3.policies import TD3Policy

from sb3_mcbs.algorithms.faults import (
    CheckedVecEnv,
    check_observations,
    diverged_environments,
    environment_named,
    leave_out_step,
    warn_of_divergence,
)
from sb3_mcbs.algorithms.searcher import Searcher
from sb3_mcbs.algorithms.td3_update import TD3Update
from sb3_mcbs.algorithms.torch_settings import matmul_precision
from sb3_mcbs.search import SearchResult, SearchSettings

logger = logging.getLogger("sb3_mcbs")

SelfMCBSTD3 = TypeVar("SelfMCBSTD3", bound="MCBSTD3")


class MCBSTD3(TD3):
    """
    Monte Carlo Beam Search for TD3 (MCBS-TD3).

    After ``learning_starts`` every action is found by search (Algorithm 1): ``beam_width`` candidates
    around the policy's action are rolled out in exact copies of the environment, rollouts end with the
    critics' value, and the best candidate is executed and stored. Replay, losses and delayed updates are
    those of TD3.

    ``predict`` is the actor alone, without search, as for every SB3 algorithm: it needs no environment.
    To act with search use :class:`~sb3_mcbs.SearchPolicy`.

    The environments are wrapped in :class:`~sb3_mcbs.SnapshotEnvWrapper` by the algorithm, except in a
    ``SubprocVecEnv``, whose environments must be wrapped when they are made.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment to learn from (if registered in Gymnasium, can be str)
    :param learning_rate: learning rate for the Adam optimizers, a constant or a function of the remaining
        progress (from 1 to 0)
    :param buffer_size: size of the replay buffer
    :param learning_starts: how many steps of the model to collect transitions for before learning, and
        searching, starts
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor, of the critics and of the rollouts
    :param train_freq: Update the model every ``train_freq`` steps, or a tuple like ``(5, "step")`` or
        ``(2, "episode")``
    :param gradient_steps: How many gradient steps to do after each rollout; -1 means as many as steps done
    :param action_noise: noise on actions chosen without search (before ``learning_starts``). Searched
        actions are executed as they are unless ``action_noise_after_search`` is set.
    :param replay_buffer_class: Replay buffer class to use (for instance ``HerReplayBuffer``)
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer
    :param n_steps: number of steps of n-step returns in the critic's target
    :param policy_delay: Policy and target networks will only be updated once every policy_delay steps
    :param target_policy_noise: Standard deviation of Gaussian noise added to target policy
    :param target_noise_clip: Limit for absolute value of target policy smoothing noise
    :param stats_window_size: Window size for the rollout logging, in episodes
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators, the search's own included
    :param device: Device (cpu, cuda, ...) on which the networks run; simulation is on the CPU
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :param beam_width: number of candidate actions per decision (``B`` in the paper)
    :param rollout_depth: simulated steps per rollout (``D``); 0 ranks candidates by the critics alone
    :param n_simulations: rollouts per candidate (``N_sim``)
    :param beam_noise: standard deviation of the noise that makes the candidates (``sigma_b``), in the
        action space scaled to [-1, 1]
    :param rollout_noise: the same for the later actions of a rollout; None: as ``beam_noise``
    :param noise_clip: clip that noise to [-noise_clip, noise_clip]; None: not clipped
    :param include_policy_action: make the policy's own action the first candidate
    :param action_noise_after_search: add ``action_noise`` to searched actions too
    :param n_threads: threads that simulate (0: one per available core); the result does not depend on it
    :param forward_model: ``"auto"``, ``"mujoco"`` or ``"pool"``, see the documentation of forward models
    :param matmul_precision: internal precision of float32 matrix products in search and gradient steps, as in
        ``torch.set_float32_matmul_precision`` (``"highest"``, ``"high"`` or ``"medium"``); None: as it is
    :param time_budget: seconds that a decision may take; candidates are then evaluated in rounds until the
        time is used, and runs are not reproducible; None: all candidates, however long it takes
    :param max_beam_width: with ``time_budget``, evaluate up to so many candidates; None: ``beam_width``
    :param fast_update: do gradient steps with SB3's mathematics but fewer instructions, where the networks
        are plain MLPs; others use SB3's own
    """

    def __init__(
        self,
        policy: str | type[TD3Policy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        policy_delay: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        *,
        beam_width: int = 6,
        rollout_depth: int = 3,
        n_simulations: int = 5,
        beam_noise: float = 0.1,
        rollout_noise: float | None = None,
        noise_clip: float | None = None,
        include_policy_action: bool = False,
        action_noise_after_search: bool = False,
        n_threads: int = 0,
        forward_model: str = "auto",
        matmul_precision: str | None = None,
        time_budget: float | None = None,
        max_beam_width: int | None = None,
        fast_update: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_delay=policy_delay,
            target_policy_noise=target_policy_noise,
            target_noise_clip=target_noise_clip,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.beam_width = beam_width
        self.rollout_depth = rollout_depth
        self.n_simulations = n_simulations
        self.beam_noise = beam_noise
        self.rollout_noise = rollout_noise
        self.noise_clip = noise_clip
        self.include_policy_action = include_policy_action
        self.action_noise_after_search = action_noise_after_search
        self.n_threads = n_threads
        self.forward_model = forward_model
        self.matmul_precision = matmul_precision
        self.time_budget = time_budget
        self.max_beam_width = max_beam_width
        self.fast_update = fast_update

        self.search_rng: np.random.Generator | None = None
        self.n_decisions = 0
        self.n_simulated_steps = 0
        self.n_invalid_rollouts = 0
        self.n_diverged_steps = 0
        self._searcher: Searcher | None = None
        self._decision: SearchResult | None = None
        self._update: TD3Update | None = None
        self._checked_env: CheckedVecEnv | None = None

        if _init_setup_model:
            self._setup_model()

    @property
    def search_settings(self) -> SearchSettings:
        """The settings of the search, checked."""
        return SearchSettings.of(self)

    def _setup_model(self) -> None:
        # ``load`` sets attributes without calling the constructor, so settings are checked here.
        settings = self.search_settings
        for name in ("action_noise_after_search", "fast_update"):
            if not isinstance(getattr(self, name), bool):
                raise TypeError(f"{name} must be True or False, got {getattr(self, name)!r}.")
        super()._setup_model()
        self._update = self._make_update()
        if self.search_rng is None:
            self.search_rng = np.random.default_rng(self.seed)
        if self.env is not None:
            self._make_searcher(self.env, settings)

    def _make_update(self) -> TD3Update | None:
        if not self.fast_update:
            return None
        try:
            return TD3Update(self)
        except TypeError as reason:
            message = f"Gradient steps are SB3's own, not the fast ones: {reason}."
            logger.info(message)
            if self.verbose >= 1:
                print(message)
            return None

    def _make_searcher(self, env: VecEnv, settings: SearchSettings) -> None:
        if self._searcher is not None:
            self._searcher.close()
        # What this environment's VecNormalize does is what the critics learn from.
        normalizer = unwrap_vec_normalize(env)
        normalize_reward = normalizer is not None and normalizer.norm_reward
        self._searcher = Searcher(self, env, settings, normalize_reward)
        if self.verbose >= 1:
            print(f"Forward model: {self._searcher.description}")

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        super().set_env(env, force_reset)
        assert self.env is not None
        self._make_searcher(self.env, self.search_settings)

    def set_random_seed(self, seed: int | None = None) -> None:
        super().set_random_seed(seed)
        if seed is not None:
            self.search_rng = np.random.default_rng(seed)

    def _sample_action(
        self,
        learning_starts: int,
        action_noise: ActionNoise | None = None,
        n_envs: int = 1,
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Search for the next actions, or sample them as TD3 does before ``learning_starts``.

        :param action_noise: noise for actions that were not searched
        :param learning_starts: Number of steps before learning for the warm-up phase.
        :param n_envs: number of environments
        :return: actions ``[n_envs, *act_shape]`` to take in the environment
            and scaled actions that will be stored in the replay buffer.
        """
        self._decision = None
        if self.num_timesteps < learning_starts:
            return super()._sample_action(learning_starts, action_noise, n_envs)

        assert self._last_obs is not None, "self._last_obs was not set"
        assert self._searcher is not None and self.search_rng is not None, "learn() needs an environment"
        start = time.perf_counter()
        result = self._searcher.search(self._last_obs, self.search_rng)
        self._record_decision(result, time.perf_counter() - start)

        scaled_action = result.actions.reshape(-1, *(self.action_space.shape or ()))
        if self.action_noise_after_search and action_noise is not None:
            noisy_action = np.clip(scaled_action + action_noise(), -1, 1).astype(scaled_action.dtype)
            return self.policy.unscale_action(noisy_action), noisy_action
        self._decision = result
        return self.policy.unscale_action(scaled_action), scaled_action

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        diverged = diverged_environments(infos)
        if diverged and self.n_diverged_steps == 0:
            warn_of_divergence(buffer_action, diverged, self.num_timesteps)
        self.n_diverged_steps += len(diverged)
        self.logger.record("rollout/diverged_steps", self.n_diverged_steps)
        if diverged:
            leave_out_step(self, replay_buffer, new_obs)
            return
        if self._decision is not None:
            assert self._searcher is not None
            normalizer = self._vec_normalize_env
            raw_reward = reward if normalizer is None else normalizer.get_original_reward()
            error = self._searcher.model_error(self._decision, new_obs, raw_reward, infos)
            if error is not None:
                self.logger.record_mean("search/model_error", error)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def collect_rollouts(self, env: VecEnv, *args: Any, **kwargs: Any) -> RolloutReturn:
        if self._checked_env is None or self._checked_env.venv is not env:
            self._checked_env = CheckedVecEnv(env)
        return super().collect_rollouts(self._checked_env, *args, **kwargs)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        result = super()._setup_learn(*args, **kwargs)
        check_observations(self._last_obs)
        return result

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Update the networks as TD3 does.

        :param gradient_steps: how many gradient steps to do
        :param batch_size: transitions sampled for each
        """
        with matmul_precision(self.matmul_precision):
            if self._update is None:
                super().train(gradient_steps, batch_size)
            else:
                self._update.train(gradient_steps, batch_size)

    def _record_decision(self, result: SearchResult, seconds: float) -> None:
        n_envs = len(result.chosen)
        self.n_decisions += n_envs
        self.n_simulated_steps += result.simulated_steps
        self.n_invalid_rollouts += result.invalid_rollouts
        values = result.values[result.chosen >= 0]
        if values.size and np.isfinite(values).all():
            self.logger.record_mean(
                "search/value_gain", float((values.max(axis=1) - values.mean(axis=1)).mean())
            )
            self.logger.record_mean("search/beam_std", float(values.std(axis=1).mean()))
        self.logger.record_mean("search/ms_per_decision", 1000 * seconds / n_envs)
        if self.time_budget is not None:
            self.logger.record_mean("search/rounds", result.rounds)
            self.logger.record_mean("search/candidates", result.values.shape[1])
        self.logger.record("search/decisions", self.n_decisions)
        self.logger.record("search/simulated_steps", self.n_simulated_steps)
        self.logger.record("search/invalid_rollouts", self.n_invalid_rollouts)

    def learn(
        self: SelfMCBSTD3,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "MCBSTD3",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfMCBSTD3:
        assert self.env is not None, "learn() needs an environment: call set_env()"
        with environment_named(self.env):
            return super().learn(
                total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
            )

    @classmethod
    def resume(cls: type[SelfMCBSTD3], path: str, env: GymEnv | None = None, **kwargs: Any) -> SelfMCBSTD3:
        """
        Continue a run from its exact checkpoints, see :func:`sb3_mcbs.resume`.

        :param path: the folder of checkpoints
        :param env: the environment, made as the original one was; None makes it from its id
        :param kwargs: the other arguments of :func:`sb3_mcbs.resume`
        :return: the agent
        :raises CheckpointError: if there is no whole checkpoint, or it is of another class
        """
        from sb3_mcbs.checkpoints.resume import resume_as

        return resume_as(cls, path, env, **kwargs)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Get the actor's action, **without search**. Use :class:`~sb3_mcbs.SearchPolicy` to act with search.

        :param observation: the input observation
        :param state: not used
        :param episode_start: not used
        :param deterministic: not used, the actor is deterministic
        :return: the actor's action and ``state``
        """
        return super().predict(observation, state, episode_start, deterministic)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_searcher", "_decision", "_update", "_checked_env"]
