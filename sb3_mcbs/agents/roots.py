"""Where rollouts start: the environments' states, or observations for a learned model."""

import logging
import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_mcbs.agents.faults import check_observations
from sb3_mcbs.agents.learned_model import EnsembleSettings, LearnedModel
from sb3_mcbs.agents.observation_pipeline import (
    EnvironmentPipeline,
    ObservationPipeline,
    snapshot_environments,
)
from sb3_mcbs.models import ForwardModelError, make_forward_model
from sb3_mcbs.models.ensemble import EnsembleModel, Transitions
from sb3_mcbs.search import EpisodeClock, FirstStep, Roots, SearchResult, SearchSettings, check_dynamics
from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.types import ForwardModel, Observations, difference, equal, row_of, stack, take_rows

logger = logging.getLogger("sb3_mcbs")


class Prediction(NamedTuple):
    """A forward model's prediction for the executed actions.

    :param envs: indices of the environments.
    :param actions: ``[len(envs), act_dim]``, scaled.
    :param step: ``[len(envs)]``, the predicted step.
    """

    envs: Sequence[int]
    actions: np.ndarray
    step: FirstStep

    @classmethod
    def of(cls, result: SearchResult, envs: Sequence[int]) -> "Prediction | None":
        """The prediction of a search for its chosen actions.

        :param result: the search's result.
        :param envs: indices of the searched environments.
        :return: ``None`` if nothing was simulated.
        """
        if result.first_step is None:
            return None
        rows = np.flatnonzero(result.chosen >= 0)
        step = FirstStep(take_rows(result.first_step.observations, rows), result.first_step.rewards[rows])
        return cls([envs[row] for row in rows.tolist()], result.actions[rows], step)


class EnvironmentStep(NamedTuple):
    """One real step of the environments.

    :param observations: ``[n_envs, *]``, the agent's next observations.
    :param rewards: ``[n_envs]``, not normalised.
    :param infos: one per environment; it contains the last observation where an episode ended.
    """

    observations: Observations
    rewards: np.ndarray
    infos: list[dict[str, Any]]


class RootSource(ABC):
    """Reads where rollouts start, and holds the forward model.

    :ivar model: the forward model.
    :ivar view: turns simulated observations and rewards into those of the networks.
    :ivar settings: settings of the search.
    """

    model: ForwardModel
    view: ObservationPipeline
    settings: SearchSettings
    _previous_step_differed = False

    @property
    def ready(self) -> bool:
        """Whether the forward model may be used already."""
        return True

    @abstractmethod
    def capture_roots(self, observations: Observations, envs: Sequence[int]) -> Roots:
        """Read the environments' current states.

        :param observations: ``[n_envs, *]``, of all environments as the agent got them.
        :param envs: indices of environments, ascending.
        :raises ValueError: if the observations are not those of the current states.
        """

    @abstractmethod
    def episode_clocks(self, envs: Sequence[int]) -> list[EpisodeClock]:
        """Read the episode clocks of environments.

        :param envs: indices of environments.
        """

    @abstractmethod
    def error(self, prediction: Prediction, happened: EnvironmentStep) -> float | None:
        """Compare a prediction with what happened.

        :param prediction: for the executed actions.
        :param happened: the environments' step.
        :return: the error; ``None`` if the forward model is not deterministic.
        """

    def resync(self, error: float) -> None:  # noqa: B027
        """Update the forward model to the environments.

        :param error: of its last prediction.
        :raises ForwardModelError: if the requested forward model cannot simulate the changed environments.
        :raises ValueError: if the settings do not fit random dynamics.
        """

    @property
    def memory(self) -> dict[str, Any]:
        """What the source has learned about the environments, as plain values."""
        return {
            "kind": self.model.kind,
            "deterministic": self.model.deterministic,
            "previous_step_differed": self._previous_step_differed,
        }

    @memory.setter
    def memory(self, memory: dict[str, Any]) -> None:
        self._previous_step_differed = memory["previous_step_differed"]
        self._go_on_with(memory["kind"])
        self.model.deterministic = memory["deterministic"]

    def _go_on_with(self, kind: str) -> None:  # noqa: B027
        """Simulate with the kind of forward model that was there before."""


