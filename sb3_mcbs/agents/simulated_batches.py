"""Batches of which a part is expanded by simulations: whether, and from when on."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs.agents.value_expansion import ValueExpansion, ValueExpansionSettings

logger = logging.getLogger("sb3_mcbs")


class SimulatedBatches:
    """Keeps what value expansion needs beside an agent's replay buffer, and mixes it into its batches.

    What is kept is in the replay buffer; this object can be made anew at any time. Without value expansion it
    does nothing.

    :param agent: an :class:`~sb3_mcbs.MCBS` agent that was set up.
    :raises TypeError: if a setting has the wrong type.
    :raises ValueError: if settings do not go together.
    """

    def __init__(self, agent: Any) -> None:
        self._agent = agent
        self._check()
        self._expansion: ValueExpansion | None = None
        self._expansion_of: tuple[Any, Any] | None = None
        self._keeps_states = agent.value_expansion > 0

    def _check(self) -> None:
        expansion = ValueExpansionSettings.of(self._agent)
        expansion.check_search(self._agent.search_settings)
        expansion.check_buffer(self._agent.replay_buffer.optimize_memory_usage)

    def check_settings(self) -> None:
        """Refuse changed settings that need other arrays beside the replay buffer than there are.

        :raises TypeError: if a setting has the wrong type.
        :raises ValueError: if settings do not go together.
        """
        self._check()
        if (self._agent.value_expansion > 0) != self._keeps_states:
            raise ValueError(
                "value_expansion keeps states beside the replay buffer: it can be changed later, but not "
                "from or to 0; save the agent, and load it with the other settings."
            )

    def begin(self) -> None:
        """A training is about to begin: let go of what earlier settings have kept in the replay buffer."""
        attributes = vars(self._agent.replay_buffer)
        gone = [name for name in attributes if name.startswith("expansion_") and not self._keeps_states]
        for name in gone:
            del attributes[name]
        if gone:
            logger.info("The replay buffer's %s are dropped: no setting uses them.", ", ".join(gone))

    def connect(self) -> None:
        """Follow the agent to another planner.

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

    def store(self, row: int, dones: np.ndarray) -> None:
        """Keep what belongs to a step of the environments.

        :param row: of the replay buffer that the step will be in.
        :param dones: ``[n_envs]``, whether the episode ended.
        """
        expansion = self._value_expansion()
        if expansion is not None:
            expansion.put(row, dones)

    @contextmanager
    def mixed(self) -> Iterator[None]:
        """While it is entered the agent's batches are mixed."""
        expansion, agent = self._value_expansion(), self._agent
        if expansion is None:
            yield
            return
        buffer = agent.replay_buffer
        agent.replay_buffer = _Mixture(agent, expansion)
        try:
            yield
        finally:
            agent.replay_buffer = buffer

    def _value_expansion(self) -> ValueExpansion | None:
        agent = self._agent
        if not agent.value_expansion:
            return None
        # Whoever loads a replay buffer or sets an environment exchanges them.
        if self._expansion_of != (agent.replay_buffer, agent.planner):
            self._expansion = ValueExpansion(agent, agent.planner)
            self._expansion_of = (agent.replay_buffer, agent.planner)
        return self._expansion


class _Mixture:
    """A replay buffer of whose batches a part is expanded."""

    def __init__(self, agent: Any, expansion: ValueExpansion) -> None:
        self._agent, self._expansion = agent, expansion
        self._buffer: Any = agent.replay_buffer

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        agent = self._agent
        n_expanded = round(agent.expanded_share * batch_size)
        samples = []
        if n_expanded < batch_size:
            own = self._buffer.sample(batch_size - n_expanded, env=env)
            if own.discounts is None:
                own = own._replace(discounts=th.full_like(own.rewards, agent.gamma))
            samples.append(own)
        if n_expanded:
            samples.append(self._expansion.sample(n_expanded, agent.gamma, agent.rollout_rng, env))
        return type(samples[0])(*(_joined(fields) for fields in zip(*samples, strict=True)))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._buffer, name)


def _joined(fields: Sequence[Any]) -> Any:
    if isinstance(fields[0], dict):
        return {key: th.cat([field[key] for field in fields]) for key in fields[0]}
    return th.cat(list(fields))
