"""What an agent learns from simulations besides its own transitions."""

import logging
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from sb3_mcbs.agents.mixed_batches import Part, mixed_batches
from sb3_mcbs.agents.rollout_replay import RolloutReplay, RolloutReplaySettings
from sb3_mcbs.agents.value_expansion import ValueExpansion, ValueExpansionSettings
from sb3_mcbs.search import Rollouts

logger = logging.getLogger("sb3_mcbs")


class SimulatedBatches:
    """Keeps what the simulations of an agent need beside its replay buffer, and mixes them into its batches.

    What is kept is in the replay buffer; this object can be made anew at any time.

    :param agent: an :class:`~sb3_mcbs.MCBS` agent that was set up.
    :raises TypeError: if a setting has the wrong type.
    :raises ValueError: if settings do not go together.
    """

    def __init__(self, agent: Any) -> None:
        self._agent = agent
        self._check()
        self._expansion: ValueExpansion | None = None
        self._expansion_of: tuple[Any, Any] | None = None
        self._kept = self._to_be_kept()
        self._rollout_replay()  # makes room in the buffer

    def _check(self) -> None:
        agent = self._agent
        RolloutReplaySettings.of(agent).check_search(agent.search_settings)
        expansion = ValueExpansionSettings.of(agent)
        expansion.check_search(agent.search_settings, agent.rollout_replay)
        expansion.check_buffer(agent.replay_buffer.optimize_memory_usage)

    def _to_be_kept(self) -> tuple[tuple[int, int] | None, bool]:
        """How many rollouts of how many steps are kept beside the replay buffer, and whether states are."""
        agent = self._agent
        most_rollouts = agent.schedule_settings.most_rollouts(agent.search_settings)
        return (most_rollouts if agent.rollout_replay else None), agent.value_expansion > 0

    def check_settings(self) -> None:
        """Refuse changed settings that need other arrays beside the replay buffer than there are.

        :raises TypeError: if a setting has the wrong type.
        :raises ValueError: if settings do not go together.
        """
        self._check()
        rollouts, states = self._to_be_kept()
        advice = "save it, and load it with the other settings."
        if rollouts != self._kept[0]:
            raise ValueError(
                "rollout_replay keeps equally many rollouts of equal length beside the replay buffer: "
                "neither that, nor whether they are kept, can be changed once the agent is made or loaded; "
                + advice
            )
        if states != self._kept[1]:
            raise ValueError(
                "value_expansion keeps states beside the replay buffer: it can be changed later, but not "
                "from or to 0; " + advice
            )

    def begin(self) -> None:
        """A training is about to begin: let go of what earlier settings have kept in the replay buffer."""
        attributes = vars(self._agent.replay_buffer)
        for kept, prefix in zip(self._kept, ("rollout_", "expansion_"), strict=True):
            gone = [] if kept else [name for name in attributes if name.startswith(prefix)]
            for name in gone:
                del attributes[name]
            if gone:
                logger.info("The replay buffer's %s are dropped: no setting uses them.", ", ".join(gone))

    def connect(self) -> None:
        """Follow the agent to another searcher.

        :raises ForwardModelError: if its forward model is not one to learn from.
        """
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
        rollouts, _ = self._kept
        return None if rollouts is None else RolloutReplay(self._agent.replay_buffer, *rollouts)

    def _value_expansion(self) -> ValueExpansion | None:
        agent = self._agent
        if not agent.value_expansion:
            return None
        # Whoever loads a replay buffer or sets an environment exchanges them.
        if self._expansion_of != (agent.replay_buffer, agent._searcher):
            self._expansion = ValueExpansion(agent, agent._searcher)
            self._expansion_of = (agent.replay_buffer, agent._searcher)
        return self._expansion
