"""What an agent learns from simulations besides its own transitions."""

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from sb3_mcbs.algorithms.mixed_batches import Part, mixed_batches
from sb3_mcbs.algorithms.rollout_replay import RolloutReplay, RolloutReplaySettings
from sb3_mcbs.algorithms.value_expansion import ValueExpansion, ValueExpansionSettings
from sb3_mcbs.search import Rollouts


class SimulatedBatches:
    """Keeps what the simulations of an agent need beside its replay buffer, and mixes them into its batches.

    What is kept is in the replay buffer; this object can be made anew at any time.

    :param agent: an :class:`~sb3_mcbs.MCBS` agent that was set up.
    :raises TypeError: if a setting has the wrong type.
    :raises ValueError: if settings do not go together.
    """

    def __init__(self, agent: Any) -> None:
        self._agent = agent
        RolloutReplaySettings.of(agent).check_search(agent.search_settings)
        expansion = ValueExpansionSettings.of(agent)
        expansion.check_search(agent.search_settings, agent.rollout_replay)
        expansion.check_buffer(agent.replay_buffer.optimize_memory_usage)
        self._expansion: ValueExpansion | None = None
        self._expansion_of: tuple[Any, Any] | None = None
        self._most_rollouts = agent.schedule_settings.most_rollouts(agent.search_settings)
        self._rollout_replay()  # makes room in the buffer

    def connect(self) -> None:
        """Follow the agent to another searcher.

        :raises ForwardModelError: if its forward model is not one to learn from.
        """
        self._most_rollouts = self._agent.schedule_settings.most_rollouts(self._agent.search_settings)
        self._value_expansion()

    def look(self) -> None:
        """The environments are about to be stepped."""
        expansion = self._value_expansion()
        if expansion is not None:
            expansion.look()

    def model_error(self, *step: Any) -> float | None:
        """See :meth:`ValueExpansion.model_error`; ``None`` without value expansion.

        :param step: its arguments.
        """
        expansion = self._value_expansion()
        return None if expansion is None else expansion.model_error(*step)

    def store(self, row: int, rollouts: Rollouts | None, dones: np.ndarray) -> None:
        """Keep what belongs to a step of the environments.

        :param row: of the replay buffer that the step will be in.
        :param rollouts: of the search at this step.
        :param dones: ``[n_envs]``, whether the episode ended.
        """
        replay, expansion = self._rollout_replay(), self._value_expansion()
        if replay is not None:
            replay.put(row, rollouts)
            self._agent.logger.record("search/stored_rollouts", replay.count)
        if expansion is not None:
            expansion.put(row, dones)

    def mixed(self) -> AbstractContextManager[None]:
        """While it is entered the agent's batches are mixed."""
        replay, expansion, parts = self._rollout_replay(), self._value_expansion(), []
        if replay is not None and replay.count:
            parts.append(Part(replay, self._agent.rollout_replay))
        if expansion is not None:
            parts.append(Part(expansion, self._agent.expanded_share))
        return mixed_batches(self._agent, parts, self._agent.rollout_rng) if parts else nullcontext()

    def _rollout_replay(self) -> RolloutReplay | None:
        agent = self._agent
        if not agent.rollout_replay:
            return None
        return RolloutReplay(agent.replay_buffer, *self._most_rollouts)

    def _value_expansion(self) -> ValueExpansion | None:
        agent = self._agent
        if not agent.value_expansion:
            return None
        # Whoever loads a replay buffer or sets an environment exchanges them.
        if self._expansion_of != (agent.replay_buffer, agent._searcher):
            self._expansion = ValueExpansion(agent, agent._searcher)
            self._expansion_of = (agent.replay_buffer, agent._searcher)
        return self._expansion
