"""Logs an agent's decisions, and what a training took."""

import time
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    ConvertCallback,
    ProgressBarCallback,
)
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_mcbs.search import BeamSettings, SearchResult, SearchSettings


def record_decision(agent: Any, result: SearchResult, seconds: float, settings: SearchSettings) -> None:
    """Count a decision, and write its result to the agent's logger.

    :param agent: an :class:`~sb3_mcbs.MCBS` agent.
    :param result: the search's result.
    :param seconds: duration of the decision.
    :param settings: settings of this decision.
    """
    n_envs = len(result.chosen)
    agent.n_decisions += n_envs
    agent.n_simulated_steps += result.simulated_steps
    agent.n_invalid_rollouts += result.invalid_rollouts
    agent.n_critic_evaluations += result.critic_evaluations
    searched = result.chosen >= 0
    values = result.values[searched]
    if values.size and np.isfinite(values).all():
        agent.candidate_values.append(values)
        # In a tree the chosen root belongs to the best leaf, and need not have the best value.
        best = np.take_along_axis(values, result.chosen[searched][:, None], axis=1)[:, 0]
        agent.logger.record_mean("search/value_gain", float((best - values.mean(axis=1)).mean()))
        agent.logger.record_mean("search/beam_std", float(values.std(axis=1).mean()))
    agent.logger.record_mean("search/ms_per_decision", 1000 * seconds / n_envs)
    if isinstance(settings, BeamSettings) and settings.time_budget is not None:
        agent.logger.record_mean("search/rounds", result.rounds)
        agent.logger.record_mean("search/candidates", result.values.shape[1])
    if result.surviving_roots is not None:
        agent.logger.record_mean("search/surviving_roots", float(result.surviving_roots.mean()))
    agent.logger.record("search/beam_width", settings.beam_width)
    agent.logger.record("search/rollout_depth", settings.rollout_depth)
    agent.logger.record("search/critic_evaluations", agent.n_critic_evaluations)
    agent.logger.record("search/decisions", agent.n_decisions)
    agent.logger.record("search/simulated_steps", agent.n_simulated_steps)
    agent.logger.record("search/invalid_rollouts", agent.n_invalid_rollouts)


class TrainingStart(NamedTuple):
    """An agent's counters at the beginning of a training."""

    timesteps: int
    decisions: int
    simulated_steps: int
    seconds: float

    @classmethod
    def of(cls, agent: Any, reset_num_timesteps: bool) -> "TrainingStart":
        """Read them.

        :param agent: an :class:`~sb3_mcbs.MCBS` agent.
        :param reset_num_timesteps: whether its environment steps are about to be counted from 0.
        """
        timesteps = 0 if reset_num_timesteps else agent.num_timesteps
        return cls(timesteps, agent.n_decisions, agent.n_simulated_steps, time.perf_counter())

    def summary(self, agent: Any) -> str:
        """What the training took, as one line.

        :param agent: the same agent at the end.
        """
        seconds = time.perf_counter() - self.seconds
        steps = agent.num_timesteps - self.timesteps
        searched = (agent.n_decisions - self.decisions) / max(steps, 1)
        return (
            f"Trained for {steps:,} environment steps in {seconds:,.0f} s with "
            f"{agent.n_simulated_steps - self.simulated_steps:,} simulated steps; {searched:.0%} of the "
            "decisions were searched."
        )


class SearchProgressBarCallback(ProgressBarCallback):
    """SB3's progress bar, with the share of decisions that were searched and the milliseconds of one."""

    def _on_training_start(self) -> None:
        super()._on_training_start()
        agent: Any = self.model
        self._steps, self._decisions = agent.num_timesteps, agent.n_decisions
        self._milliseconds = 0.0

    def _on_step(self) -> bool:
        agent: Any = self.model
        n_decisions = agent.n_decisions - self._decisions
        if n_decisions:
            # The mean since the last table; a table takes it away.
            known = self.logger.name_to_value
            self._milliseconds = known.get("search/ms_per_decision", self._milliseconds)
            share = n_decisions / (agent.num_timesteps - self._steps)
            # tqdm shows no postfix where it draws with rich. 80 columns leave room for few words.
            milliseconds = f"{self._milliseconds:.{0 if self._milliseconds >= 10 else 1}f}"
            self.pbar.set_description_str(f"search {share:.0%}, {milliseconds} ms", refresh=False)
        return super()._on_step()


def with_progress_bar(callback: MaybeCallback) -> BaseCallback:
    """Add a progress bar as SB3 does.

    :param callback: an argument of ``learn``.
    """
    if isinstance(callback, list):
        callback = CallbackList(callback)
    if not isinstance(callback, BaseCallback):
        callback = ConvertCallback(callback)
    return CallbackList([callback, SearchProgressBarCallback()])
