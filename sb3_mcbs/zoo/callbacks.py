"""Evaluation callbacks for both policies of an agent: the actor alone, and with search."""

from typing import Any

import numpy as np
import optuna
from rl_zoo3.callbacks import SaveVecNormalizeCallback, TrialEvalCallback
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_mcbs.agents import MCBS, SearchPolicy
from sb3_mcbs.zoo.tuning import OBJECTIVE, OBJECTIVES, RETURNS, SEEDS


class ActsWithSearch(EvalCallback):
    """Evaluates agents that search in training with search, and any other agent without."""

    def init_callback(self, model: BaseAlgorithm) -> None:
        """
        :param model: the agent; it is used for saving and logging, and only evaluated actions are searched
        """
        if isinstance(model, MCBS):
            super().init_callback(SearchPolicy(model, self.eval_env, seed=model.seed))  # type: ignore[arg-type]
        else:
            super().init_callback(model)


class SearchEvalCallback(ActsWithSearch):
    """Replaces the ``EvalCallback`` of RL Zoo's training runs."""

    def _on_step(self) -> bool:
        due = self.eval_freq > 0 and self.n_calls % self.eval_freq == 0
        if due and self.verbose >= 1 and isinstance(self.model, SearchPolicy):
            print("Evaluating with search:")
        return super()._on_step()


class SearchTrialEvalCallback(ActsWithSearch, TrialEvalCallback):
    """
    Replaces the callback whose last evaluation is the objective of RL Zoo's ``-optimize``.

    A trial may have several trainings, one after another, each with a callback of its own. The objective is
    then that of the episodes of all trainings up to the present one. The first reports each evaluation to the
    pruner; each further one reports its last only, as one more step. So a step means the same in all trials.

    :param eval_env: a separate evaluation environment
    :param trial: Optuna's trial; its user attributes say what the objective is, and what the trainings before
        this one returned
    :param best_model_save_path: the trial's folder, if any
    :param log_path: not used: it is the same folder
    :param eval_kwargs: the other arguments of RL Zoo's callback
    """

    def __init__(
        self,
        eval_env: Any,
        trial: optuna.Trial,
        best_model_save_path: str | None = None,
        log_path: str | None = None,
        **eval_kwargs: Any,
    ) -> None:
        attributes = trial.user_attrs
        #: The returns of each training, evaluation and episode.
        self.returns: list[list[list[float]]] = [*attributes.get(RETURNS, []), []]
        self.objective = OBJECTIVES[attributes.get(OBJECTIVE, "mean")]
        folder = best_model_save_path
        if folder is not None and SEEDS in attributes:
            folder = f"{folder}/seed_{len(self.returns) - 1}"
        super().__init__(eval_env, trial, best_model_save_path=folder, log_path=folder, **eval_kwargs)
        if folder is not None:
            self.callback_on_new_best = SaveVecNormalizeCallback(save_freq=1, save_path=folder)
            self.callback_on_new_best.parent = self

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        super()._log_success_callback(locals_, globals_)
        # This list grows with each episode. EvalCallback keeps it only if it writes a file.
        self._episode_returns: list[float] = locals_["episode_rewards"]

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0:
            return True
        EvalCallback._on_step(self)  # not RL Zoo's, which reports the mean of this training
        self.eval_idx += 1
        self.returns[-1].append([float(value) for value in self._episode_returns])
        self.trial.set_user_attr(RETURNS, self.returns)
        if isinstance(self.model, SearchPolicy):
            self.trial.set_user_attr("search/decisions", int(self.model.n_decisions))
            self.trial.set_user_attr("search/simulated_steps", int(self.model.n_simulated_steps))
            self.trial.set_user_attr("search/invalid_rollouts", int(self.model.n_invalid_rollouts))
        episodes = [training[self.eval_idx - 1] for training in self.returns]
        self.last_mean_reward = self.objective(np.concatenate(episodes))
        n_before = len(self.returns) - 1
        n_evaluations = len(self.returns[0])
        if n_before > 0 and self.eval_idx < n_evaluations:
            return True
        self.trial.report(self.last_mean_reward, self.eval_idx + n_before)
        self.is_pruned = self.trial.should_prune()
        return not self.is_pruned


class SecondEvalCallback(EvalCallback):
    """
    Evaluates the policy that the run's own evaluation does not: the bare actor, or the agent with search.

    It writes its own ``evaluations.npz`` and logs under ``eval_LABEL/``, so each number names its policy. It
    saves no best model and does not use global random generators.

    :param eval_env: a separate evaluation environment
    :param label: the measured policy in the logger's keys: ``actor`` or ``search``
    :param search_settings: settings of the search; None evaluates the bare agent
    :param eval_kwargs: the other arguments of ``EvalCallback``
    """

    #: A view of the agent's logger.
    not_checkpointed = ("_renaming_logger",)

    def __init__(
        self,
        eval_env: Any,
        label: str,
        search_settings: dict[str, Any] | None = None,
        **eval_kwargs: Any,
    ) -> None:
        super().__init__(eval_env, **eval_kwargs)
        self.label = label
        self.search_settings = search_settings
        self._renaming_logger: RenamingLogger | None = None

    def init_callback(self, model: BaseAlgorithm) -> None:
        """
        :param model: the agent
        """
        if self.search_settings is None:
            super().init_callback(model)
        else:
            assert isinstance(model, OffPolicyAlgorithm), "the manager lets no other algorithm search"
            policy = SearchPolicy(model, self.eval_env, seed=model.seed, **self.search_settings)
            super().init_callback(policy)  # type: ignore[arg-type]

    @property
    def logger(self) -> Logger:
        """The agent's logger, with keys of the second evaluation."""
        target = super().logger
        if self._renaming_logger is None or self._renaming_logger.target is not target:
            self._renaming_logger = RenamingLogger(target, "eval/", f"eval_{self.label}/")
        return self._renaming_logger

    def _on_step(self) -> bool:
        verbose, self.verbose = self.verbose, 0
        n_evaluations = len(self.evaluations_results)
        continue_training = super()._on_step()
        self.verbose = verbose
        if verbose >= 1 and len(self.evaluations_results) > n_evaluations:
            policy = "the actor alone" if self.label == "actor" else "the agent with search"
            returns = self.evaluations_results[-1]
            print(
                f"Eval of {policy}: num_timesteps={self.num_timesteps}, "
                f"episode_reward={np.mean(returns):.2f} +/- {np.std(returns):.2f}"
            )
        return continue_training


class RenamingLogger(Logger):
    """
    Records in another logger under other names, without writing it out.

    :param target: the logger to record in
    :param old: prefix of the keys to rename
    :param new: the new prefix
    """

    def __init__(self, target: Logger, old: str, new: str) -> None:
        super().__init__(folder=None, output_formats=[])
        self.target = target
        self.old = old
        self.new = new

    def record(self, key: str, value: Any, exclude: str | tuple[str, ...] | None = None) -> None:
        """
        :param key: name of the value; renamed if it starts with ``old``
        :param value: the value
        :param exclude: outputs that do not get it
        """
        renamed = self.new + key.removeprefix(self.old) if key.startswith(self.old) else key
        self.target.record(renamed, value, exclude)

    def dump(self, step: int = 0) -> None:
        """
        Write nothing: the run's own evaluation follows immediately and writes both.

        :param step: not used
        """
