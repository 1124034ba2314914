"""RL Zoo's ExperimentManager, for agents that search."""

import gc
import inspect
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import optuna
from optuna.storages import RDBStorage
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import ProgressBarCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_mcbs.agents.decision_log import SearchProgressBarCallback
from sb3_mcbs.agents.hyperparameters import (
    GROUPS,
    MOVED,
    REMOVED,
    SETTINGS,
    refuse_old_names,
)
from sb3_mcbs.agents.presets import settings_of_preset
from sb3_mcbs.agents.registry import BASELINES, SEARCHING
from sb3_mcbs.agents.schedule import SCHEDULES, UNITS
from sb3_mcbs.checkpoints import CheckpointError, ExactCheckpointCallback
from sb3_mcbs.checkpoints.resume import CheckpointedRun
from sb3_mcbs.models import ForwardModelError
from sb3_mcbs.search import PRESETS, make_settings, with_preset
from sb3_mcbs.search.settings import KEYWORDS, MATMUL_PRECISIONS, STRATEGIES, merged, present_name
from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.types import BACKENDS
from sb3_mcbs.zoo.callbacks import SearchEvalCallback, SecondEvalCallback
from sb3_mcbs.zoo.paths import PathError, hyperparams_path, sibling_folder
from sb3_mcbs.zoo.sampler import HELD, with_limits
from sb3_mcbs.zoo.tuning import (
    FOLDER,
    OBJECTIVE,
    PROXY,
    RETURNS,
    SEEDS,
    delete_agents,
    join_study,
    open_storage,
    trial_folder,
)

#: ``-conf sb3_mcbs`` selects this package's file for the algorithm of the command line.
PACKAGE_CONFIG = "sb3_mcbs"
#: Algorithms that ``SearchPolicy`` supports.
SEARCHABLE = tuple(sorted(BASELINES))
#: The folder of exact checkpoints within a run's folder.
CHECKPOINTS = "checkpoints"
#: The settings that are names, and their valid values.
NAMES = {
    "preset": tuple(PRESETS),
    "strategy": tuple(STRATEGIES),
    "forward_model": BACKENDS,
    "matmul_precision": MATMUL_PRECISIONS,
    "search_schedule": SCHEDULES,
    "search_unit": UNITS,
}


class ResumedRun(NamedTuple):
    """
    A run to continue.

    :param folder: the run's folder
    :param checkpointed: the run as of its newest checkpoint
    :param log_folder: the run's TensorBoard folder, if any
    """

    folder: Path
    checkpointed: CheckpointedRun
    log_folder: str | None


