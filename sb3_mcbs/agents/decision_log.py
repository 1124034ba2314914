"""Logs an agent's decisions."""

from typing import Any

import numpy as np

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
