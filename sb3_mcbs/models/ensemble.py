"""A probabilistic ensemble of an environment's next observation, reward and termination."""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch.nn import functional

from sb3_mcbs.models.ensemble_network import EnsembleNetwork

BATCH_SIZE = 256
LEARNING_RATE = 1e-3
#: Gradient steps between two looks at the held-out transitions, and looks without a gain that end a fit.
STEPS_PER_LOOK = 100
PATIENCE = 3
#: More rows than these, evenly spaced, change neither statistics nor a held-out error noticeably.
_STATISTICS_ROWS = 100_000
_HELD_OUT_ROWS = 2_000
#: What is left of a constant after rounding, relative to it.
_NO_VARIATION = 1e-6


class Transitions(NamedTuple):
    """What happened in an environment, as replay buffers keep it.

    :param observations: ``[n, obs_dim]``, not normalised.
    :param actions: ``[n, act_dim]``, scaled to [-1, 1].
    :param next_observations: ``[n, obs_dim]``.
    :param rewards: ``[n]``, of the environment.
    :param terminated: ``[n]``, 1 where the environment ended the episode, 0 at a time limit.
    """

    observations: np.ndarray
    actions: np.ndarray
    next_observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray

    def take(self, rows: np.ndarray) -> "Transitions":
        """Some of them, in any shape.

        :param rows: indices.
        """
        return Transitions(*(array[rows] for array in self))


class Prediction(NamedTuple):
    """What the ensemble expects.

    :param next_observations: ``[rows, obs_dim]`` float64.
    :param rewards: ``[rows]`` float64.
    :param terminated: ``[rows]`` bool.
    :param disagreement: ``[rows]``: standard deviation of the members' answers, as a root mean square over
        all targets in units of the targets' standard deviations. 1 is as much as the targets themselves vary.
    """

    next_observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    disagreement: np.ndarray