class MCBSExperimentManager(ExperimentManager):
    """
    Finds this package's hyperparameter files and evaluates both policies of an agent.

    For ``mcbs_td3`` and the other algorithms that search in training, ``evaluations.npz`` in the run's folder
    is of the agent with search, as it acts in training, and that of the bare actor is in the sibling folder
    ``mcbs_td3_actor``. Another off-policy algorithm whose hyperparameters contain ``search_evaluation`` (a
    dictionary of search settings) is evaluated without search in the run's folder, and with search in the
    sibling folder ``ALGO_search``. Everything else is RL Zoo's.

    An ``ExactCheckpointCallback`` without a path writes into the run's folder.

    The parameters are those of ``rl_zoo3.exp_manager.ExperimentManager``.
    """

    #: Set by ``sb3-mcbs resume``, whose process makes one manager.
    resumed_run: ResumedRun | None = None

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        arguments = inspect.signature(ExperimentManager.__init__).bind(self, *args, **kwargs).arguments
        super().__init__(*args, **kwargs)
        self.search_evaluation: dict[str, Any] | None = None
        config = arguments.get("config")
        if config == PACKAGE_CONFIG or (config is None and self.algo in SEARCHING):
            try:
                self.config = str(hyperparams_path(self.algo))
            except PathError as error:
                sys.exit(f"-conf {config}: {error}")
        self.trial_seeds = getattr(self.args, "trial_seeds", 1)
        self.trial_objective = getattr(self.args, "trial_objective", "mean")
        self.keep_trials = getattr(self.args, "keep_trials", None)
        self.heartbeat = getattr(self.args, "heartbeat", 0)
        self._study: optuna.Study | None = None
        if self.resumed_run is not None:
            self.save_path = str(self.resumed_run.folder)
            self.params_path = f"{self.save_path}/{self.env_name}"

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """
        Set up the experiment as RL Zoo does, and prepare the agent of a resumed run.

        :return: the agent and the hyperparameters; None when tuning
        """
        result = super().setup_experiment()
        if result is not None and self.resumed_run is not None:
            _, checkpointed, log_folder = self.resumed_run
            assert isinstance(result[0], OffPolicyAlgorithm)
            checkpointed.continue_with(result[0], log_folder)
        return result

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        Read the hyperparameters as RL Zoo does, and accept 0 as a trial's number.

        A preset of the command line overrides the file's settings of the search.

        :return: the hyperparameters, and the same sorted, to be saved
        :raises ValueError: if a preset is given while tuning
        """
        first_trial = self.trial_id == 0 and self.storage and self.study_name
        if first_trial and self.algo in SEARCHING and not self.optimize_hyperparameters:
            print("Loading from Optuna study...")
            trial = self.load_trial(str(self.storage), str(self.study_name), 0)
            self.custom_hyperparams = {**trial, **(self.custom_hyperparams or {})}
        custom = self.custom_hyperparams or {}
        if self.algo in SEARCHING:
            _check_names(custom)
        if self.algo in SEARCHING and custom.get("preset") is not None:
            if self.optimize_hyperparameters:
                raise ValueError(
                    "Trials draw the search's settings and know no preset: leave preset out of -params."
                )
            self.custom_hyperparams = merged(settings_of_preset(custom["preset"]), custom)
        return super().read_hyperparameters()

    def load_trial(
        self, storage: str, study_name: str, trial_id: int | None = None, convert: bool = True
    ) -> dict[str, Any]:
        """
        Load a trial's parameters as RL Zoo does, with the limits that the trial had.

        :param storage: storage of the study
        :param study_name: name of the study
        :param trial_id: the trial's number; None: the best one
        :param convert: whether to convert the parameters to constructor arguments
        :return: the parameters
        """
        opened: Any = open_storage(storage)
        params = super().load_trial(opened, study_name, trial_id, convert)
        if not convert or self.algo not in SEARCHING:
            return params
        study = optuna.load_study(storage=opened, study_name=study_name)
        trial = study.best_trial if trial_id is None else study.trials[trial_id]
        return with_limits(params, trial.user_attrs.get(HELD, {}))

    def _preprocess_hyperparams(
        self, hyperparams: dict[str, Any]
    ) -> tuple[dict[str, Any], Any, list[Any], Any]:
        settings = hyperparams.pop("search_evaluation", None)
        if settings is not None:
            self.search_evaluation = checked_search_evaluation(settings, self.algo)
        return super()._preprocess_hyperparams(hyperparams)

    def hyperparameters_optimization(self) -> None:
        """
        Tune as RL Zoo does, in a storage that knows which workers live.

        :raises SystemExit: for options that do not go together, or a storage that cannot be opened
        """
        if self.keep_trials is not None and self.optimization_log_path is None:
            sys.exit("--keep-trials needs the folder to keep agents in: --optimization-log-path FOLDER.")
        if self.trial_seeds > 1 and self.n_jobs != 1:
            sys.exit("--trial-seeds needs --n-jobs 1. Start several workers with one --study-name instead.")
        if self.storage is not None:
            if self.storage.endswith(".log"):
                Path(self.storage).parent.mkdir(parents=True, exist_ok=True)
            if self.storage.startswith(PROXY) and self.heartbeat:
                warnings.warn(
                    "Optuna's gRPC proxy knows no heartbeats: a killed worker's trial stays unfinished.",
                    stacklevel=2,
                )
            opened: Any = open_storage(self.storage, self.heartbeat)
            self.storage = opened
            if self.study_name is not None:
                beats = self.heartbeat if isinstance(opened, RDBStorage) else 0
                settings = {
                    "trial-seeds": self.trial_seeds,
                    "trial-objective": self.trial_objective,
                    "heartbeat": beats,  # a worker would wait forever for the trial of a dead one without
                }
                join_study(opened, self.study_name, settings)
        super().hyperparameters_optimization()
        self._delete_agents()

    def _delete_agents(self) -> None:
        if self._study is not None and self.optimization_log_path and self.keep_trials is not None:
            delete_agents(self._study, self.optimization_log_path, self.keep_trials)

    def objective(self, trial: optuna.Trial) -> float:
        """
        Evaluate a trial as RL Zoo does, with one or several seeds, and prune it if the forward model cannot
        simulate it.

        The hyperparameter file's settings of the search are stored with the trial, so that the sampler avoids
        conflicts with them.

        :param trial: Optuna's trial
        :return: the return to maximise
        :raises optuna.TrialPruned: for pruned trials
        """
        self._study = trial.study
        self._delete_agents()
        if self.algo in SEARCHING:
            names = {"optimize_memory_usage", *SETTINGS}
            held = {name: value for name, value in self._hyperparams.items() if name in names}
            trial.set_user_attr(HELD, held)
        trial.set_user_attr(OBJECTIVE, self.trial_objective)
        trial.set_user_attr(RETURNS, [])  # a retried trial has those of the killed one
        if self.optimization_log_path is not None:
            trial.set_user_attr(FOLDER, trial_folder(self.optimization_log_path, trial.number))
        try:
            return super().objective(trial) if self.trial_seeds == 1 else self._train_seeds(trial)
        except ForwardModelError as reason:
            trial.set_user_attr("pruned", str(reason))
            raise optuna.TrialPruned(str(reason)) from reason

    def _train_seeds(self, trial: optuna.Trial) -> float:
        """Train with one seed after another; Optuna draws a trial's parameters only once."""
        if SEEDS not in trial.user_attrs:  # a retried trial has those of the killed one
            drawn = np.random.SeedSequence([self.seed, trial.number]).generate_state(self.trial_seeds)
            # Half of the range: SB3 adds the environment's index.
            trial.set_user_attr(SEEDS, [int(seed) // 2 for seed in drawn])
        value = -np.inf
        worker_seed = self.seed
        try:
            for seed in trial.user_attrs[SEEDS]:
                self.seed = seed
                set_random_seed(seed)
                value = super().objective(trial)
                gc.collect()  # agents and their buffers are in reference cycles
        finally:
            self.seed = worker_seed
        return value

    def create_callbacks(self) -> None:
        """Create RL Zoo's callbacks, and the second evaluation before the run's own."""
        for callback in self.callbacks:
            if isinstance(callback, ExactCheckpointCallback) and callback.path is None:
                if self.optimize_hyperparameters:
                    raise CheckpointError(
                        "Trials have no folder for exact checkpoints. Remove the callback from the "
                        "hyperparameters."
                    )
                callback.path = Path(self.save_path) / CHECKPOINTS
        super().create_callbacks()
        if self.algo in SEARCHING:
            self.callbacks = [
                SearchProgressBarCallback() if type(each) is ProgressBarCallback else each
                for each in self.callbacks
            ]
        index = next((i for i, cb in enumerate(self.callbacks) if isinstance(cb, SearchEvalCallback)), None)
        if index is None or (self.algo not in SEARCHING and self.search_evaluation is None):
            return
        label = "actor" if self.algo in SEARCHING else "search"
        if self.verbose > 0:
            print("Creating second test environment")
        second = SecondEvalCallback(
            self._create_second_eval_envs(),
            label,
            self.search_evaluation,
            n_eval_episodes=self.n_eval_episodes,
            log_path=str(sibling_folder(self.save_path, label)),
            eval_freq=self.eval_freq,
            deterministic=self.deterministic_eval,
        )
        self.callbacks.insert(index, second)

    def _create_second_eval_envs(self) -> VecEnv:
        wrapper = self.env_wrapper
        if self.search_evaluation is not None and self.search_evaluation.get("rollout_depth") != 0:
            self.env_wrapper = _wrapped_for_search(wrapper)
        try:
            return self.create_envs(self.n_eval_envs, eval_env=True)
        finally:
            self.env_wrapper = wrapper


def _check_names(custom: dict[str, Any]) -> None:
    """Exit with a one-line error for invalid settings of the command line.

    :param custom: hyperparameters of the command line.
    """
    for name, value in custom.items():
        if name in REMOVED:
            sys.exit(f"-params {name}:{value}: {name} was removed: {REMOVED[name][1]}.")
        if name in MOVED:
            sys.exit(
                f"-params {name}:{value}: {name} is now part of {MOVED[name]}: write "
                f'"{MOVED[name]}:dict({name}={value!r})".'
            )
        if not isinstance(value, str) or name not in SETTINGS:
            continue
        if name in GROUPS:
            sys.exit(f"-params {name}:{value}: must be a dictionary, such as dict(NAME=VALUE), or None.")
        value = present_name(value) if name == "strategy" else value
        if name not in NAMES:
            sys.exit(f"-params {name}:{value}: must be a number, True, False or None.")
        if value not in NAMES[name]:
            sys.exit(f"-params {name}:{value}: there is no such {name}; known are {', '.join(NAMES[name])}.")


def checked_search_evaluation(settings: Any, algo: str) -> dict[str, Any]:
    """
    Check the settings of a search around an algorithm that does not search.

    :param settings: ``search_evaluation`` of its hyperparameters
    :param algo: the algorithm's name on RL Zoo's command line
    :return: the settings, with those of their preset
    :raises TypeError: if a value has the wrong type
    :raises ValueError: if there is no such setting, or a value does not fit the others
    """
    if algo not in SEARCHABLE:
        reason = (
            "is evaluated with its training's search settings already"
            if algo in SEARCHING
            else "has no policy and critics to search with"
        )
        raise ValueError(
            f"search_evaluation is for {', '.join(SEARCHABLE)}; {algo} {reason}. "
            "Remove it from the hyperparameters."
        )
    if not isinstance(settings, dict):
        raise TypeError(
            "search_evaluation must be a dictionary of search settings such as "
            f"{{beam_width: 6, rollout_depth: 3}}, got {settings!r}."
        )
    settings = dict(settings)
    settings = with_preset(settings.pop("preset", None), settings)
    refuse_old_names(settings)
    unknown = sorted(set(settings) - set(KEYWORDS))
    if unknown:
        raise ValueError(
            f"search_evaluation has unknown settings: {', '.join(unknown)}. Known are: {', '.join(KEYWORDS)}."
        )
    make_settings(**settings)
    return settings


def _wrapped_for_search(wrapper: Callable[[gym.Env], gym.Env] | None) -> Callable[[gym.Env], gym.Env]:
    def wrap(env: gym.Env) -> gym.Env:
        return SnapshotEnvWrapper(env if wrapper is None else wrapper(env))

    return wrap
