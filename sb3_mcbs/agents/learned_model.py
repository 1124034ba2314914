"""A model of the environment that an agent learns while it trains."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import get_action_dim

from sb3_mcbs.models.ensemble import Ensemble, Transitions, check_observation_space
from sb3_mcbs.search.checks import CheckedSettings, known_keys
from sb3_mcbs.search.random_streams import spawn_rng

#: Every tenth row of the replay buffer is held out, always the same ones, so that held-out transitions are
#: never fitted later.
HELD_OUT_EVERY = 10
#: Transitions before the first fit; with fewer, the held-out error is meaningless.
LEAST_TRANSITIONS = 500


@dataclass(frozen=True)
class EnsembleSettings(CheckedSettings):
    """Settings of the learned model: keys of ``model_kwargs``, besides ``n_threads``, with
    ``forward_model="ensemble"``.

    :param ensemble_size: number of networks.
    :param ensemble_train_freq: environment steps between two fits of the model.
    :param ensemble_gradient_steps: maximum gradient steps of a fit.
    :param ensemble_max_error: the agent searches while the model's held-out error is at most this, and acts
        without search otherwise. The error is the mean absolute error of one step on held-out transitions
        divided by the mean absolute deviation of the target, averaged over the entries of the observation and
        the reward: 0 is perfect, 1 is as bad as always predicting the mean change of observations and the
        mean reward.
    :param ensemble_pessimism: subtracts this times the networks' disagreement (relative to the target's
        variation) times the standard deviation of rewards from predicted rewards.
    :raises TypeError: if a value has the wrong type.
    :raises ValueError: if a value is out of range.
    """

    group = "model_kwargs"

    ensemble_size: int = 5
    ensemble_train_freq: int = 1000
    ensemble_gradient_steps: int = 500
    ensemble_max_error: float = 0.5
    ensemble_pessimism: float = 1.0

    def __post_init__(self) -> None:
        # A single network has no disagreement.
        self._set_integer("ensemble_size", 2, 100)
        self._set_integer("ensemble_train_freq", 1, 10**9)
        self._set_integer("ensemble_gradient_steps", 1, 10**6)
        for name in ("ensemble_max_error", "ensemble_pessimism"):
            self._set_number(name, 1e6)

    @classmethod
    def of(cls, agent: Any) -> Self:
        """Read the settings from an agent's ``model_kwargs``.

        :param agent: an :class:`~sb3_mcbs.MCBS` agent.
        :return: the checked settings; the defaults without a learned model.
        :raises TypeError: if a value has the wrong type, or a key is not known.
        :raises ValueError: if a value is out of range.
        """
        known = ("n_threads", *(cls.in_group() if agent.forward_model == "ensemble" else ()))
        others = dict.fromkeys(cls.in_group(), "is for forward_model='ensemble'")
        chosen = f"forward_model={agent.forward_model!r}"
        given = known_keys("model_kwargs", agent.model_kwargs, known, chosen, others)
        given.pop("n_threads", None)
        return cls(**given)


class LearnedModel:
    """An ensemble and the state of its training: part of an agent's state.

    :param agent: the agent, with a replay buffer.
    :param settings: settings of the model.

    :ivar ensemble: the networks.
    :ivar rng: draws initial weights and batches, separately from the agent's generators.
    :raises ForwardModelError: if the agent's observations are not vectors of numbers.
    """

    def __init__(self, agent: OffPolicyAlgorithm, settings: EnsembleSettings) -> None:
        self.rng = spawn_rng(agent.seed, "learned model")
        size = settings.ensemble_size
        obs_dim = spaces.flatdim(check_observation_space(agent.observation_space))
        act_dim = get_action_dim(agent.action_space)
        self.ensemble = Ensemble(size, obs_dim, act_dim, self.rng, agent.device)
        #: Steps of the agent at the last fit.
        self._fitted_at: int | None = None

    def check(self, agent: OffPolicyAlgorithm, settings: EnsembleSettings) -> None:
        """Refuse an agent that the model cannot learn from, and move to its device.

        :param agent: the agent, set up.
        :param settings: settings of the model.
        :raises ValueError: names the reason.
        """
        size = self.ensemble.shape[0]
        if settings.ensemble_size != size:
            raise ValueError(
                f"ensemble_size is {settings.ensemble_size}, and this agent has learned a model of {size} "
                "networks: do not change it."
            )
        if getattr(agent.replay_buffer, "optimize_memory_usage", False):
            raise ValueError(
                "forward_model='ensemble' learns from the last observation of every episode, which a replay "
                "buffer with optimize_memory_usage does not keep: leave that out."
            )
        self.ensemble.to(agent.device)

    @staticmethod
    def check_room(buffer: ReplayBuffer) -> None:
        """Refuse to train with a replay buffer that is too small to fit a model.

        :param buffer: the replay buffer.
        :raises ValueError: if it is too small.
        """
        room = buffer.buffer_size * buffer.n_envs
        if room < LEAST_TRANSITIONS:
            raise ValueError(
                f"forward_model='ensemble' needs a buffer_size of {LEAST_TRANSITIONS} or more: with fewer "
                f"transitions no model is fitted; there is room for {room}."
            )

    def fit_if_due(self, agent: OffPolicyAlgorithm, settings: EnsembleSettings) -> None:
        """Fit the ensemble to the replay buffer if ``ensemble_train_freq`` steps have passed.

        :param agent: the agent; the errors are written to its logger.
        :param settings: settings of the model.
        """
        now, then = agent.num_timesteps, self._fitted_at
        # learn() may reset the number of steps.
        if then is None or not 0 <= now - then < settings.ensemble_train_freq:
            assert agent.replay_buffer is not None
            transitions, held_out = read_transitions(agent.replay_buffer)
            if len(held_out) >= LEAST_TRANSITIONS and held_out.any():
                self._fitted_at = now
                self.ensemble.fit(transitions, held_out, settings.ensemble_gradient_steps, self.rng)
        error = self.ensemble.held_out_error
        agent.logger.record("search/model_ready", int(error <= settings.ensemble_max_error))
        if self._fitted_at is not None:
            agent.logger.record("model/held_out_error", error)
            agent.logger.record("model/termination_error", self.ensemble.termination_error)


def set_up_learned_model(agent: Any) -> None:
    """Create the learned model if an agent's settings need one, or remove it.

    :param agent: an :class:`~sb3_mcbs.MCBS` agent with a replay buffer.
    :raises ForwardModelError: if its observations are not vectors of numbers.
    :raises ValueError: if a setting is invalid.
    """
    settings = EnsembleSettings.of(agent)
    if agent.forward_model != "ensemble":
        agent.learned_model = None
        return
    if agent.learned_model is None:
        agent.learned_model = LearnedModel(agent, settings)
    agent.learned_model.check(agent, settings)


def check_learned_model(agent: Any) -> None:
    """Refuse changed settings that do not fit the agent's learned model.

    :param agent: an :class:`~sb3_mcbs.MCBS` agent that was set up.
    :raises ValueError: if a setting is invalid.
    """
    if (agent.forward_model == "ensemble") != (agent.learned_model is not None):
        raise ValueError(
            "Whether an agent learns a model (forward_model='ensemble') is decided when it is made or "
            "loaded: save it, and load it with another forward_model, and the model_kwargs of that."
        )
    settings = EnsembleSettings.of(agent)
    if agent.learned_model is not None:
        agent.learned_model.check(agent, settings)


def read_transitions(buffer: ReplayBuffer) -> tuple[Transitions, np.ndarray]:
    """Read all transitions of a replay buffer without sampling, which would affect the agent's samples.

    :param buffer: a buffer of single steps and Box observations.
    :return: the transitions ``[n]`` of all rows and environments, and which of them are held out.
    """
    stored: Any = buffer
    n_rows = stored.size()

    def flat(array: np.ndarray) -> np.ndarray:
        return array[:n_rows].reshape(n_rows * stored.n_envs, -1)

    # A time limit is not a termination.
    terminated = flat(stored.dones) * (1 - flat(stored.timeouts))
    transitions = Transitions(
        flat(stored.observations),
        flat(stored.actions),
        flat(stored.next_observations),
        flat(stored.rewards)[:, 0],
        terminated[:, 0],
    )
    held_out = np.arange(n_rows) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    return transitions, np.repeat(held_out, stored.n_envs)
