"""Searching with a model that the agent has learned: nothing is read from the environments."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_mcbs.agents.learned_model import EnsembleSettings, LearnedModel
from sb3_mcbs.agents.observation_pipeline import ObservationPipeline
from sb3_mcbs.agents.planner import Planner
from sb3_mcbs.models.ensemble import Transitions
from sb3_mcbs.models.ensemble_model import EnsembleModel
from sb3_mcbs.search import EpisodeClock, RecentActions, SearchResult, SearchSettings
from sb3_mcbs.types import Observations, take_rows

logger = logging.getLogger("sb3_mcbs")


def make_planner(
    agent: OffPolicyAlgorithm,
    vec_env: VecEnv,
    settings: SearchSettings,
    normalize_reward: bool | None = None,
    recent_actions: RecentActions | None = None,
) -> Planner:
    """Make what searches for an agent.

    :param agent: a TD3, DDPG, SAC or TQC agent.
    :param vec_env: the environments that it acts in.
    :param settings: settings of the search.
    :param normalize_reward: see :class:`~sb3_mcbs.SearchPolicy`.
    :param recent_actions: what the agent executed, for ``proposal_dims``; ``None``: nothing yet.
    :return: a :class:`LearnedPlanner` where a learned model simulates, else a :class:`Planner`.
    """
    planner = LearnedPlanner if settings.forward_model == "ensemble" else Planner
    return planner(agent, vec_env, settings, normalize_reward, recent_actions)


class LearnedPlanner(Planner):
    """Searches from the agent's observations by the model that the agent learned.

    The environments may be of any kind: they are neither wrapped nor copied. The cross-entropy method starts
    anew at every decision, since observations do not tell which steps were taken since the last one.

    :param agent: an agent that learns a model, or has learned one.
    :param vec_env: the environments.
    :param settings: settings of the search.
    :param normalize_reward: see :class:`~sb3_mcbs.SearchPolicy`.
    :param recent_actions: what the agent executed, for ``proposal_dims``; ``None``: nothing yet.
    :raises ValueError: if the agent has no learned model.
    """

    _originals: Any = None
    _n_searches = 0
    _said_not_ready = False

    def _connect(self) -> None:
        agent: Any = self.agent
        self.view = ObservationPipeline(self._vec_env, self._reward_normalizer())
        self._all_envs = range(self._vec_env.num_envs)
        ensemble = self._learned_model.ensemble
        self._ensemble_model = EnsembleModel(
            ensemble, agent.observation_space, agent.action_space, self._model_settings.ensemble_pessimism
        )
        self.model = self._ensemble_model

    @property
    def _learned_model(self) -> LearnedModel:
        learned = getattr(self.agent, "learned_model", None)
        if learned is None:
            raise ValueError(
                f"This {type(self.agent).__name__} has no learned model to search with: train it with "
                "forward_model='ensemble', load it with its class's own load (load_agent reads no learned "
                "model), or choose another forward_model."
            )
        return learned

    @property
    def _model_settings(self) -> EnsembleSettings:
        return EnsembleSettings.of(self.agent)

    @property
    def ready(self) -> bool:
        return self._learned_model.ensemble.held_out_error <= self._model_settings.ensemble_max_error

    def search(
        self,
        observations: Observations,
        rng: np.random.Generator,
        envs: Sequence[int] | None = None,
        effort: SearchSettings | None = None,
    ) -> SearchResult:
        if self.ready:
            self._ensemble_model.ensemble = self._learned_model.ensemble
            self._ensemble_model.pessimism = self._model_settings.ensemble_pessimism
            return super().search(observations, rng, envs, effort)
        if not self._said_not_ready:
            self._said_not_ready = True
            logger.warning(
                "The learned model is not used yet: its held-out error is %.3g, above "
                "ensemble_max_error=%.3g. The policy acts alone.",
                self._learned_model.ensemble.held_out_error,
                self._model_settings.ensemble_max_error,
            )
        return self._policy_alone(observations, envs)

    def _policy_alone(self, observations: Observations, envs: Sequence[int] | None) -> SearchResult:
        if self.agent.policy.training:
            self.agent.policy.set_training_mode(False)
        rows = self._all_envs if envs is None else envs
        originals = self.view.original(observations)
        actions = self.agent_functions().policy(take_rows(originals, np.asarray(rows)))
        n_envs = len(actions)
        nothing = np.full((n_envs, 1), -np.inf)
        return SearchResult(actions, np.full(n_envs, -1), actions[:, None], nothing, None, 0, 0)

    def capture_roots(
        self, observations: Observations, envs: Sequence[int]
    ) -> tuple[list[Any], Observations]:
        self._n_searches += 1
        self._originals = take_rows(self.view.original(observations), np.asarray(envs))
        return list(self._originals), self._originals

    def model_error(
        self,
        result: SearchResult,
        envs: Sequence[int],
        observations: Observations,
        rewards: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> float | None:
        """Compare what the model predicts for the executed actions with what happened.

        :param result: the decision whose actions were executed, the last one.
        :param envs: the environments that were searched.
        :param observations: ``[n_envs, *]``, what the agent received next.
        :param rewards: ``[n_envs]``, of the environments, not normalised.
        :param infos: one per environment; where an episode ended the last observation is in it.
        :return: the error, measured as the held-out error is; ``None`` if no action was executed.
        """
        executed = np.flatnonzero(result.chosen >= 0)
        if not len(executed):
            return None
        happened = self.view.original(observations)
        assert isinstance(happened, np.ndarray)
        happened = happened.copy()
        for env in np.asarray(envs)[executed].tolist():
            last = infos[env].get("terminal_observation")
            if last is not None:
                happened[env] = self.view.unnormalize(last)
        rows = np.asarray(envs)[executed]
        n_rows = len(rows)
        return self._ensemble_model.ensemble.error(
            Transitions(
                self._originals[executed].reshape(n_rows, -1),
                result.actions[executed],
                happened[rows].reshape(n_rows, -1),
                rewards[rows],
                np.zeros(n_rows),
            )
        )

    def _episode_clocks(self, envs: Sequence[int]) -> list[EpisodeClock]:
        # Never the same moment twice: no plan is recalled.
        return [(self._n_searches, 0)] * len(envs)
