"""What makes an off-policy agent look ahead before it acts, whatever it learns by."""

import time
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from typing import Any, ClassVar, TypeVar

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_mcbs.agents.attributes import SearchAttributes
from sb3_mcbs.agents.exploration import DrawnNoise, noise_without_search
from sb3_mcbs.agents.faults import (
    VecCheckFinite,
    check_observations,
    diverged_environments,
    environment_named,
    leave_out_step,
    warn_of_divergence,
)
from sb3_mcbs.agents.hyperparameters import (
    GROUPS,
    MOVED,
    SETTINGS,
    complete_settings,
    convert_older,
    refuse_old_names,
    settings_of_preset,
    tidied,
)
from sb3_mcbs.agents.learned_model import (
    EnsembleSettings,
    LearnedModel,
    check_learned_model,
    set_up_learned_model,
)
from sb3_mcbs.agents.learned_search import make_planner
from sb3_mcbs.agents.planner import Planner
from sb3_mcbs.agents.schedule import ScheduleSettings, SearchSchedule
from sb3_mcbs.agents.simulated_batches import SimulatedBatches
from sb3_mcbs.networks.torch_settings import matmul_precision
from sb3_mcbs.search import BeamSettings, RecentActions, SearchResult, SearchSettings
from sb3_mcbs.search.random_streams import spawn_rng
from sb3_mcbs.search.settings import merged

SelfMCBS = TypeVar("SelfMCBS", bound="MCBS")