class ExactRoots(RootSource):
    """The states of the environments themselves.

    :param vec_env: the environments; those in this process are wrapped in place.
    :param settings: settings of the search.
    :param normalizer: the ``VecNormalize`` whose reward scale the critics learned, if any.
    :raises SnapshotUnsupportedError: if an environment's state cannot be captured.
    :raises ForwardModelError: if the requested forward model cannot simulate the environments.
    """

    def __init__(self, vec_env: VecEnv, settings: SearchSettings, normalizer: VecNormalize | None) -> None:
        self.view: EnvironmentPipeline = EnvironmentPipeline(vec_env, normalizer)
        self.environments = snapshot_environments(self.view.base)
        self.model = make_forward_model(self.environments, settings.forward_model, settings.n_threads)
        self.settings = settings

    def capture_roots(self, observations: Observations, envs: Sequence[int]) -> Roots:
        states = self.read_states(envs)
        return Roots(
            self.model, states, self._present_observations(take_rows(observations, np.asarray(envs)), envs)
        )

    def read_states(self, envs: Sequence[int]) -> list[Any]:
        """Read the environments' current states, also after they replaced their simulator.

        :param envs: indices of environments.
        """
        known = self.model.deterministic
        try:
            states = self.model.read_roots(envs)
        except ForwardModelError as reason:  # the environment replaced its simulator
            self._follow_environment(f"{reason} ")
            return self.model.read_roots(envs)
        if self.model.deterministic != known:  # environments that need reset options are probed only now
            check_dynamics(self.settings, self.model.deterministic)
        return states

    def _present_observations(self, observations: Observations, envs: Sequence[int]) -> Observations:
        """The environments' own observations, checked against those that the agent got."""
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
                "its own environments: EvalCallback(make_vec_env(...)), not "
                "EvalCallback(model.get_env()). If they were used for something else between two calls of "
                "learn, call set_env before the second."
            )
        return stacked

    def episode_clocks(self, envs: Sequence[int]) -> list[EpisodeClock]:
        return self.environments.apply(envs, _episode_clock)

    def error(self, prediction: Prediction, happened: EnvironmentStep) -> float | None:
        """The largest absolute difference in observations (as the networks see them) and rewards."""
        if not self.model.deterministic:
            return None
        envs, _, step = prediction
        predicted = self.view.observe(step.observations)
        error = 0.0
        for row, env in enumerate(envs):
            last = happened.infos[env].get("terminal_observation")
            if last is None:
                error = max(error, difference(row_of(predicted, row), row_of(happened.observations, env)))
            else:  # the environment's own last observation; the current one is of the next episode
                expected = self.view.observe_last(take_rows(step.observations, np.array([row])))
                error = max(error, difference(row_of(expected, 0), self.view.as_kept(last)))
            # Vectorized environments return rewards as float32.
            error = max(error, difference(np.float32(step.rewards[row]), np.float32(happened.rewards[env])))
        if not error:
            self._previous_step_differed = False
        return error

    def resync(self, error: float) -> None:
        """Adapt to environments that were edited, or are not deterministic.

        The forward model is refreshed first, then replaced by a pool, then treated as random.
        """
        self._follow_environment(f"The forward model's prediction differs from reality by {error:.3g}. ")
        self._previous_step_differed = True

    def _follow_environment(self, message: str) -> None:
        if self.model.kind == "pool":
            self.model.deterministic = False
            _warn(
                message + "So it draws random numbers in some states, or part of its state is not captured. "
                "Every simulation now draws its own randomness."
            )
            check_dynamics(self.settings, deterministic=False)
            return
        if not self._previous_step_differed:
            try:
                self.model.refresh()
                _warn(message + "It was edited; the forward model was rebuilt from its current values.")
                return
            except ForwardModelError as reason:
                message += f"{reason} "
        if self.settings.forward_model != "auto":
            raise ForwardModelError(
                message + "forward_model='pool' copies whole environments and can simulate them."
            )
        self._simulate_with("pool")
        _warn(message + f"Now simulating with: {self.model.description}.")
        check_dynamics(self.settings, self.model.deterministic)

    def _simulate_with(self, kind: str) -> None:
        self.model.close()
        self.model = make_forward_model(self.environments, kind, self.settings.n_threads)

    def _go_on_with(self, kind: str) -> None:
        if self.model.kind != kind:
            self._simulate_with(kind)
        elif self.model.kind != "pool":
            self.model.refresh()  # the environments' simulators have other values than when it was made


