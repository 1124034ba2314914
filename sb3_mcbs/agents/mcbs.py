"""The mixin that makes an off-policy agent look ahead before it acts."""

import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from copy import copy
from typing import Any, ClassVar, TypeVar

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_mcbs.agents.decision_log import TrainingStart, record_decision, with_progress_bar
from sb3_mcbs.agents.exploration import DrawnNoise, noise_without_search
from sb3_mcbs.agents.faults import environment_named
from sb3_mcbs.agents.hyperparameters import (
    GROUPS,
    SETTINGS,
    SearchAttributes,
    complete_settings,
    convert_older,
    moved_modules,
    settings_to_load,
    tidied,
)
from sb3_mcbs.agents.learned_model import (
    EnsembleSettings,
    LearnedModel,
    check_learned_model,
    set_up_learned_model,
)
from sb3_mcbs.agents.planner import Planner
from sb3_mcbs.agents.resumable import Resumable, Searching
from sb3_mcbs.agents.roots import EnvironmentStep, Prediction
from sb3_mcbs.agents.schedule import ScheduleSettings, SearchSchedule
from sb3_mcbs.agents.tensorboard import write_candidates, write_hyperparameters
from sb3_mcbs.agents.value_expansion import Expanding, ValueExpansionSettings
from sb3_mcbs.networks.torch_settings import matmul_precision
from sb3_mcbs.search import RecentActions, SearchResult, SearchSettings
from sb3_mcbs.search.random_streams import spawn_rng

SelfMCBS = TypeVar("SelfMCBS", bound="MCBS")


