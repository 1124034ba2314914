"""Combines an agent's networks, its environments and a forward model into a search."""

import logging
import os
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_mcbs.agents.compiled_policy import CompiledPolicy, way
from sb3_mcbs.agents.faults import InvalidDecisions, check_networks, is_finite
from sb3_mcbs.agents.observation_pipeline import reward_normalizer
from sb3_mcbs.agents.roots import EnvironmentStep, ExactRoots, LearnedRoots, Prediction, RootSource
from sb3_mcbs.models import ForwardModelError
from sb3_mcbs.networks.functions import check_agent, policy_function, unscale_function, value_function
from sb3_mcbs.networks.torch_settings import go_on_in_process, matmul_precision, one_thread
from sb3_mcbs.search import (
    BeamSettings,
    CEMSettings,
    EpisodeClock,
    FirstStep,
    LatencyForecast,
    PolicyFunctions,
    RecentActions,
    Roots,
    SearchResult,
    SearchSettings,
    WarmStart,
    check_dynamics,
    deadline_search,
    policy_alone,
    search,
)
from sb3_mcbs.types import ForwardModel, Observations, n_rows, take_rows

logger = logging.getLogger("sb3_mcbs")


class Planner:
    """Searches for an agent's actions from the current states of its environments.

    :meth:`plan` chooses actions, :meth:`verify` compares the search's prediction with what happened, and
    :meth:`resync` updates the forward model if they differ.

    A copy makes its forward model at its first use: during unpickling, related objects are incomplete, and
    ``VecNormalize`` has no environments.

    :param agent: a TD3, DDPG, SAC, TQC or CrossQ agent.
    :param vec_env: the environments; those in this process are wrapped in place.
    :param settings: settings of the search.
    :param normalize_reward: see :class:`~sb3_mcbs.SearchPolicy`.
    :param recent_actions: the agent's executed actions, for ``proposal_dims``; ``None``: none yet.
    :raises SnapshotUnsupportedError: if an environment's state cannot be captured.
    :raises ForwardModelError: if the requested forward model cannot simulate the environments.
    :raises ValueError: if the settings do not fit the agent, its actions or the environments' random
        dynamics.
    """

    #: The last line of the log about rollouts.
    _said = ""

    def __init__(
        self,
        agent: OffPolicyAlgorithm,
        vec_env: VecEnv,
        settings: SearchSettings,
        normalize_reward: bool | None = None,
        recent_actions: RecentActions | None = None,
    ) -> None:
        check_agent(agent)
        self._process = os.getpid()
        self.agent, self._vec_env, self.normalize_reward = agent, vec_env, normalize_reward
        self.settings = settings
        self._act_dim = get_action_dim(agent.action_space)
        self._all_envs = range(vec_env.num_envs)
        self.recent_actions = RecentActions(self._act_dim) if recent_actions is None else recent_actions
        self._invalid_decisions = InvalidDecisions()
        #: One per number of environments and depth, since rounds take longer with more.
        self._forecasts: defaultdict[tuple[int, int], LatencyForecast] = defaultdict(LatencyForecast)
        self._check(settings)
        self._source = self._make_source(settings)
        #: The memory of a source that is not made yet.
        self._remembered: dict[str, Any] | None = None
        if self._source is not None:
            check_dynamics(settings, self._source.model.deterministic)
        self._warm_start = self._make_warm_start(settings)

    @property
    def source(self) -> RootSource | None:
        """Where rollouts start; ``None`` if nothing is simulated."""
        if self._source is None and self._remembered is not None:
            self._source = self._make_source(self.settings)
            assert self._source is not None
            self._source.memory = self._remembered
            self._remembered = None
        return self._source

    @property
    def model(self) -> ForwardModel | None:
        """The forward model; ``None`` if nothing is simulated."""
        return None if self.source is None else self.source.model

    @property
    def ready(self) -> bool:
        """Whether the forward model may be used already."""
        return self.source is None or self.source.ready

    @property
    def description(self) -> str:
        """One line that names the forward model and, where that is the batch, says how rollouts go."""
        if self.model is None:
            return "none: the critics rank the candidates"
        if self.model.kind != "mujoco":
            return self.model.description
        try:
            self.compiled_policy()
            reason = self.settings.why_by_steps
        except TypeError as error:
            reason = str(error)
        return f"{self.model.description}; rollouts {way(reason)}"

    def plan(
        self,
        observations: Observations,
        rng: np.random.Generator,
        envs: Sequence[int] | None = None,
        settings: SearchSettings | None = None,
    ) -> SearchResult:
        """Choose an action for every environment, or for some.

        :param observations: ``[n_envs, *]``, the environments' current observations as the agent got them.
        :param rng: draws the noise, and is given to a model with random dynamics.
        :param envs: indices of environments, ascending; the others are not read or simulated. ``None``: all.
        :param settings: settings of this decision, with another width or depth. ``None``: :attr:`settings`.
        :return: actions and details of the search, a row for each of ``envs``.
        :raises ValueError: if the observations are not those of the environments' current states.
        :raises NonFiniteError: if the networks' outputs, or the observations, are not finite.
        """
        start = time.perf_counter()
        self.go_on_here()
        if self.agent.policy.training:
            self.agent.policy.set_training_mode(False)
        settings, envs = settings or self.settings, self._all_envs if envs is None else envs
        roots, functions = self.capture_roots(observations, envs), self.functions()
        if not self.ready:
            return policy_alone(functions.policy(roots.observations))
        dims = settings.proposal_dims
        directions = None if dims is None else self.recent_actions.directions(dims)
        with one_thread(), matmul_precision(settings.matmul_precision):
            if not isinstance(settings, BeamSettings) or settings.time_budget is None:
                if self._warm_start is None:
                    result = search(roots, functions, settings, rng, directions)
                else:
                    clocks = self._clocks(envs)
                    plans = self._warm_start.recall(envs, clocks, settings.noise_hold)
                    result = search(roots, functions, settings, rng, directions, plans)
                    assert result.plans is not None
                    self._warm_start.keep(result.plans, envs, clocks)
            else:
                deadline = start + settings.time_budget
                forecast = self._forecasts[n_rows(roots.observations), settings.rollout_depth]
                result = deadline_search(roots, functions, settings, deadline, forecast, rng, directions)
        if result.invalid_rollouts or not is_finite(result.actions):
            check_networks(functions.policy, functions.value, roots.observations)
        self._invalid_decisions.note(result, self.model)
        return result

    def capture_roots(self, observations: Observations, envs: Sequence[int]) -> Roots:
        """Read the states where rollouts start.

        :param observations: ``[n_envs, *]``, of all environments as the agent got them.
        :param envs: indices of environments, ascending.
        :raises ValueError: if the observations are not those of the environments' current states.
        """
        if self.source is None:
            return Roots(None, [], take_rows(observations, np.asarray(envs)))
        return self.source.capture_roots(observations, envs)

    def read_states(self) -> list[Any]:
        """Read the current states of all environments.

        :raises ForwardModelError: if the forward model does not simulate from states of environments.
        """
        if not isinstance(self.source, ExactRoots):
            raise ForwardModelError(
                f"States of environments cannot be read; the forward model is: {self.description}"
            )
        return self.source.read_states(self._all_envs)

    def predict(self, states: list[Any], actions: np.ndarray, rng: np.random.Generator) -> Prediction | None:
        """Simulate one step of all environments.

        :param states: from :meth:`read_states`.
        :param actions: ``[n_envs, act_dim]``, scaled.
        :param rng: given to a model with random dynamics.
        :return: the predicted step of environments whose simulation does not diverge; ``None`` without a
            deterministic forward model.
        """
        model = self.model
        if model is None or not model.deterministic:
            return None
        with one_thread():
            model.set_roots(states, np.arange(len(states)), rng)
            step = model.step(self.unscale(actions))
        valid = np.flatnonzero(step.valid)
        first_step = FirstStep(take_rows(step.observations, valid), step.rewards[valid])
        return Prediction(valid.tolist(), actions[valid], first_step)

    def verify(self, prediction: Prediction, happened: EnvironmentStep) -> float | None:
        """Compare the prediction for the executed actions with what happened.

        In a deterministic environment a difference means that it was edited, or that it is not deterministic;
        then call :meth:`resync`.

        :param prediction: for the executed actions.
        :param happened: the environments' step.
        :return: the largest absolute difference in observations (as the networks see them) and rewards, or a
            learned model's error; ``None`` if the forward model does not claim to be deterministic.
        """
        return None if self.source is None else self.source.error(prediction, happened)

    def resync(self, error: float) -> None:
        """Update the forward model to the environments; a learned one adapts by itself.

        :param error: from :meth:`verify`.
        :raises ForwardModelError: if the requested forward model cannot simulate the changed environments.
        :raises ValueError: if the settings do not fit random dynamics.
        """
        if self.source is not None:
            self.source.resync(error)

    def follow(self, settings: SearchSettings) -> bool:
        """Use other settings from the next decision on.

        :param settings: the new settings.
        :return: whether the forward model was replaced.
        :raises ValueError: if they do not fit the agent, its actions or the environments' dynamics. Nothing
            has changed then.
        """
        if settings == self.settings:
            return False
        self._check(settings)
        exchanged = _forward_model_settings(settings) != _forward_model_settings(self.settings)
        before = source = self.source if exchanged else self._source
        if exchanged:
            source = self._make_source(settings)
            if source is not None and before is not None and source.model.kind == before.model.kind:
                source.model.deterministic &= before.model.deterministic
        if source is not None:
            try:
                check_dynamics(settings, source.model.deterministic)
            except ValueError:
                if exchanged:
                    source.model.close()
                raise
            source.settings = settings
        self._warm_start = self._make_warm_start(settings)
        self.settings, self._source = settings, source
        if exchanged and before is not None:
            before.model.close()
        return exchanged

    def normalize_rewards(self, normalize: bool) -> None:
        """Adapt to a ``VecNormalize`` whose ``norm_reward`` was changed.

        :param normalize: whether the critics learn from normalised rewards.
        """
        if normalize != self.normalize_reward and self.source is not None:
            self.normalize_reward = normalize
            self.source.view.reward_normalizer = self._reward_normalizer()

    def check_networks(self, observations: Observations) -> None:
        """Check whether the networks have diverged.

        :param observations: ``[n_envs, *]``, as the agent got them.
        :raises NonFiniteError: if the networks' outputs, or the observations, are not finite.
        """
        check_networks(policy_function(self.agent), value_function(self.agent), observations)

    def remember_actions(self, actions: np.ndarray) -> None:
        """Remember executed actions, if the search learns directions from them.

        :param actions: ``[n, *]``, scaled.
        """
        if self.settings.proposal_dims is not None:
            self.recent_actions.note(actions.reshape(len(actions), -1))

    @property
    def memory(self) -> dict[str, Any]:
        """What the planner has learned about the environments, as plain values: part of exact checkpoints."""
        source = self.source
        noticed = {"kind": None, "deterministic": None, "previous_step_differed": False}
        return {
            **(noticed if source is None else source.memory),
            "plans": None if self._warm_start is None else self._warm_start.state(self._clocks()),
            "recent_actions": None if self.settings.proposal_dims is None else self.recent_actions.state(),
        }

    @memory.setter
    def memory(self, memory: dict[str, Any]) -> None:
        if memory.get("recent_actions") is not None:
            self.recent_actions.set_state(memory["recent_actions"])
        if self.source is None:
            return
        if self._warm_start is not None and memory.get("plans") is not None:
            self._warm_start.set_state(memory["plans"], self._clocks())
        self.source.memory = memory

    def functions(self) -> PolicyFunctions:
        """The agent's current networks as functions of simulated observations."""
        unscale, gamma = unscale_function(self.agent), self.agent.gamma
        if self.source is None:
            policy, value = policy_function(self.agent), value_function(self.agent)
            return PolicyFunctions(policy, value, gamma, unscale, lambda rewards: rewards, self._act_dim)
        try:
            compiled = self.compiled_policy()
        except TypeError as reason:
            self._say(f"Rollouts {way(str(reason))}.")
            return self._plain_functions(unscale)
        self._say(f"Rollouts {way(self.settings.why_by_steps)}.")
        return PolicyFunctions(
            compiled.policy,
            compiled.value,
            gamma,
            unscale,
            self.source.view.scale_reward,
            self._act_dim,
            compiled.rollout,
        )

    def compiled_policy(self, target: bool = False) -> CompiledPolicy:
        """The agent's current networks in compiled code.

        :param target: the target actor, if there is one.
        :raises TypeError: says what compiled code does not cover.
        """
        assert self.source is not None
        return CompiledPolicy(self.agent, self.source.model, self.source.view, target)

    def _plain_functions(self, unscale: Callable[[np.ndarray], np.ndarray]) -> PolicyFunctions:
        assert self.source is not None
        policy, value, view = policy_function(self.agent), value_function(self.agent), self.source.view
        return PolicyFunctions(
            policy=lambda observations: policy(view.observe(observations)),
            value=lambda observations, actions: value(view.observe(observations), actions),
            gamma=self.agent.gamma,
            unscale_action=unscale,
            scale_reward=view.scale_reward,
            act_dim=self._act_dim,
        )

    def _say(self, message: str) -> None:
        if message != self._said:
            self._said = message
            logger.info(message)

    def unscale(self, actions: np.ndarray) -> np.ndarray:
        """Turn scaled actions into actions of the environment.

        :param actions: ``[rows, act_dim]`` in [-1, 1].
        :return: ``[rows, *act_shape]``.
        """
        return unscale_function(self.agent)(actions)

    def close(self) -> None:
        """Release the forward model."""
        if self._source is not None:
            self._source.model.close()

    def go_on_here(self) -> None:
        """Detect a fork of the process since this object was made."""
        self._process = go_on_in_process(self._process)

    def _check(self, settings: SearchSettings) -> None:
        if (settings.proposal_dims or 0) > self._act_dim:
            raise ValueError(
                f"proposal_dims must be at most {self._act_dim}, the entries of an action here; got "
                f"{settings.proposal_dims}."
            )

    def _make_source(self, settings: SearchSettings) -> RootSource | None:
        if settings.rollout_depth == 0:
            return None
        normalizer = self._reward_normalizer()
        # A copy makes its source later, when the environments may have changed.
        self.normalize_reward = normalizer is not None
        if settings.forward_model == "ensemble":
            return LearnedRoots(self.agent, self._vec_env, settings, normalizer)
        return ExactRoots(self._vec_env, settings, normalizer)

    def _reward_normalizer(self) -> VecNormalize | None:
        return reward_normalizer(self.agent.get_env(), self._vec_env, self.normalize_reward)

    def _make_warm_start(self, settings: SearchSettings) -> WarmStart | None:
        if not isinstance(settings, CEMSettings):
            return None
        known = vars(self).get("_warm_start")
        if known is not None and settings.horizon == self.settings.horizon:
            return known
        return WarmStart(self._vec_env.num_envs, settings.horizon, self._act_dim)

    def _clocks(self, envs: Sequence[int] | None = None) -> list[EpisodeClock]:
        assert self.source is not None
        return self.source.episode_clocks(self._all_envs if envs is None else envs)

    def __getstate__(self) -> dict[str, Any]:
        self.go_on_here()
        state = {**vars(self), "_source": None}
        if self._source is not None:
            state["_remembered"] = self._source.memory
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._process = os.getpid()


def _forward_model_settings(settings: SearchSettings) -> tuple[Any, ...]:
    """The settings that determine the forward model."""
    return settings.forward_model, settings.n_threads, settings.rollout_depth > 0
