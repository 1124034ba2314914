"""Connects SB3's training loop with a replay buffer that rolls critic targets forward in the simulator."""

from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import RolloutReturn

from sb3_mcbs.agents.checked_rollouts import CheckedRollouts
from sb3_mcbs.agents.planner import Planner
from sb3_mcbs.agents.roots import Prediction
from sb3_mcbs.agents.value_expansion import ValueExpansionSettings, batched_states, drop_states, expand
from sb3_mcbs.search import SearchSettings


class Expanding(CheckedRollouts):
    """An agent whose critic targets are rolled forward if ``value_expansion`` is above 0.

    Every step, searched or not, is then compared with the simulator's prediction.

    :ivar rollout_rng: samples the transitions to expand, separately from the agent's generators.
    """

    value_expansion: int
    planner: Planner | None
    n_simulated_steps: int
    rollout_rng: np.random.Generator | None = None
    _keeps_states = False
    #: The states in which the next actions are executed.
    _states: np.ndarray | None = None

    def _set_up_expansion(self, settings: SearchSettings) -> None:
        self._check_expansion(settings)
        self._keeps_states = self.value_expansion > 0

    def _follow_expansion(self, settings: SearchSettings) -> None:
        """Refuse changed settings that need other arrays in the replay buffer.

        :param settings: settings of the search.
        """
        self._check_expansion(settings)
        if (self.value_expansion > 0) != self._keeps_states:
            raise ValueError(
                "value_expansion stores states in the replay buffer: it can be changed later, but not "
                "from or to 0; save the agent, and load it with the other settings."
            )

    def _check_expansion(self, settings: SearchSettings) -> None:
        expansion = ValueExpansionSettings.of(self)
        expansion.check_search(settings)
        assert self.replay_buffer is not None
        expansion.check_buffer(self.replay_buffer.optimize_memory_usage)

    def _check_states(self) -> None:
        """Refuse a forward model whose states cannot be kept."""
        if self.value_expansion:
            batched_states(self)

    def _expand_buffer(self) -> None:
        """Convert the replay buffer, before every use, since loading one replaces it."""
        if self.value_expansion:
            assert self.replay_buffer is not None
            expand(self.replay_buffer, self)

    def _note_states(self) -> None:
        """Keep the environments' states before a step."""
        self._states = batched_states(self) if self.value_expansion else None

    def _predict_step(self, actions: np.ndarray) -> Prediction | None:
        """Simulate the last step of the environments.

        :param actions: ``[n_envs, act_dim]``, scaled.
        :return: ``None`` without value expansion or a deterministic forward model.
        """
        if self._states is None:
            return None
        assert self.planner is not None and self.rollout_rng is not None
        prediction = self.planner.predict(list(self._states), actions, self.rollout_rng)
        self.n_simulated_steps += 0 if prediction is None else len(actions)
        self._states = None
        return prediction

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        if not self.value_expansion:
            drop_states(self.replay_buffer)
        return super()._setup_learn(*args, **kwargs)

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        self._expand_buffer()
        return super().collect_rollouts(*args, **kwargs)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        self._expand_buffer()
        super().train(gradient_steps, batch_size)