class MCBS(SearchAttributes, Searching, Resumable, Expanding):
    """
    Monte Carlo Beam Search for an off-policy agent of SB3: a mixin that precedes SB3's class.

    ::

        class MCBSSAC(MCBS, SAC):
            def __init__(self, policy, env, ..., *, beam_width: int | None = None, ...) -> None:
                super().__init__(**sb3_arguments(locals()))
                self._init_search(locals())
                if _init_setup_model:
                    self._setup_model()

    A subclass lists :data:`~sb3_mcbs.agents.hyperparameters.SETTINGS` in its signature, and keeps them as
    attributes, as SB3 does with its own. With further parameters it calls SB3's constructor without
    ``sb3_arguments``.
    """

    #: Attributes that neither ``save`` nor exact checkpoints contain, and why.
    not_checkpointed: ClassVar[Collection[str]] = {
        "planner": "its forward model is made from the environments; its memory is saved",
        "_prediction": "of the last step; computed again before it is read",
        "_states": "of the last step; computed again before they are read",
        "_checked_env": "a view of the environment",
        "_followed": "copies of settings",
        "candidate_values": "only shown",
    }
    _seed_at_setup: int | None = None
    _is_restored = False

    def _init_search(self, arguments: Mapping[str, Any]) -> None:
        """
        Store the constructor's arguments for the search.

        :param arguments: all arguments of the constructor, ``locals()``
        :raises TypeError: if a dictionary of settings is not a dictionary
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
        #: Of the decisions since the last log, at most the last 1000: ``[n_envs, candidates]``.
        self.candidate_values: deque[np.ndarray] = deque(maxlen=1000)
        self.planner: Planner | None = None
        #: The search's prediction for the next executed actions.
        self._prediction: Prediction | None = None
        self._states = None
        self.rollout_rng = None
        self.branches = None
        self.learned_model: LearnedModel | None = None
        self._noise_without_search: ActionNoise | None = None

    def checked_settings(self) -> tuple[SearchSettings, ScheduleSettings]:
        """
        Check all settings of the search, each and together. This needs no environment.

        :return: those of the search, and those of its schedule
        :raises TypeError: if a value has the wrong type
        :raises ValueError: if a value is out of range or does not fit the others
        """
        settings, schedule = self.search_settings, self.schedule_settings
        schedule.check_search(settings)
        if not isinstance(self.action_noise_after_search, bool):
            raise TypeError(
                f"action_noise_after_search must be True or False, got {self.action_noise_after_search!r}."
            )
        ValueExpansionSettings.of(self).check_search(settings)
        return settings, schedule

    def _setup_model(self) -> None:
        # ``load`` sets attributes without calling the constructor, so settings are checked here.
        convert_older(self)
        vars(self).update(tidied({name: value for name, value in vars(self).items() if name in SETTINGS}))
        settings, schedule = self.checked_settings()
        # ``load`` seeds once more; restored generators must keep their state.
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
        self._check_buffer()
        set_up_learned_model(self)
        if self.env is not None:
            self._make_planner(self.env, settings)
        self._note_dictionaries()

    @property
    def _is_set_up(self) -> bool:
        return vars(self).get("_schedule") is not None

    def _follow_settings(self) -> None:
        settings, schedule = self.checked_settings()
        check_learned_model(self)
        self._check_buffer()
        if self.planner is not None:
            exchanged = self.planner.follow(settings)
            self._check_states()
            self._expand_buffer()
            if self._note_expansion() or exchanged:
                self._say_what_simulates()
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
        before, self._prediction, self._states = self.planner, None, None
        # The critics learn from the rewards of this environment's VecNormalize.
        normalizer = unwrap_vec_normalize(env)
        normalize_reward = normalizer is not None and normalizer.norm_reward
        self.planner = Planner(self, env, settings, normalize_reward, self.recent_actions)
        try:
            self._check_states()
            self._note_expansion()
            self._expand_buffer()
        except Exception:
            self.planner.close()
            raise
        if before is not None:
            before.close()
        self._say_what_simulates()

    def _say_what_simulates(self) -> None:
        if self.verbose >= 1 and self.planner is not None:
            print(f"Forward model: {self.planner.description}{self._expansion_in_words()}")

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        before = dict(vars(self))
        super().set_env(env, force_reset)
        assert self.env is not None
        try:
            self._make_planner(self.env, self.search_settings)
        except Exception:  # keep the previous environment
            vars(self).clear()
            vars(self).update(before)
            raise

    def __copy__(self: SelfMCBS) -> SelfMCBS:
        # As with SB3's agents, networks and environments are shared with the original. Settings are not.
        made = type(self).__new__(type(self))
        vars(made).update(vars(self))
        for name in {"_schedule", "planner", "_graph_memory", *GROUPS} & vars(self).keys():
            vars(made)[name] = copy(vars(self)[name])
        if made.planner is not None:
            made.planner.agent = made
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
        Search for the next actions. Before ``learning_starts``, and in environments that the schedule leaves
        out, sample them as the agent without search does.

        :param learning_starts: Number of steps before learning for the warm-up phase.
        :param action_noise: noise for actions that were not searched
        :param n_envs: number of environments
        :return: actions ``[n_envs, *act_shape]`` to take in the environment
            and scaled actions that will be stored in the replay buffer.
        """
        self._follow_dictionaries()
        self._prediction = None
        self._note_states()
        self._check_noise_after_search()
        if self._noise_without_search is None:  # action_noise may have been removed
            self._explore_where_not_searched()
        # For all environments, searched or not, so that random streams do not depend on the schedule.
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
            self._prediction = Prediction.of(result, searched)
        if executed.all():
            return self.policy.unscale_action(found), found
        # One dtype, so that the environments get the actions that were simulated.
        scaled_actions = scaled_actions.astype(found.dtype)
        scaled_actions[executed] = found
        return self.policy.unscale_action(scaled_actions), scaled_actions

    def _search(self, envs: Sequence[int]) -> SearchResult:
        """Search in some environments."""
        assert self._last_obs is not None, "self._last_obs was not set"
        assert self.planner is not None and self.search_rng is not None, "learn() needs an environment"
        assert self._schedule is not None
        settings = self._schedule.settings_at(self.planner.settings, self._progress)
        if self._vec_normalize_env is not None:
            self.planner.normalize_rewards(self._vec_normalize_env.norm_reward)
        start = time.perf_counter()
        result = self.planner.plan(self._last_obs, self.search_rng, envs, settings)
        record_decision(self, result, time.perf_counter() - start, settings)
        return result

    @property
    def _progress(self) -> float:
        """Progress of the training, from 0 to 1."""
        # Rollouts of whole episodes, for example, may exceed ``total_timesteps``.
        return min(max(1.0 - self._current_progress_remaining, 0.0), 1.0)

    def _store_valid_transition(self, *transition: Any) -> None:
        _, actions, new_obs, reward, _, infos = transition
        assert self.planner is not None
        if self.num_timesteps - self.n_envs >= self.learning_starts:  # random actions have no directions
            self.planner.remember_actions(actions)
        self._verify(actions, EnvironmentStep(new_obs, self._raw_rewards(reward), infos))
        super()._store_valid_transition(*transition)

    def _verify(self, actions: np.ndarray, happened: EnvironmentStep) -> None:
        """Compare the forward model's prediction with what happened, and resync it after a difference."""
        assert self.planner is not None
        prediction = self._predict_step(actions) or self._prediction
        error = None if prediction is None else self.planner.verify(prediction, happened)
        if error is not None:
            self.logger.record_mean("search/model_error", error)
            if error > 0:
                self.planner.resync(error)

    def _raw_rewards(self, reward: np.ndarray) -> np.ndarray:
        """Rewards without normalisation."""
        normalizer = self._vec_normalize_env
        return reward if normalizer is None else normalizer.get_original_reward()

    def _record_rewards(self, reward: np.ndarray, dones: np.ndarray) -> None:
        assert self._schedule is not None
        self._schedule.record_rewards(self._raw_rewards(reward), dones, self.num_timesteps)

    def _begin_episodes(self) -> None:
        assert self._schedule is not None
        self._schedule.begin_episodes(self.n_envs, self.num_timesteps)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        self._noise_without_search = None
        self._explore_where_not_searched()
        self._check_noise_after_search()
        if self.learned_model is not None:
            assert self.replay_buffer is not None
            self.learned_model.check_room(self.replay_buffer)
        result = super()._setup_learn(*args, **kwargs)
        if self._total_timesteps:  # the progress is still that of the previous training
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        if self.num_timesteps == 0 and self._stopped_run is None:  # one that goes on has written them
            write_hyperparameters(self)
        return result

    def dump_logs(self) -> None:
        """Write log data, and for TensorBoard a histogram of the candidates' values."""
        write_candidates(self)
        super().dump_logs()

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

    def train(self, gradient_steps: int, batch_size: int | None = None) -> None:
        """
        Update the networks as the agent without search does.

        :param gradient_steps: number of gradient steps
        :param batch_size: transitions per gradient step (None: SB3's default)
        """
        if self.learned_model is not None:
            self.learned_model.fit_if_due(self, EnsembleSettings.of(self))
        with matmul_precision(self.matmul_precision):
            super().train(gradient_steps, batch_size)

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
        :param progress_bar: Display a progress bar using tqdm and rich, with the share of decisions that were
            searched and the milliseconds of one.
        :return: the trained model
        """
        assert self.env is not None, "learn() needs an environment: call set_env()"
        if tb_log_name is None:
            tb_log_name = type(self).__name__
        if self.planner is not None:
            self.planner.go_on_here()
        if progress_bar:
            callback = with_progress_bar(callback)
        begin = TrainingStart.of(self, reset_num_timesteps)
        with environment_named(self.env):
            super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps)
        if self.verbose >= 1:
            print(begin.summary(self))
        return self

    @classmethod
    def load(cls: type[SelfMCBS], path: Any, *args: Any, **kwargs: Any) -> SelfMCBS:
        """
        Load the model from a zip-file, as SB3 does.

        :param path: path to the file, or a file-like object
        :param args: the other parameters of SB3's ``load``
        :param kwargs: the same, and settings that replace those in the file; a ``preset`` replaces all
            settings of the search that are not given explicitly
        :return: the model
        """
        kwargs = settings_to_load(kwargs)
        with moved_modules():
            return super().load(path, *args, **kwargs)

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
        :param deterministic: whether SAC, TQC and CrossQ take their mean action instead of a sample; the
            actors of TD3 and DDPG are deterministic
        :return: the actor's action and ``state``
        """
        return super().predict(observation, state, episode_start, deterministic)

    def _excluded_save_params(self) -> list[str]:
        # learn() makes the noise again; exact checkpoints, taken during learn(), need it.
        return [*super()._excluded_save_params(), *MCBS.not_checkpointed, "_noise_without_search", "branches"]