class MCBS(SearchAttributes, OffPolicyAlgorithm):
    """
    Monte Carlo Beam Search for an off-policy agent of SB3: the mixin that stands before it.

    ::

        class MCBSSAC(MCBS, SAC):
            def __init__(self, policy, env, ..., *, beam_width: int | None = None, ...) -> None:
                super().__init__(policy, env, ..., _init_setup_model=False)
                self._init_search(locals())
                if _init_setup_model:
                    self._setup_model()

    A subclass lists :data:`~sb3_mcbs.agents.hyperparameters.SETTINGS` in its signature, and keeps them as
    attributes, as SB3 does with its own.
    """

    #: Set by ``sb3_mcbs.checkpoints``, which knows the agents, and not the other way round.
    _resume_as: ClassVar[Callable[..., Any]]
    _seed_at_setup: int | None = None
    _is_restored = False

    def _init_search(self, arguments: Mapping[str, Any]) -> None:
        """
        Take over the constructor's arguments for the search.

        :param arguments: all of the constructor's, ``locals()``
        :raises TypeError: if settings that should be a dictionary are none
        :raises ValueError: if there is no such preset
        """
        for name, value in complete_settings(arguments).items():
            setattr(self, name, value)

        self.search_rng: np.random.Generator | None = None
        self._schedule: SearchSchedule | None = None
        self.recent_actions: RecentActions | None = None
        self.n_decisions = 0
        self.n_simulated_steps = 0
        self.n_invalid_rollouts = 0
        self.n_critic_evaluations = 0
        self.n_diverged_steps = 0
        self.planner: Planner | None = None
        #: What was executed, and the environments that were searched.
        self._decision: tuple[SearchResult, Sequence[int]] | None = None
        self.rollout_rng: np.random.Generator | None = None
        self._simulated_batches: SimulatedBatches | None = None
        self.learned_model: LearnedModel | None = None
        self._checked_env: VecCheckFinite | None = None
        self._noise_without_search: ActionNoise | None = None

    def _checked_settings(self) -> tuple[SearchSettings, ScheduleSettings]:
        settings, schedule = self.search_settings, self.schedule_settings
        schedule.check_search(settings)
        if not isinstance(self.action_noise_after_search, bool):
            raise TypeError(
                f"action_noise_after_search must be True or False, got {self.action_noise_after_search!r}."
            )
        return settings, schedule

    def _setup_model(self) -> None:
        # ``load`` sets attributes without calling the constructor, so settings are checked here.
        convert_older(self)
        vars(self).update(tidied({name: value for name, value in vars(self).items() if name in SETTINGS}))
        settings, schedule = self._checked_settings()
        # ``load`` seeds once more; generators that it has restored go on instead.
        self._is_restored = self.search_rng is not None and self._seed_at_setup == self.seed
        super()._setup_model()
        del self._is_restored
        self._seed_at_setup = self.seed
        if self.search_rng is None:
            self._seed_search(self.seed)
        if self._schedule is None:
            self._schedule = SearchSchedule(schedule, self.seed)
        self._schedule.settings = schedule
        self._remember_actions(settings)
        self._simulated_batches = SimulatedBatches(self)
        set_up_learned_model(self)
        if self.env is not None:
            self._make_planner(self.env, settings)
        self._note_dictionaries()

    @property
    def _is_set_up(self) -> bool:
        return vars(self).get("_schedule") is not None

    def _follow_settings(self) -> None:
        settings, schedule = self._checked_settings()
        check_learned_model(self)
        if self._simulated_batches is not None and self.replay_buffer is not None:
            self._simulated_batches.check_settings()
        before = self.planner
        if before is not None and not before.follow(settings):
            assert self.env is not None
            self._make_planner(self.env, settings)
            assert self.planner is not None
            self.planner.go_on_after(before)
        self._remember_actions(settings)
        assert self._schedule is not None
        self._schedule.settings = schedule
        if self.env is not None:
            self._explore_where_not_searched()
        self._note_dictionaries()

    def _remember_actions(self, settings: SearchSettings) -> None:
        if self.recent_actions is None and settings.proposal_dims is not None:
            self.recent_actions = (
                RecentActions(get_action_dim(self.action_space))
                if self.planner is None
                else self.planner.recent_actions
            )

    def _make_planner(self, env: VecEnv, settings: SearchSettings) -> None:
        before, self._decision = self.planner, None
        # What this environment's VecNormalize does is what the critics learn from.
        normalizer = unwrap_vec_normalize(env)
        normalize_reward = normalizer is not None and normalizer.norm_reward
        self.planner = make_planner(self, env, settings, normalize_reward, self.recent_actions)
        if self._simulated_batches is not None:
            self._simulated_batches.connect()
        if before is not None:
            before.close()
        if self.verbose >= 1:
            print(f"Forward model: {self.planner.description}")

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        before = dict(vars(self))
        super().set_env(env, force_reset)
        assert self.env is not None
        try:
            self._make_planner(self.env, self.search_settings)
        except Exception:  # the environment of before stays
            vars(self).clear()
            vars(self).update(before)
            raise

    def __copy__(self: SelfMCBS) -> SelfMCBS:
        # As with SB3's agents, networks and environments are those of the original. Settings are not.
        made = type(self).__new__(type(self))
        vars(made).update(vars(self))
        for name in ("_schedule", "planner", *GROUPS):
            vars(made)[name] = copy(vars(self)[name])
        if made.planner is not None:
            made.planner.agent = made
        if made._simulated_batches is not None:
            made._simulated_batches = SimulatedBatches(made)
        return made

    def set_random_seed(self, seed: int | None = None) -> None:
        super().set_random_seed(seed)
        if seed is not None and not self._is_restored:
            self._seed_search(seed)

    def _seed_search(self, seed: int | None) -> None:
        self.search_rng = np.random.default_rng(seed)
        if self._schedule is not None:
            self._schedule.rng = spawn_rng(seed, "schedule")
        self.rollout_rng = spawn_rng(seed, "value expansion")
        if self.learned_model is not None:
            self.learned_model.rng = spawn_rng(seed, "learned model")

    def _sample_action(
        self,
        learning_starts: int,
        action_noise: ActionNoise | None = None,
        n_envs: int = 1,
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Search for the next actions, or sample them as the agent without search: before ``learning_starts``,
        and in environments that the schedule leaves out.

        :param learning_starts: Number of steps before learning for the warm-up phase.
        :param action_noise: noise for actions that were not searched
        :param n_envs: number of environments
        :return: actions ``[n_envs, *act_shape]`` to take in the environment
            and scaled actions that will be stored in the replay buffer.
        """
        self._follow_dictionaries()
        assert self._simulated_batches is not None
        self._simulated_batches.look()
        self._decision = None
        self._check_noise_after_search()
        if self._noise_without_search is None:  # action_noise may have been taken away
            self._explore_where_not_searched()
        # For all environments whatever is searched, so that random streams do not depend on the schedule.
        drawn_from = self._noise_without_search if action_noise is None else action_noise
        noise = None if drawn_from is None else DrawnNoise(drawn_from)
        try:
            actions, scaled_actions = super()._sample_action(learning_starts, noise, n_envs)
        except ValueError:  # of torch: a stochastic actor cannot sample where its mean is NaN
            assert self.planner is not None and self._last_obs is not None
            self.planner.check_networks(self._last_obs)
            raise
        if self.num_timesteps < learning_starts:
            return actions, scaled_actions
        assert self._schedule is not None and self.planner is not None
        if not self.planner.ready:
            return actions, scaled_actions
        self.logger.record("search/frequency", self._schedule.share(self._progress))
        executed = self._schedule.draw(self._progress, self.num_timesteps)
        searched = np.flatnonzero(executed).tolist()
        if not searched:
            return actions, scaled_actions

        result = self._search(searched)
        found = result.actions.reshape(-1, *(self.action_space.shape or ()))
        if self.action_noise_after_search and noise is not None:
            drawn = np.broadcast_to(noise.last, scaled_actions.shape)[searched]
            found = np.clip(found + drawn, -1, 1).astype(found.dtype)
        else:
            self._decision = result, searched
        if executed.all():
            return self.policy.unscale_action(found), found
        # Of one kind, so that actions reach the environments as they are simulated.
        scaled_actions = scaled_actions.astype(found.dtype)
        scaled_actions[executed] = found
        return self.policy.unscale_action(scaled_actions), scaled_actions

    def _search(self, envs: Sequence[int]) -> SearchResult:
        """Search in some environments."""
        assert self._last_obs is not None, "self._last_obs was not set"
        assert self.planner is not None and self.search_rng is not None, "learn() needs an environment"
        assert self._schedule is not None
        effort = self._schedule.settings_at(self.planner.settings, self._progress)
        if self._vec_normalize_env is not None:
            self.planner.normalize_rewards(self._vec_normalize_env.norm_reward)
        start = time.perf_counter()
        result = self.planner.search(self._last_obs, self.search_rng, envs, effort)
        self._record_decision(result, time.perf_counter() - start, effort)
        return result

    @property
    def _progress(self) -> float:
        """How much of the training is done, from 0 to 1."""
        # A rollout of whole episodes, say, goes on beyond ``total_timesteps``.
        return min(max(1.0 - self._current_progress_remaining, 0.0), 1.0)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        raw_reward = self._note_step(reward, dones)
        assert self.planner is not None
        diverged = diverged_environments(infos)
        if diverged and self.n_diverged_steps == 0:
            warn_of_divergence(buffer_action, diverged, self.num_timesteps)
        self.n_diverged_steps += len(diverged)
        self.logger.record("rollout/diverged_steps", self.n_diverged_steps)
        if diverged:
            leave_out_step(self, replay_buffer, new_obs)
            return
        if self.num_timesteps - self.n_envs >= self.learning_starts:  # random actions have no directions
            self.planner.note_actions(buffer_action)
        assert self._simulated_batches is not None
        error = self._simulated_batches.model_error(buffer_action, new_obs, raw_reward, infos)
        if error is None and self._decision is not None:
            error = self.planner.model_error(*self._decision, new_obs, raw_reward, infos)
        if error is not None:
            self.logger.record_mean("search/model_error", error)
        self._simulated_batches.store(replay_buffer.pos, dones)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def _note_step(self, reward: np.ndarray, dones: np.ndarray) -> np.ndarray:
        """Tell the schedule of a step, and return its rewards as the environments gave them."""
        assert self._schedule is not None and self._checked_env is not None
        self._checked_env.unstored = None
        normalizer = self._vec_normalize_env
        raw_reward = reward if normalizer is None else normalizer.get_original_reward()
        self._schedule.note_step(raw_reward, dones, self.num_timesteps)
        return raw_reward

    def collect_rollouts(self, env: VecEnv, *args: Any, **kwargs: Any) -> RolloutReturn:
        if self._checked_env is None or self._checked_env.venv is not env:
            self._checked_env = VecCheckFinite(env)
        self._leave_out_unstored()  # of a training that goes on in another agent, if a callback copied it
        try:
            return super().collect_rollouts(self._checked_env, *args, **kwargs)
        finally:
            # SB3 does not store the step in which a callback stops the training, but training may go on.
            self._leave_out_unstored()

    def _leave_out_unstored(self) -> None:
        assert self._checked_env is not None
        if self._checked_env.unstored is not None:
            new_obs, reward, dones = self._checked_env.unstored
            self._note_step(reward, dones)
            assert self.replay_buffer is not None
            leave_out_step(self, self.replay_buffer, new_obs)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **kwargs: Any,
    ) -> tuple[int, BaseCallback]:
        self._noise_without_search = None
        self._explore_where_not_searched()
        self._check_noise_after_search()
        if self.learned_model is not None:
            assert self.replay_buffer is not None
            self.learned_model.check_room(self.replay_buffer)
        assert self._simulated_batches is not None
        self._simulated_batches.begin()
        will_reset = reset_num_timesteps or self._last_obs is None
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)
        if self._total_timesteps:  # what is known of progress is that of the training before
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        check_observations(self._last_obs)
        if will_reset:
            self._checked_env = None
            assert self._schedule is not None
            self._schedule.begin_episodes(self.n_envs, self.num_timesteps)
        return result

    def _check_noise_after_search(self) -> None:
        if self.action_noise_after_search and self.action_noise is None:
            raise ValueError(
                "action_noise_after_search adds action_noise to searched actions, and there is none: pass an "
                "action_noise."
            )

    def _explore_where_not_searched(self) -> None:
        assert self._schedule is not None
        if not self._schedule.settings.searches_always or self.learned_model is not None:
            known = self._noise_without_search is not None
            self._noise_without_search = noise_without_search(self, self.beam_noise, say=not known)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Update the networks as the agent without search does.

        :param gradient_steps: how many gradient steps to do
        :param batch_size: transitions sampled for each
        """
        if self.learned_model is not None:
            self.learned_model.fit_if_due(self, EnsembleSettings.of(self))
        assert self._simulated_batches is not None
        with matmul_precision(self.matmul_precision), self._simulated_batches.mixed():
            super().train(gradient_steps, batch_size)

    def _record_decision(self, result: SearchResult, seconds: float, effort: SearchSettings) -> None:
        n_envs = len(result.chosen)
        self.n_decisions += n_envs
        self.n_simulated_steps += result.simulated_steps
        self.n_invalid_rollouts += result.invalid_rollouts
        self.n_critic_evaluations += result.critic_evaluations
        searched = result.chosen >= 0
        values = result.values[searched]
        if values.size and np.isfinite(values).all():
            # In a tree the chosen root is that of the best leaf, which need not be the best root.
            best = np.take_along_axis(values, result.chosen[searched][:, None], axis=1)[:, 0]
            self.logger.record_mean("search/value_gain", float((best - values.mean(axis=1)).mean()))
            self.logger.record_mean("search/beam_std", float(values.std(axis=1).mean()))
        self.logger.record_mean("search/ms_per_decision", 1000 * seconds / n_envs)
        if isinstance(effort, BeamSettings) and effort.time_budget is not None:
            self.logger.record_mean("search/rounds", result.rounds)
            self.logger.record_mean("search/candidates", result.values.shape[1])
        if result.surviving_roots is not None:
            self.logger.record_mean("search/surviving_roots", float(result.surviving_roots.mean()))
        self.logger.record("search/beam_width", effort.beam_width)
        self.logger.record("search/rollout_depth", effort.rollout_depth)
        self.logger.record("search/critic_evaluations", self.n_critic_evaluations)
        self.logger.record("search/decisions", self.n_decisions)
        self.logger.record("search/simulated_steps", self.n_simulated_steps)
        self.logger.record("search/invalid_rollouts", self.n_invalid_rollouts)

    def learn(
        self: SelfMCBS,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfMCBS:
        """
        Return a trained model.

        :param total_timesteps: The total number of samples (env steps) to train on
        :param callback: callback(s) called at every step with state of the algorithm.
        :param log_interval: episodes between logs
        :param tb_log_name: the name of the run for TensorBoard logging; None: the name of the class
        :param reset_num_timesteps: whether or not to reset the current timestep number (used in logging)
        :param progress_bar: Display a progress bar using tqdm and rich.
        :return: the trained model
        """
        assert self.env is not None, "learn() needs an environment: call set_env()"
        if tb_log_name is None:
            tb_log_name = type(self).__name__
        if self.planner is not None:
            self.planner.go_on_here()
        with environment_named(self.env):
            return super().learn(
                total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
            )

    @classmethod
    def load(cls: type[SelfMCBS], path: Any, *args: Any, **kwargs: Any) -> SelfMCBS:
        """
        Load the model from a zip-file, as SB3 does.

        :param path: path to the file, or a file-like object
        :param args: the other parameters of SB3's ``load``
        :param kwargs: the same, and settings that replace those in the file; a ``preset`` replaces all of how
            is searched, except for settings beside it
        :return: the model
        """
        objects = kwargs.get("custom_objects") or {}
        refuse_old_names({**{name: objects[name] for name in MOVED.keys() & objects.keys()}, **kwargs})
        preset = kwargs.get("preset", objects.get("preset"))
        if preset is not None:
            kwargs = merged(settings_of_preset(preset), kwargs)
        # An older file has what these contain as attributes, which None would leave.
        kwargs = {name: {} if name in GROUPS and value is None else value for name, value in kwargs.items()}
        return super().load(path, *args, **kwargs)

    @classmethod
    def resume(cls: type[SelfMCBS], path: str, env: GymEnv | None = None, **kwargs: Any) -> SelfMCBS:
        """
        Continue a run from its exact checkpoints, see :func:`sb3_mcbs.resume`.

        :param path: the folder of checkpoints
        :param env: the environment, made as the original one was; None makes it from its id
        :param kwargs: the other arguments of :func:`sb3_mcbs.resume`
        :return: the agent
        :raises CheckpointError: if there is no whole checkpoint, or it is of another class
        """
        return MCBS._resume_as(cls, path, env, **kwargs)

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
        :param deterministic: whether SAC and TQC take their mean action instead of a random one; the actors
            of TD3 and DDPG are deterministic
        :return: the actor's action and ``state``
        """
        return super().predict(observation, state, episode_start, deterministic)

    def _excluded_save_params(self) -> list[str]:
        transient = ["planner", "_decision", "_checked_env", "_simulated_batches", "_noise_without_search"]
        return [*super()._excluded_save_params(), *transient, "_followed"]
