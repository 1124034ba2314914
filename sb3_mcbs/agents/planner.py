"""Joins an agent's networks, the environments it acts in and a forward model to a search."""

import logging
import time
import warnings
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_mcbs.agents.faults import InvalidDecisions, check_networks, check_observations, is_finite
from sb3_mcbs.agents.observation_pipeline import (
    EnvironmentPipeline,
    ObservationPipeline,
    reward_normalizer,
    snapshot_environments,
)
from sb3_mcbs.agents.own_environments import InOwnEnvironments
from sb3_mcbs.models import Environments, ForwardModelError, make_forward_model
from sb3_mcbs.networks.functions import (
    check_agent,
    policy_function,
    unscale_function,
    value_function,
)
from sb3_mcbs.networks.torch_settings import matmul_precision, one_thread
from sb3_mcbs.search import (
    BeamSettings,
    CEMSettings,
    Decision,
    EpisodeClock,
    LatencyForecast,
    PolicyFunctions,
    RecentActions,
    SearchResult,
    SearchSettings,
    WarmStart,
    check_dynamics,
    deadline_search,
    search,
)
from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.types import Observations, difference, equal, n_rows, row_of, stack, take_rows

logger = logging.getLogger("sb3_mcbs")


class Planner(InOwnEnvironments):
    """Searches for an agent from the present states of the environments that it acts in.

    :param agent: a TD3, DDPG, SAC or TQC agent.
    :param vec_env: the environments; those in this process are wrapped in place.
    :param settings: settings of the search.
    :param normalize_reward: see :class:`~sb3_mcbs.SearchPolicy`.
    :param recent_actions: what the agent executed, for ``proposal_dims``; ``None``: nothing yet.
    :raises SnapshotUnsupportedError: if an environment's state cannot be captured.
    :raises ForwardModelError: if the requested forward model cannot simulate the environments.
    :raises ValueError: if the settings make no sense with the agent, its actions or the environments' random
        dynamics.
    """

    def __init__(
        self,
        agent: OffPolicyAlgorithm,
        vec_env: VecEnv,
        settings: SearchSettings,
        normalize_reward: bool | None = None,
        recent_actions: RecentActions | None = None,
    ) -> None:
        super().__init__()
        check_agent(agent)
        self.agent, self._vec_env, self.normalize_reward = agent, vec_env, normalize_reward
        self.settings = settings
        self._act_dim = get_action_dim(agent.action_space)
        self._check(settings)
        self.recent_actions = RecentActions(self._act_dim) if recent_actions is None else recent_actions
        self.model = None
        self._previous_step_differed = False
        self._invalid_decisions = InvalidDecisions()
        #: Rounds of other sizes take other times.
        self._paces: defaultdict[tuple[int, int], LatencyForecast] = defaultdict(LatencyForecast)
        self._plans: WarmStart | None = None
        self.view: ObservationPipeline
        if settings.rollout_depth > 0:
            self._connect()
            # What it was found out from may have changed when a copy connects.
            self.normalize_reward = self.view.reward_normalizer is not None
        self._take_over(settings)

    def _check(self, settings: SearchSettings) -> None:
        if (settings.proposal_dims or 0) > self._act_dim:
            raise ValueError(
                f"proposal_dims must be at most {self._act_dim}, the entries of an action here; got "
                f"{settings.proposal_dims}."
            )

    def follow(self, settings: SearchSettings) -> bool:
        """Search with other settings from the next decision on.

        :param settings: the settings.
        :return: False if another forward model is to simulate; nothing has changed then.
        :raises ValueError: if they make no sense with the agent, its actions or the environments' dynamics.
        """
        if settings == self.settings:
            return True
        self._check(settings)
        if _simulators_settings(settings) != _simulators_settings(self.settings):
            return False
        self._take_over(settings)
        return True

    def normalize_rewards(self, normalize: bool) -> None:
        """Follow a ``VecNormalize`` whose ``norm_reward`` was switched.

        :param normalize: whether the critics learn from normalised rewards.
        """
        if normalize != self.normalize_reward and self.model is not None:
            self.normalize_reward = normalize
            self.view.reward_normalizer = self._reward_normalizer()

    def _take_over(self, settings: SearchSettings) -> None:
        model = vars(self).get("model")  # a copy without environments has none yet
        if model is not None:
            check_dynamics(settings, model.deterministic)
        plans = self._plans
        if not isinstance(settings, CEMSettings):
            plans = None
        elif plans is None or settings.horizon != self.settings.horizon:
            plans = WarmStart(self._vec_env.num_envs, settings.horizon, self._act_dim)
        self.settings, self._plans = settings, plans

    def go_on_after(self, before: "Planner") -> None:
        """Know what another one noticed about the same environments.

        :param before: what searched with other settings.
        """
        self._invalid_decisions, self._paces = before._invalid_decisions, before._paces
        if self.model is not None and before.model is not None and self.model.kind == before.model.kind:
            self.model.deterministic &= before.model.deterministic
            check_dynamics(self.settings, self.model.deterministic)

    def _connect(self) -> None:
        settings = self.settings
        view = EnvironmentPipeline(self._vec_env, self._reward_normalizer())
        self.view = view
        self.environments: Environments = snapshot_environments(view.base)
        self._all_envs = range(len(self.environments))
        self.model = make_forward_model(self.environments, settings.forward_model, settings.n_threads)

    def _reward_normalizer(self) -> VecNormalize | None:
        return reward_normalizer(self.agent.get_env(), self._vec_env, self.normalize_reward)

    @property
    def ready(self) -> bool:
        """Whether the forward model may be used already."""
        return True

    @property
    def description(self) -> str:
        """One line that says what simulates."""
        return "none: the critics rank the candidates" if self.model is None else self.model.description

    def search(
        self,
        observations: Observations,
        rng: np.random.Generator,
        envs: Sequence[int] | None = None,
        effort: SearchSettings | None = None,
    ) -> SearchResult:
        """Choose an action for every environment, or for some.

        :param observations: ``[n_envs, *]``, the environments' present observations as the agent got them.
        :param rng: the search's own generator.
        :param envs: which environments, rising; nothing is read of the others, or simulated for them.
            ``None``: all.
        :param effort: the settings with another width or depth, if they are not to be those of always.
        :return: actions, and what the search found, a row for each of ``envs``.
        :raises ValueError: if the observations are not those of the environments' present states.
        :raises NonFiniteError: if the networks, or the observations, are not finite.
        """
        start = time.perf_counter()
        self.go_on_here()
        if self.agent.policy.training:
            self.agent.policy.set_training_mode(False)
        roots: list[Any] = []
        if self.model is not None:
            envs = self._all_envs if envs is None else envs
            roots, observations = self.capture_roots(observations, envs)
        elif envs is not None:
            observations = take_rows(observations, np.asarray(envs))
        agent, settings = self.agent_functions(), effort or self.settings
        dims = settings.proposal_dims
        directions = None if dims is None else self.recent_actions.directions(dims)
        with one_thread(), matmul_precision(settings.matmul_precision):
            if not isinstance(settings, BeamSettings) or settings.time_budget is None:
                shape = (n_rows(observations), self._act_dim)
                decision = Decision(self.model, roots, observations, agent, settings, shape, rng)
                decision = decision._replace(directions=directions)
                if self._plans is not None:
                    assert envs is not None
                    decision = decision._replace(
                        memory=self._plans, envs=envs, clocks=self._episode_clocks(envs)
                    )
                result = search(decision)
            else:
                assert self.model is not None
                deadline = start + settings.time_budget
                pace = self._paces[n_rows(observations), settings.rollout_depth]
                result = deadline_search(
                    self.model, roots, observations, agent, settings, deadline, pace, rng, directions
                )
        if result.invalid_rollouts or not is_finite(result.actions):
            check_networks(agent.policy, agent.value, observations)
        self._invalid_decisions.note(result, self.model)
        return result

    def check_networks(self, observations: Observations) -> None:
        """Find out whether the networks have diverged.

        :param observations: ``[n_envs, *]``, as the agent got them.
        :raises NonFiniteError: if it is the networks, or the observations, that are not finite.
        """
        check_networks(policy_function(self.agent), value_function(self.agent), observations)

    def note_actions(self, actions: np.ndarray) -> None:
        """Remember what is executed, if the search learns directions from it.

        :param actions: ``[n, *]``, scaled.
        """
        if self.settings.proposal_dims is not None:
            self.recent_actions.note(actions.reshape(len(actions), -1))

    def model_error(
        self,
        result: SearchResult,
        envs: Sequence[int],
        observations: Observations,
        rewards: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> float | None:
        """Compare what the search predicted for the executed actions with what happened.

        A difference in a deterministic environment means that it was edited, or that it is not
        deterministic after all: the forward model is refreshed, then replaced, then told so.

        :param result: the decision whose actions were executed.
        :param envs: the environments that were searched.
        :param observations: ``[n_envs, *]``, what the agent received next.
        :param rewards: ``[n_envs]``, of the environments, not normalised.
        :param infos: one per environment; where an episode ended the last observation is in it.
        :return: the largest absolute difference in observations (as the networks see them) and rewards, or
            ``None`` if the forward model does not claim to be deterministic or nothing was simulated.
        """
        if self.model is None or not self.model.deterministic or result.first_step is None:
            return None
        view = self.view
        assert isinstance(view, EnvironmentPipeline)
        predicted = view.observe(result.first_step.observations)
        error = 0.0
        for row in np.flatnonzero(result.chosen >= 0).tolist():
            env = envs[row]
            last = infos[env].get("terminal_observation")
            if last is None:
                error = max(error, difference(row_of(predicted, row), row_of(observations, env)))
            else:  # as the environment returned it, which the others no longer are
                expected = view.observe_last(take_rows(result.first_step.observations, np.array([row])))
                error = max(error, difference(row_of(expected, 0), view.as_kept(last)))
            # A vectorized environment hands rewards on as float32.
            error = max(
                error, difference(np.float32(result.first_step.rewards[row]), np.float32(rewards[env]))
            )
        if error > 0:
            self._follow_environment(f"The forward model's prediction differs from reality by {error:.3g}. ")
        self._previous_step_differed = error > 0
        return error

    @property
    def memory(self) -> dict[str, Any]:
        """What was noticed about the environments, as plain values: part of exact checkpoints."""
        model = self.model
        return {
            "kind": None if model is None else model.kind,
            "deterministic": None if model is None else model.deterministic,
            "previous_step_differed": self._previous_step_differed,
            "plans": None if self._plans is None else self._plans.state(self._episode_clocks(self._all_envs)),
            "recent_actions": None if self.settings.proposal_dims is None else self.recent_actions.state(),
        }

    @memory.setter
    def memory(self, memory: dict[str, Any]) -> None:
        self._previous_step_differed = memory["previous_step_differed"]
        if memory.get("recent_actions") is not None:
            self.recent_actions.set_state(memory["recent_actions"])
        if self.model is None:
            return
        if self._plans is not None and memory.get("plans") is not None:
            self._plans.set_state(memory["plans"], self._episode_clocks(self._all_envs))
        self._go_on_with(memory["kind"], memory["deterministic"])

    def _go_on_with(self, kind: str, deterministic: bool) -> None:
        assert self.model is not None
        if self.model.kind != kind:
            self.model.close()
            self.model = make_forward_model(self.environments, kind, self.settings.n_threads)
        elif self.model.kind != "pool":
            self.model.refresh()  # the environments' simulators have other values than when it was made
        self.model.deterministic = deterministic

    def agent_functions(self) -> PolicyFunctions:
        """The agent as it is now, as a search knows it: functions of the environments' own observations."""
        policy, gamma = policy_function(self.agent), self.agent.gamma
        value, unscale = value_function(self.agent), unscale_function(self.agent)
        if self.model is None:
            return PolicyFunctions(policy, value, gamma, unscale, lambda rewards: rewards)
        observe = self.view.observe
        return PolicyFunctions(
            policy=lambda observations: policy(observe(observations)),
            value=lambda observations, actions: value(observe(observations), actions),
            gamma=gamma,
            unscale_action=unscale,
            scale_reward=self.view.scale_reward,
        )

    def unscale(self, actions: np.ndarray) -> np.ndarray:
        """Turn scaled actions into actions of the environment.

        :param actions: ``[rows, act_dim]`` in [-1, 1].
        :return: ``[rows, *act_shape]``.
        """
        return unscale_function(self.agent)(actions)

    def capture_roots(
        self, observations: Observations, envs: Sequence[int]
    ) -> tuple[list[Any], Observations]:
        """Where the rollouts start: roots, and the observations there as the forward model has them.

        :param observations: ``[n_envs, *]``, of all environments as the agent was given them.
        :param envs: which environments.
        """
        roots = self.read_roots(envs)
        return roots, self._present_observations(take_rows(observations, np.asarray(envs)), envs)

    def _present_observations(self, observations: Observations, envs: Sequence[int]) -> Observations:
        """The environments' own observations, checked against those that the agent was given."""
        assert isinstance(self.view, EnvironmentPipeline)
        present = self.environments.apply(envs, _last_observation)
        for row, observation in enumerate(present):
            if observation is None:
                present[row] = self.view.buffered_observation(envs[row])
        if any(observation is None for observation in present):
            raise ValueError("Reset the vectorized environment before the first search.")
        stacked = stack(present)
        if not equal(self.view.observe(stacked), observations):
            check_observations(stacked)  # NaN is not equal to itself
            raise ValueError(
                "The observations to act on are not those of the environments' present states. A search "
                "plans from the environments it was given: act in those, step them only through their "
                "SnapshotEnvWrapper, and keep wrappers that alter observations inside it. A callback needs "
                "environments of its own: EvalCallback(make_vec_env(...)), not "
                "EvalCallback(model.get_env()). If they were used for something else between two calls of "
                "learn, call set_env before the second."
            )
        return stacked

    def _episode_clocks(self, envs: Sequence[int]) -> list[EpisodeClock]:
        return self.environments.apply(envs, _episode_clock)

    def read_roots(self, envs: Sequence[int]) -> list[Any]:
        """Read the environments' present states, also where the simulator was exchanged.

        :param envs: which environments.
        """
        assert self.model is not None
        known = self.model.deterministic
        try:
            roots = self.model.read_roots(envs)
        except ForwardModelError as reason:  # the environment exchanged its simulator
            self._follow_environment(f"{reason} ")
            return self.model.read_roots(envs)
        if self.model.deterministic != known:  # what needs a reset with options shows only after it
            check_dynamics(self.settings, self.model.deterministic)
        return roots

    def _follow_environment(self, message: str) -> None:
        """Make the forward model what the environments are now.

        :param message: what was noticed, for the warning.
        :raises ForwardModelError: if the forward model that was asked for cannot follow.
        :raises ValueError: if the settings make no sense with random dynamics.
        """
        assert self.model is not None
        if self.model.kind == "pool":
            self.model.deterministic = False
            self._warn(
                message + "So it draws random numbers in some states, or part of its state is not captured. "
                "Every simulation now draws its own randomness."
            )
            check_dynamics(self.settings, deterministic=False)
            return
        if not self._previous_step_differed:
            try:
                self.model.refresh()
                self._warn(message + "It was edited; the forward model was rebuilt from its present values.")
                return
            except ForwardModelError as reason:
                message += f"{reason} "
        if self.settings.forward_model != "auto":
            raise ForwardModelError(
                message + "forward_model='pool' copies whole environments and can follow."
            )
        self.model.close()
        self.model = make_forward_model(self.environments, "pool", self.settings.n_threads)
        self._warn(message + f"Now simulating with: {self.model.description}.")
        check_dynamics(self.settings, self.model.deterministic)

    @staticmethod
    def _warn(message: str) -> None:
        logger.warning(message)
        warnings.warn(message, stacklevel=4)


def _simulators_settings(settings: SearchSettings) -> tuple[Any, ...]:
    """What the forward model is made with."""
    return settings.forward_model, settings.n_threads, settings.rollout_depth > 0


def _last_observation(env: SnapshotEnvWrapper) -> Any:
    return env.last_observation


def _episode_clock(env: SnapshotEnvWrapper) -> EpisodeClock:
    return env.episode_clock
