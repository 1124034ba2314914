"""Targets of the critics from a few exact steps of the present actor: model-based value expansion.

After a stored transition the simulator goes on, from the state that it was really in, with the actions that
the present target actor takes (of SAC and TQC: drawn from the present actor, whose entropy counts at every
step as in their own targets; Feinberg et al., 2018, with the simulator for a model). The critics bootstrap
some steps later: rewards are exact, actions are not old ones as in the returns of ``n_steps``, and values
travel several steps in one update.
"""

from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, NamedTuple, cast

import numpy as np
from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs.agents.planner import Planner
from sb3_mcbs.models import ForwardModelError
from sb3_mcbs.networks.functions import policy_function, soft_policy_function, unscale_function
from sb3_mcbs.networks.torch_settings import one_thread
from sb3_mcbs.search import SearchResult, SearchSettings
from sb3_mcbs.search.checks import CheckedSettings
from sb3_mcbs.search.interface import FirstStep
from sb3_mcbs.types import Observations, map_arrays, put_rows, take_rows

Samples = ReplayBufferSamples | DictReplayBufferSamples

#: More steps than this after every sampled transition are a mistake.
MAX_EXPANSION = 1000


@dataclass(frozen=True)
class ValueExpansionSettings(CheckedSettings):
    """Whether the critics' targets look further than one step.

    :param value_expansion: steps that are simulated after a sampled transition, with the present target
        actor, before the critics' target closes it. 0: none, as SB3.
    :param expanded_share: the share of every batch whose transitions are expanded. Every gradient step
        simulates ``value_expansion`` environment steps for each of them.
    :raises TypeError: if a value has the wrong type.
    :raises ValueError: if a value is out of range.
    """

    flat = ("value_expansion", "expanded_share")

    value_expansion: int = 0
    expanded_share: float = 0.5

    def __post_init__(self) -> None:
        self._set_integer("value_expansion", 0, MAX_EXPANSION)
        self._set_number("expanded_share", 1.0)
        if self.value_expansion and not self.expanded_share:
            raise ValueError("value_expansion needs an expanded_share above 0: nothing would be expanded.")

    def check_search(self, settings: SearchSettings) -> None:
        """Refuse what does not go together.

        :param settings: of the search.
        :raises ValueError: says which setting, and why.
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
                "value_expansion goes on in the simulator, which forward_model='ensemble' does without: "
                "leave one of the two out."
            )

    def check_buffer(self, optimize_memory_usage: bool) -> None:
        """Refuse replay buffers that do not keep what is needed.

        :param optimize_memory_usage: as SB3's replay buffers have it.
        :raises ValueError: says which setting, and why.
        """
        if self.value_expansion and optimize_memory_usage:
            raise ValueError(
                "value_expansion goes on from the last observation of a transition, which a replay buffer "
                "with optimize_memory_usage does not keep at the end of an episode: leave that out."
            )


class _Outcome(NamedTuple):
    """What transitions of several steps came to.

    :param returns: ``[n]``, discounted sums of rewards as the networks are given them.
    :param lengths: ``[n]``, steps.
    :param terminated: ``[n]`` bool, whether the environment ended the episode.
    :param observations: ``[n, *]``, the last ones, as replay buffers keep them.
    """

    returns: np.ndarray
    lengths: np.ndarray
    terminated: np.ndarray
    observations: Observations


class ValueExpansion:
    """The simulator's states beside the rows of a replay buffer, and what follows from them.

    States are attributes of the buffer, so that they are saved and loaded with it: for every row and
    environment the state after the step, and whether there is one (not where the episode ended).

    :param agent: an :class:`~sb3_mcbs.MCBS` agent; what is simulated is added to its ``n_simulated_steps``.
    :param planner: of the agent, with its forward model.
    :raises ForwardModelError: if the forward model's states are no arrays.
    """

    def __init__(self, agent: Any, planner: Planner) -> None:
        self._agent, self.planner = agent, planner
        self._before: np.ndarray | None = None
        buffer = self._buffer = cast(Any, agent.replay_buffer)
        shape = (buffer.buffer_size, buffer.n_envs)
        held = getattr(buffer, "expansion_states", None)
        (state,) = self._states(range(1))
        if held is None or held.shape[:2] != shape:
            buffer.expansion_states = np.zeros((*shape, len(state)))
            buffer.expansion_held = np.zeros(shape, dtype=bool)

    def _acting(self) -> Callable[[Observations, np.random.Generator], tuple[np.ndarray, np.ndarray]]:
        """The actor of the targets as it is now: its actions, and what their entropy adds."""
        if isinstance(self._agent, SAC | TQC):
            return soft_policy_function(self._agent)
        policy = policy_function(self._agent, target=True)
        return lambda observations, rng: (policy(observations), np.zeros(len(observations)))

    def _states(self, envs: range) -> np.ndarray:
        planner = self.planner
        states = planner.read_roots(envs) if self._is_batched else []
        if not self._is_batched:  # the environment may just have exchanged its simulator
            raise ForwardModelError(
                "value_expansion keeps the simulator's states in the replay buffer, which needs batched "
                f"MuJoCo; here simulates: {planner.description}. Leave value_expansion out."
            )
        return np.stack(states)

    @property
    def _is_batched(self) -> bool:
        return self.planner.model is not None and self.planner.model.kind == "mujoco"

    def look(self) -> None:
        """Remember the states that the environments are in before a step, for :meth:`model_error`."""
        self._before = self._states(range(self._buffer.n_envs))

    def model_error(
        self,
        actions: np.ndarray,
        observations: Observations,
        rewards: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> float | None:
        """Compare what the simulator would have done with what the environments did, searched or not.

        :param actions: ``[n_envs, act_dim]``, executed, scaled.
        :param observations: see :meth:`Planner.model_error`, as all else.
        :param rewards: ``[n_envs]``.
        :param infos: one per environment.
        :return: see there; ``None`` as well if the states before the step are not known.
        """
        model, n_envs = self.planner.model, self._buffer.n_envs
        if self._before is None or model is None or not model.deterministic:
            return None
        with one_thread():
            model.set_roots(list(self._before), np.arange(n_envs), self._agent.rollout_rng)
            step = model.step(self.planner.unscale(actions))
        self._agent.n_simulated_steps += n_envs
        self._before = None
        executed = SearchResult(
            actions=actions,
            chosen=np.where(step.valid, 0, -1),
            candidates=actions[:, None],
            values=np.zeros((n_envs, 1)),
            first_step=FirstStep(step.observations, step.rewards),
            simulated_steps=0,
            invalid_rollouts=0,
        )
        return self.planner.model_error(executed, range(n_envs), observations, rewards, infos)

    def put(self, row: int, dones: np.ndarray) -> None:
        """Store the states that the environments are in after a step.

        :param row: of the replay buffer that the step will be in.
        :param dones: ``[n_envs]``, whether the episode ended: the environment is in another one then.
        """
        self._buffer.expansion_states[row] = self._states(range(self._buffer.n_envs))
        self._buffer.expansion_held[row] = ~dones.astype(bool)

    def sample(self, n: int, gamma: float, rng: np.random.Generator, env: VecNormalize | None) -> Samples:
        """Draw transitions, and go on from them.

        :param n: how many.
        :param gamma: discount factor per step.
        :param rng: draws them.
        :param env: normalises observations and rewards.
        :return: as of a buffer of transitions over several steps. Those that ended an episode are as they
            were.
        """
        buffer = self._buffer
        at = rng.integers(0, buffer.size(), n), rng.integers(0, buffer.n_envs, n)
        outcome = _Outcome(
            np.array(buffer._normalize_reward(buffer.rewards[at], env), dtype=np.float64),
            np.ones(n, dtype=int),
            (buffer.dones[at] * (1 - buffer.timeouts[at])).astype(bool),
            map_arrays(itemgetter(at), buffer.next_observations),
        )
        going = np.flatnonzero(buffer.expansion_held[at])
        if len(going):
            states = buffer.expansion_states[at[0][going], at[1][going]]
            with one_thread():
                self._go_on(states, going, outcome, gamma, rng, env)
        return _as_samples(buffer, at, buffer.actions[at], outcome, gamma, env)

    def _go_on(
        self,
        states: np.ndarray,
        going: np.ndarray,
        outcome: _Outcome,
        gamma: float,
        rng: np.random.Generator,
        env: VecNormalize | None,
    ) -> None:
        """Simulate the target actor from some states.

        :param states: ``[m, state_size]``.
        :param going: ``[m]``, whose states these are.
        :param outcome: of all transitions; changed.
        """
        returns, lengths, terminated, last = outcome
        planner, model, buffer = self.planner, self.planner.model, self._buffer
        assert model is not None
        model.set_roots(list(states), np.arange(len(going)), rng)
        seen = buffer._normalize_obs(take_rows(last, going), env)
        act, unscale = self._acting(), unscale_function(self._agent)
        for number in range(1, self._agent.value_expansion + 1):
            actions, bonus = act(seen, rng)
            step = model.step(unscale(actions))
            self._agent.n_simulated_steps += len(going)
            valid = np.flatnonzero(step.valid)  # a simulation that diverged ends one step earlier
            at = going[valid]
            rewards = buffer._normalize_reward(step.rewards[valid], env) + bonus[valid]
            returns[at] += gamma**number * rewards
            terminated[at] = step.terminated[valid]
            lengths[at] += 1
            put_rows(last, at, planner.view.observe(step.observations, normalize=False), valid)
            still = np.flatnonzero(step.goes_on)
            if not len(still):
                return
            seen = take_rows(planner.view.observe(step.observations), still)
            if len(still) < len(going):
                model.select(still)
                going = going[still]


def _as_samples(
    buffer: Any,
    at: tuple[np.ndarray, ...],
    actions: np.ndarray,
    outcome: _Outcome,
    gamma: float,
    env: VecNormalize | None,
) -> Samples:
    """Make a batch, as replay buffers do.

    :param buffer: the replay buffer.
    :param at: rows and environments ``[n]`` where the transitions begin.
    :param actions: ``[n, act_dim]``, the first ones.
    :param outcome: ``[n]``.
    :param gamma: discount factor per step.
    :param env: normalises observations.
    :return: the batch, with discounts for the next observations' values.
    """
    first = buffer._normalize_obs(map_arrays(itemgetter(at), buffer.observations), env)
    last = buffer._normalize_obs(outcome.observations, env)
    samples = DictReplayBufferSamples if isinstance(first, dict) else ReplayBufferSamples
    return samples(
        map_arrays(buffer.to_torch, first),
        buffer.to_torch(actions),
        map_arrays(buffer.to_torch, last),
        buffer.to_torch(outcome.terminated.astype(np.float32)[:, None]),
        buffer.to_torch(outcome.returns.astype(np.float32)[:, None]),
        buffer.to_torch((gamma**outcome.lengths).astype(np.float32)[:, None]),
    )