class LearnedRoots(RootSource):
    """The agent's observations, from which its learned model simulates.

    The environments may be of any kind: they are neither wrapped nor copied. The cross-entropy method has no
    warm start, since observations do not tell which steps were taken since the last decision.

    :param agent: an agent that learns a model, or has learned one.
    :param vec_env: the environments.
    :param settings: settings of the search.
    :param normalizer: the ``VecNormalize`` whose reward scale the critics learned, if any.
    :raises ValueError: if the agent has no learned model.
    """

    def __init__(
        self,
        agent: Any,
        vec_env: VecEnv,
        settings: SearchSettings,
        normalizer: VecNormalize | None,
    ) -> None:
        self._agent = agent
        self.settings = settings
        self.view = ObservationPipeline(vec_env, normalizer)
        self.model: EnsembleModel = EnsembleModel(
            self._learned.ensemble,
            agent.observation_space,
            agent.action_space,
            self._ensemble_settings.ensemble_pessimism,
        )
        self._originals: Observations | None = None
        self._n_searches = 0
        self._said_not_ready = False

    @property
    def _learned(self) -> LearnedModel:
        learned = getattr(self._agent, "learned_model", None)
        if learned is None:
            raise ValueError(
                f"This {type(self._agent).__name__} has no learned model to search with: train it with "
                "forward_model='ensemble', load it with its class's own load (load_agent reads no learned "
                "model), or choose another forward_model."
            )
        return learned

    @property
    def _ensemble_settings(self) -> EnsembleSettings:
        return EnsembleSettings.of(self._agent)

    @property
    def ready(self) -> bool:
        return self._learned.ensemble.held_out_error <= self._ensemble_settings.ensemble_max_error

    def capture_roots(self, observations: Observations, envs: Sequence[int]) -> Roots:
        self.model.ensemble = self._learned.ensemble
        self.model.pessimism = self._ensemble_settings.ensemble_pessimism
        if not self.ready and not self._said_not_ready:
            self._said_not_ready = True
            logger.warning(
                "The learned model is not used yet: its held-out error is %.3g, above "
                "ensemble_max_error=%.3g. The policy acts alone.",
                self._learned.ensemble.held_out_error,
                self._ensemble_settings.ensemble_max_error,
            )
        self._n_searches += 1
        self._originals = take_rows(self.view.original(observations), slice(None))
        seen = take_rows(self._originals, np.asarray(envs))
        assert isinstance(seen, np.ndarray)
        return Roots(self.model, list(seen), seen)

    def episode_clocks(self, envs: Sequence[int]) -> list[EpisodeClock]:
        # Never the same clock twice, so no plan is recalled.
        return [(self._n_searches, 0)] * len(envs)

    def error(self, prediction: Prediction, happened: EnvironmentStep) -> float | None:
        """The error of the predicted step, measured like the held-out error."""
        envs = np.asarray(prediction.envs)
        if not len(envs):
            return None
        before, after = self._originals, self.view.original(happened.observations)
        assert isinstance(before, np.ndarray) and isinstance(after, np.ndarray)
        after = after.copy()
        for env in envs.tolist():
            last = happened.infos[env].get("terminal_observation")
            if last is not None:
                after[env] = self.view.unnormalize(last)
        n_rows = len(envs)
        return self.model.ensemble.error(
            Transitions(
                before[envs].reshape(n_rows, -1),
                prediction.actions,
                after[envs].reshape(n_rows, -1),
                happened.rewards[envs],
                np.zeros(n_rows),
            )
        )


def _warn(message: str) -> None:
    logger.warning(message)
    warnings.warn(message, stacklevel=4)


def _last_observation(env: SnapshotEnvWrapper) -> Any:
    return env.last_observation


def _episode_clock(env: SnapshotEnvWrapper) -> EpisodeClock:
    return env.episode_clock
