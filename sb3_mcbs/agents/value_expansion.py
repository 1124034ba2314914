"""Critic targets that are rolled forward in the simulator: model-based value expansion.

From the stored state after a transition, the simulator takes the actions of the current target actor (SAC,
TQC and CrossQ: sampled from the current actor, with an entropy term at every step as in their own targets;
Feinberg et al., 2018, with the simulator as the model). The target then bootstraps from the critics: rewards
are exact, actions are not old ones as with ``n_steps``, and values propagate several steps per update.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import RolloutReturn

from sb3_mcbs.agents.branches import Branches, n_rollouts
from sb3_mcbs.agents.checked_rollouts import CheckedRollouts
from sb3_mcbs.agents.compiled_policy import way
from sb3_mcbs.agents.expanded_buffer import (
    ExpandedReplayBuffer,
    batched_states,
    compiled_target,
    drop_states,
    expand,
    has_batched_states,
    make_room,
)
from sb3_mcbs.agents.planner import Planner
from sb3_mcbs.agents.roots import Prediction
from sb3_mcbs.search import SearchSettings
from sb3_mcbs.search.checks import CheckedSettings

#: Settings that say whether targets are rolled forward, and how.
EXPANSION = ("value_expansion", "branch_length")
#: A larger value is surely a mistake.
MAX_EXPANSION = 1000
MAX_BRANCH_LENGTH = 100_000


@dataclass(frozen=True)
class ValueExpansionSettings(CheckedSettings):
    """How far critic targets are rolled forward.

    :param value_expansion: steps that are simulated after a sampled transition, with the current target
        actor, before the target bootstraps from the critics. 0: none, as in SB3.
    :param expanded_share: the share of every batch whose transitions are expanded. Every gradient step
        simulates ``value_expansion`` environment steps for each of them.
    :param branch_length: 0: stored transitions are expanded. Above: ``expanded_share`` of every batch are
        simulated transitions instead, from rollouts of the current actor that branch off stored states and
        are so many steps long. Every gradient step continues them by ``value_expansion`` steps, up to which
        the transitions' targets reach. See :class:`~sb3_mcbs.agents.branches.Branches`.
    :raises TypeError: if a value has the wrong type.
    :raises ValueError: if a value is out of range.
    """

    flat = ("value_expansion", "expanded_share", "branch_length")

    value_expansion: int = 0
    expanded_share: float = 0.5
    branch_length: int = 0

    def __post_init__(self) -> None:
        self._set_integer("value_expansion", 0, MAX_EXPANSION)
        self._set_number("expanded_share", 1.0)
        self._set_integer("branch_length", 0, MAX_BRANCH_LENGTH)
        if self.value_expansion and not self.expanded_share:
            raise ValueError("value_expansion needs an expanded_share above 0: nothing would be expanded.")
        if self.branch_length and not self.value_expansion:
            raise ValueError("branch_length needs a value_expansion above 0: nothing would be simulated.")
        if 0 < self.branch_length < self.value_expansion:
            raise ValueError(
                f"branch_length must be 0 or at least value_expansion ({self.value_expansion}): every "
                f"gradient step continues the branches by so many steps; got {self.branch_length}."
            )

    def check_search(self, settings: SearchSettings) -> None:
        """Refuse settings of the search that do not work with value expansion.

        :param settings: settings of the search.
        :raises ValueError: names the setting and the reason.
        """
        if not self.value_expansion:
            return
        if settings.rollout_depth == 0:
            raise ValueError(
                "value_expansion needs a rollout_depth of 1 or more: with 0 there is no forward model. "
                "search_share=0 leaves the search out."
            )
        if settings.forward_model == "ensemble":
            raise ValueError(
                "value_expansion needs the simulator, which forward_model='ensemble' does without: leave one "
                "of the two out."
            )

    def check_buffer(self, optimize_memory_usage: bool) -> None:
        """Refuse replay buffers without next observations.

        :param optimize_memory_usage: of the replay buffer.
        :raises ValueError: names the setting and the reason.
        """
        if self.value_expansion and optimize_memory_usage:
            raise ValueError(
                "value_expansion needs the last observation of every transition, which a replay buffer with "
                "optimize_memory_usage does not keep at the end of an episode: leave that out."
            )


class Expanding(CheckedRollouts):
    """An agent whose critic targets are rolled forward if ``value_expansion`` is above 0.

    Every step, searched or not, is then compared with the simulator's prediction.

    :ivar rollout_rng: samples the transitions to expand, separately from the agent's generators.
    :ivar expansion_where_possible: the preset's value expansion if no other was given: the attributes have
        these values where the forward model allows it, and are 0 elsewhere.
    """

    value_expansion: int
    expanded_share: float
    branch_length: int
    planner: Planner | None
    n_simulated_steps: int
    #: Simulated rollouts that are not part of saved agents; exact checkpoints contain them.
    branches: Branches | None = None
    rollout_rng: np.random.Generator | None = None
    expansion_where_possible: dict[str, int] | None = None
    _known_expansion = (False, False)
    #: The states in which the next actions are executed.
    _states: np.ndarray | None = None

    def _check_buffer(self) -> None:
        """Refuse replay buffers that cannot be expanded."""
        if self.replay_buffer is not None:  # it may have been taken away
            ValueExpansionSettings.of(self).check_buffer(self.replay_buffer.optimize_memory_usage)

    def current_branches(self) -> Branches | None:
        """The simulated rollouts, which begin anew if settings or states are others.

        :return: ``None`` without a ``branch_length``.
        """
        if not self.branch_length:
            return None
        n_sampled = round(self.expanded_share * self.batch_size)
        shape = n_rollouts(n_sampled, self.value_expansion), self.value_expansion, self.branch_length
        if self.branches is None or not self.branches.fits(self.replay_buffer, shape):
            self.branches = Branches(self.replay_buffer, *shape)
        return self.branches

    def _check_states(self) -> None:
        """Refuse a forward model whose states cannot be kept, and drop states that it cannot go on from."""
        if self.expansion_where_possible:
            possible = has_batched_states(self)
            vars(self).update(self.expansion_where_possible if possible else dict.fromkeys(EXPANSION, 0))
            self._check_buffer()
        if self.value_expansion:
            state_size = batched_states(self).shape[1]
            if isinstance(self.replay_buffer, ExpandedReplayBuffer):
                make_room(self.replay_buffer, state_size)

    def _note_expansion(self) -> bool:
        """Note whether there is value expansion, and drop branches that are not continued.

        :return: whether it was switched on or off since the last call, or may now be left out.
        """
        if not self.branch_length:
            self.branches = None  # later they would be those of an old actor
        before, now = self._known_expansion, (self.value_expansion > 0, bool(self.expansion_where_possible))
        self._known_expansion = now
        return before != now

    def _expand_buffer(self) -> None:
        """Convert the replay buffer, before every use, since loading one replaces it."""
        if self.value_expansion:
            assert self.replay_buffer is not None
            expand(self.replay_buffer, self)

    def _expansion_in_words(self) -> str:
        """How samples are rolled forward; empty if they are not."""
        if not self.value_expansion:
            left_out = "; value expansion is left out: it needs batched MuJoCo"
            return left_out if self.expansion_where_possible else ""
        if self.branch_length:
            return f"; branches {way('every transition of theirs is kept')}"
        try:
            compiled_target(self, self.get_vec_normalize_env())
            reason = ""
        except TypeError as error:
            reason = str(error)
        return f"; expanded targets {way(reason)}"

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

    def train(self, *args: Any, **kwargs: Any) -> None:
        self._expand_buffer()
        super().train(*args, **kwargs)

    def _store_valid_transition(self, *transition: Any) -> None:
        if self.value_expansion:
            buffer: ExpandedReplayBuffer = transition[0]
            buffer.states_after = batched_states(self)
        super()._store_valid_transition(*transition)