class Ensemble:
    """Members that were fitted to the same transitions, from different weights and in a different order.

    A target is the change of every entry of the observation, and the reward, each normalised by its mean and
    standard deviation in the transitions. The prediction is the mean over members of their means: no
    randomness has to be drawn, the same state and action always lead to the same next state, and an average
    of members errs less than any of them. Where they disagree is known too, and left to the caller.

    :param size: number of members.
    :param obs_dim: entries of an observation.
    :param act_dim: entries of an action.
    :param rng: draws the initial weights.
    :param device: where it is computed.

    :ivar held_out_error: the mean absolute error of the prediction over held-out transitions, as a part of
        the target's mean absolute deviation, averaged over targets. 0 is perfect, 1 as bad as always
        predicting the mean change and the mean reward; infinite before the first fit. Not of squares: a few
        collisions, which nobody can predict, would be all that it tells of.
    :ivar termination_error: the share of held-out transitions whose termination is predicted wrongly.
    :ivar predicts_termination: whether a termination was among the transitions, and held-out ones are
        predicted no worse than by "never". Otherwise none is predicted.
    """

    def __init__(
        self, size: int, obs_dim: int, act_dim: int, rng: np.random.Generator, device: th.device
    ) -> None:
        self._network = EnsembleNetwork(size, obs_dim + act_dim, obs_dim + 1, rng, device)
        self._obs_mean, self._obs_scale = np.zeros(obs_dim), np.ones(obs_dim)
        self._target_mean, self._target_scale = np.zeros(obs_dim + 1), np.ones(obs_dim + 1)
        self._deviation = np.ones(obs_dim + 1)
        self.held_out_error = float("inf")
        self.termination_error = 0.0
        self.predicts_termination = False

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of members, entries of an observation, entries of an action."""
        obs_dim = len(self._obs_mean)
        return self._network.size, obs_dim, self._network.n_inputs - obs_dim

    @property
    def reward_scale(self) -> float:
        """Standard deviation of the rewards in the transitions."""
        return float(self._target_scale[-1])

    def to(self, device: th.device) -> None:
        """Compute elsewhere.

        :param device: where.
        """
        parameters = self._network.parameters
        self._network.parameters = parameters.detach().to(device).requires_grad_()

    def predict(self, observations: np.ndarray, actions: np.ndarray) -> Prediction:
        """Predict one step.

        :param observations: ``[rows, obs_dim]``.
        :param actions: ``[rows, act_dim]``, scaled to [-1, 1].
        :return: what is expected.
        """
        with th.no_grad():
            inputs = self._inputs(observations, actions)
            outputs = self._network(inputs.expand(self._network.size, -1, -1))
            logits = outputs.termination_logits.mean(dim=0).cpu().numpy()
            # In float64, so that small changes of large observations are not rounded away.
            means = outputs.means.cpu().numpy().astype(np.float64)
        mean = means.mean(axis=0)
        targets = self._target_mean + self._target_scale * mean
        disagreement = np.sqrt(np.square(means - mean).mean(axis=(0, 2)))
        terminated = (logits > 0) & self.predicts_termination
        return Prediction(observations + targets[:, :-1], targets[:, -1], terminated, disagreement)

    def error(self, happened: Transitions) -> float:
        """Compare predictions with what happened.

        :param happened: the transitions.
        :return: the error, in the units of ``held_out_error``.
        """
        predicted = self.predict(happened.observations, happened.actions)
        difference = np.column_stack(
            [
                predicted.next_observations - happened.next_observations,
                predicted.rewards - happened.rewards,
            ]
        )
        return float(np.abs(difference / self._deviation).mean())

    def fit(
        self, transitions: Transitions, held_out: np.ndarray, max_steps: int, rng: np.random.Generator
    ) -> None:
        """Fit all members, from the weights that they have, until the held-out error falls no more.

        What is kept are the weights with the lowest held-out error, that of terminations added, which may be
        those from before. The optimiser starts anew: its averages belong to the normalisation of before.

        :param transitions: all that are known.
        :param held_out: ``[n]`` bool: which of them are never fitted; some, but not all.
        :param max_steps: most gradient steps.
        :param rng: draws the batches, for each member its own.
        """
        rows = np.flatnonzero(~held_out)
        held = transitions.take(_spaced(np.flatnonzero(held_out), _HELD_OUT_ROWS))
        self._normalise(transitions.take(_spaced(rows, _STATISTICS_ROWS)))
        terminates = self.predicts_termination = bool(transitions.terminated[rows].any())
        parameters = self._network.parameters
        optimizer = th.optim.AdamW([parameters], lr=LEARNING_RATE, fused=True)
        lowest, best, looks_without_gain = self._score(held), parameters.detach().clone(), 0
        for step in range(1, max_steps + 1):
            drawn = rows[rng.integers(0, len(rows), (self._network.size, BATCH_SIZE))]
            optimizer.zero_grad()
            self._loss(transitions.take(drawn), terminates).backward()
            optimizer.step()
            if step % STEPS_PER_LOOK and step < max_steps:
                continue
            score = self._score(held)
            if score < lowest:
                lowest, best, looks_without_gain = score, parameters.detach().clone(), 0
            else:
                looks_without_gain += 1
                if looks_without_gain == PATIENCE:
                    break
        with th.no_grad():
            parameters.copy_(best)
        self.held_out_error, self.termination_error = self.error(held), self._termination_error(held)
        never = float(np.mean(held.terminated > 0))
        if self.termination_error > never:
            # Weights that know less of terminations than nothing would end simulations at random.
            self.predicts_termination, self.termination_error = False, never

    def _score(self, held: Transitions) -> float:
        return self.error(held) + self._termination_error(held)

    def _termination_error(self, held: Transitions) -> float:
        predicted = self.predict(held.observations, held.actions).terminated
        return float(np.mean(predicted != (held.terminated > 0)))

    def _normalise(self, transitions: Transitions) -> None:
        self._obs_mean, self._obs_scale = _mean_and_scale(transitions.observations)
        targets = _targets(transitions)
        self._target_mean, self._target_scale = _mean_and_scale(targets)
        deviation = np.abs((targets - self._target_mean) / self._target_scale).mean(axis=0)
        # A target that never varied is no reason for an error, however large it is relative to nothing.
        self._deviation = self._target_scale * np.where(deviation > _NO_VARIATION, deviation, 1.0)

    def _inputs(self, observations: np.ndarray, actions: np.ndarray) -> th.Tensor:
        inputs = np.concatenate([(observations - self._obs_mean) / self._obs_scale, actions], axis=-1)
        return self._tensor(inputs)

    def _loss(self, batch: Transitions, terminates: bool) -> th.Tensor:
        """Negative log-likelihood, of transitions ``[size, rows]``; of terminations too if there are any."""
        outputs = self._network(self._inputs(batch.observations, batch.actions))
        targets = self._tensor((_targets(batch) - self._target_mean) / self._target_scale)
        squares = (outputs.means - targets) ** 2
        likelihood = squares * th.exp(-outputs.log_variances) + outputs.log_variances
        # Weighted by the standard deviation (Seitzer et al., 2022): the plain likelihood hardly learns the
        # mean of targets that it calls noisy, and the mean is what is used.
        loss = (likelihood * th.exp(0.5 * outputs.log_variances.detach())).mean(dim=(1, 2)).sum()
        if terminates:
            labels = self._tensor(batch.terminated)
            logits = outputs.termination_logits
            loss = loss + functional.binary_cross_entropy_with_logits(logits, labels) * len(labels)
        return loss

    def _tensor(self, array: np.ndarray) -> th.Tensor:
        return th.from_numpy(array.astype(np.float32, copy=False)).to(self._network.parameters.device)

    def __getstate__(self) -> dict[str, Any]:
        # A file that was written on a GPU is to be read without one.
        return {**vars(self), "_network": (self.shape, self._network.parameters.detach().cpu().numpy())}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        (size, obs_dim, act_dim), parameters = state["_network"]
        network = self._network = EnsembleNetwork(
            size, obs_dim + act_dim, obs_dim + 1, np.random.default_rng(0), th.device("cpu")
        )
        network.parameters = th.from_numpy(parameters.copy()).requires_grad_()


def _targets(transitions: Transitions) -> np.ndarray:
    change = transitions.next_observations - transitions.observations
    return np.concatenate([change, transitions.rewards[..., None]], axis=-1)


def _mean_and_scale(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of every column; 1 where it does not vary."""
    mean, deviation = values.mean(axis=0, dtype=np.float64), values.std(axis=0, dtype=np.float64)
    return mean, np.where(deviation > _NO_VARIATION * (_NO_VARIATION + np.abs(mean)), deviation, 1.0)


def _spaced(rows: np.ndarray, most: int) -> np.ndarray:
    """At most so many rows, evenly spaced."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most, dtype=np.int64)]
