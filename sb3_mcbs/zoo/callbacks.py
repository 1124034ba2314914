"""Evaluation callbacks for both policies of an agent: the actor alone, and with search."""

from typing import Any

import numpy as np
from rl_zoo3.callbacks import TrialEvalCallback
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_mcbs.agents import MCBS, SearchPolicy


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
    """Replaces the callback whose last evaluation is the objective of RL Zoo's ``-optimize``."""

    def _on_step(self) -> bool:
        evaluations = self.eval_idx
        continue_training = super()._on_step()
        if self.eval_idx > evaluations and isinstance(self.model, SearchPolicy):
            self.trial.set_user_attr("search/decisions", int(self.model.n_decisions))
            self.trial.set_user_attr("search/simulated_steps", int(self.model.n_simulated_steps))
            self.trial.set_user_attr("search/invalid_rollouts", int(self.model.n_invalid_rollouts))
        return continue_training


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
