"""A learned model: an ensemble of networks, and the forward model that simulates with it."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from torch.nn import functional

from sb3_mcbs.types import ForwardModel, ForwardModelError, Transition

#: Neurons in the hidden layers of every member.
HIDDEN = (200, 200)
#: Range of the predicted log-variances, in units of the normalised targets.
LOG_VARIANCES = (-10.0, 1.0)
BATCH_SIZE = 256
LEARNING_RATE = 1e-3
#: Gradient steps between two computations of the held-out error.
STEPS_PER_LOOK = 100
#: A fit ends after this number of held-out errors in a row without an improvement.
PATIENCE = 3
#: Statistics and held-out errors use at most this many rows, evenly spaced. More would hardly change them.
_STATISTICS_ROWS = 100_000
_HELD_OUT_ROWS = 2_000
#: A standard deviation below this, relative to the mean, is rounding noise of a constant.
_NO_VARIATION = 1e-6


class Transitions(NamedTuple):
    """Transitions of an environment, as replay buffers store them.

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
        """Select transitions with an index array of any shape."""
        return Transitions(*(array[rows] for array in self))


class Prediction(NamedTuple):
    """The ensemble's prediction of one step.

    :param next_observations: ``[rows, obs_dim]`` float64.
    :param rewards: ``[rows]`` float64.
    :param terminated: ``[rows]`` bool.
    :param disagreement: ``[rows]``: standard deviation of the members' predictions, as a root mean square
        over all targets in units of the targets' standard deviations. 1 is as much as the targets themselves
        vary.
    """

    next_observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    disagreement: np.ndarray


class Ensemble:
    """Probabilistic networks that predict an environment's next observation, reward and termination.

    The members are fitted to the same transitions, from different initial weights and in different orders.
    The targets are the change of every entry of the observation, and the reward, each normalised by its mean
    and standard deviation. Every member outputs a Gaussian for each target and the logit of a termination.
    The prediction is the mean over the members' means: it draws no random numbers, so the same state and
    action always lead to the same next state, and the mean is more accurate than any member.

    :param size: number of members.
    :param obs_dim: entries of an observation.
    :param act_dim: entries of an action.
    :param rng: draws the initial weights.
    :param device: device on which the networks run.

    :ivar shape: number of members, entries of an observation, entries of an action.
    :ivar parameters: all parameters of all members in one tensor, so that a layer is one batched product.
    :ivar held_out_error: the mean absolute error of the prediction on held-out transitions, relative to the
        target's mean absolute deviation and averaged over targets. 0 is perfect, 1 as bad as always
        predicting the mean change and the mean reward; infinite before the first fit. Squared errors would
        be dominated by a few unpredictable collisions.
    :ivar termination_error: the share of held-out transitions whose termination is predicted wrongly.
    :ivar predicts_termination: whether the transitions contain a termination and the held-out ones are
        predicted no worse than by "never". Otherwise no termination is predicted.
    """

    def __init__(
        self, size: int, obs_dim: int, act_dim: int, rng: np.random.Generator, device: th.device
    ) -> None:
        self.shape = (size, obs_dim, act_dim)
        drawn = []
        for inputs, outputs in self._layer_sizes():
            bound = 1 / math.sqrt(inputs)  # as torch.nn.Linear
            drawn += [rng.uniform(-bound, bound, n * outputs * size) for n in (inputs, 1)]
        flat = th.from_numpy(np.concatenate(drawn).astype(np.float32))
        self.parameters = flat.to(device).requires_grad_()
        self._obs_mean, self._obs_scale = np.zeros(obs_dim), np.ones(obs_dim)
        self._target_mean, self._target_scale = np.zeros(obs_dim + 1), np.ones(obs_dim + 1)
        self._deviation = np.ones(obs_dim + 1)
        self.held_out_error = float("inf")
        self.termination_error = 0.0
        self.predicts_termination = False

    @property
    def reward_scale(self) -> float:
        """Standard deviation of the rewards in the transitions."""
        return float(self._target_scale[-1])

    def to(self, device: th.device) -> None:
        """Move the networks to a device."""
        self.parameters = self.parameters.detach().to(device).requires_grad_()

    def predict(self, observations: np.ndarray, actions: np.ndarray) -> Prediction:
        """Predict one step.

        :param observations: ``[rows, obs_dim]``.
        :param actions: ``[rows, act_dim]``, scaled to [-1, 1].
        :return: the prediction.
        """
        with th.no_grad():
            inputs = self._inputs(observations, actions)
            outputs, _, termination_logits = self._forward(inputs.expand(self.shape[0], -1, -1))
            logits = termination_logits.mean(dim=0).cpu().numpy()
            # In float64, so that small changes of large observations are not rounded away.
            means = outputs.cpu().numpy().astype(np.float64)
        mean = means.mean(axis=0)
        targets = self._target_mean + self._target_scale * mean
        disagreement = np.sqrt(np.square(means - mean).mean(axis=(0, 2)))
        terminated = (logits > 0) & self.predicts_termination
        return Prediction(observations + targets[:, :-1], targets[:, -1], terminated, disagreement)

    def error(self, transitions: Transitions) -> float:
        """Compare predictions with real transitions.

        :param transitions: the real transitions.
        :return: the error, in the units of ``held_out_error``.
        """
        return self._errors(transitions)[0]

    def _errors(self, transitions: Transitions) -> tuple[float, float]:
        """The error, and the share of terminations that are predicted wrongly."""
        predicted = self.predict(transitions.observations, transitions.actions)
        observations = predicted.next_observations - transitions.next_observations
        difference = np.column_stack([observations, predicted.rewards - transitions.rewards])
        wrong = predicted.terminated != (transitions.terminated > 0)
        return float(np.abs(difference / self._deviation).mean()), float(wrong.mean())

    def fit(
        self, transitions: Transitions, held_out: np.ndarray, max_steps: int, rng: np.random.Generator
    ) -> None:
        """Train all members, from their present weights, until the held-out error stops falling.

        The weights with the lowest sum of held-out and termination error are kept, which may be the present
        ones. The optimiser starts anew, since its averages belong to the previous normalisation.

        :param transitions: all known transitions.
        :param held_out: ``[n]`` bool: which of them are never trained on; some, but not all.
        :param max_steps: upper limit of the gradient steps.
        :param rng: draws each member's batches.
        """
        rows = np.flatnonzero(~held_out)
        held = transitions.take(_spaced(np.flatnonzero(held_out), _HELD_OUT_ROWS))
        self._normalise(transitions.take(_spaced(rows, _STATISTICS_ROWS)))
        terminates = self.predicts_termination = bool(transitions.terminated[rows].any())
        optimizer = th.optim.AdamW([self.parameters], lr=LEARNING_RATE, fused=True)
        lowest, best, looks_without_gain = sum(self._errors(held)), self.parameters.detach().clone(), 0
        for step in range(1, max_steps + 1):
            drawn = rows[rng.integers(0, len(rows), (self.shape[0], BATCH_SIZE))]
            optimizer.zero_grad()
            self._loss(transitions.take(drawn), terminates).backward()
            optimizer.step()
            if step % STEPS_PER_LOOK and step < max_steps:
                continue
            score = sum(self._errors(held))
            if score < lowest:
                lowest, best, looks_without_gain = score, self.parameters.detach().clone(), 0
            else:
                looks_without_gain += 1
                if looks_without_gain == PATIENCE:
                    break
        with th.no_grad():
            self.parameters.copy_(best)
        self.held_out_error, self.termination_error = self._errors(held)
        never = float(np.mean(held.terminated > 0))
        if self.termination_error > never:
            # Weights that predict terminations worse than "never" would end simulations at random.
            self.predicts_termination, self.termination_error = False, never

    def _normalise(self, transitions: Transitions) -> None:
        self._obs_mean, self._obs_scale = _mean_and_scale(transitions.observations)
        targets = _targets(transitions)
        self._target_mean, self._target_scale = _mean_and_scale(targets)
        deviation = np.abs((targets - self._target_mean) / self._target_scale).mean(axis=0)
        # The error of a constant target is not divided by its deviation, which is 0.
        self._deviation = self._target_scale * np.where(deviation > _NO_VARIATION, deviation, 1.0)

    def _inputs(self, observations: np.ndarray, actions: np.ndarray) -> th.Tensor:
        inputs = np.concatenate([(observations - self._obs_mean) / self._obs_scale, actions], axis=-1)
        return self._tensor(inputs)

    def _layer_sizes(self) -> list[tuple[int, int]]:
        _, obs_dim, act_dim = self.shape
        return list(pairwise((obs_dim + act_dim, *HIDDEN, 2 * (obs_dim + 1) + 1)))

    def _forward(self, inputs: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Run every member.

        :param inputs: ``[size, rows, obs_dim + act_dim]`` float32, normalised.
        :return: means and log-variances ``[size, rows, obs_dim + 1]``, termination logits ``[size, rows]``.
        """
        size, obs_dim, _ = self.shape
        shapes = [(size, n, outputs) for n_inputs, outputs in self._layer_sizes() for n in (n_inputs, 1)]
        parts = self.parameters.split([math.prod(shape) for shape in shapes])
        *hidden, last_weight, last_bias = (
            part.view(shape) for part, shape in zip(parts, shapes, strict=True)
        )
        values = inputs
        for weight, bias in zip(hidden[::2], hidden[1::2], strict=True):
            values = functional.silu(th.baddbmm(bias, values, weight))
        means, spreads, logits = th.baddbmm(last_bias, values, last_weight).split(
            (obs_dim + 1, obs_dim + 1, 1), dim=2
        )
        low, high = LOG_VARIANCES
        log_variances = high - functional.softplus(high - spreads)
        log_variances = low + functional.softplus(log_variances - low)
        return means, log_variances, logits[..., 0]

    def _loss(self, batch: Transitions, terminates: bool) -> th.Tensor:
        """Negative log-likelihood of transitions ``[size, rows]``, and of terminations if there are any."""
        means, log_variances, logits = self._forward(self._inputs(batch.observations, batch.actions))
        targets = self._tensor((_targets(batch) - self._target_mean) / self._target_scale)
        likelihood = (means - targets) ** 2 * th.exp(-log_variances) + log_variances
        # Weighted by the standard deviation (Seitzer et al., 2022): the plain likelihood hardly learns the
        # mean of targets that it considers noisy, and the predictions use the mean.
        loss = (likelihood * th.exp(0.5 * log_variances.detach())).mean(dim=(1, 2)).sum()
        if terminates:
            labels = self._tensor(batch.terminated)
            loss = loss + functional.binary_cross_entropy_with_logits(logits, labels) * len(labels)
        return loss

    def _tensor(self, array: np.ndarray) -> th.Tensor:
        return th.from_numpy(array.astype(np.float32, copy=False)).to(self.parameters.device)

    def __getstate__(self) -> dict[str, Any]:
        # A file written on a GPU must be readable without one.
        return {**vars(self), "parameters": self.parameters.detach().cpu().numpy()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self.parameters = th.from_numpy(state["parameters"].copy()).requires_grad_()


def _targets(transitions: Transitions) -> np.ndarray:
    change = transitions.next_observations - transitions.observations
    return np.concatenate([change, transitions.rewards[..., None]], axis=-1)


def _mean_and_scale(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of every column; 1 instead of the deviation of a constant."""
    mean, deviation = values.mean(axis=0, dtype=np.float64), values.std(axis=0, dtype=np.float64)
    return mean, np.where(deviation > _NO_VARIATION * (_NO_VARIATION + np.abs(mean)), deviation, 1.0)


def _spaced(rows: np.ndarray, most: int) -> np.ndarray:
    """At most ``most`` of the rows, evenly spaced."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most, dtype=np.int64)]


class EnsembleModel(ForwardModel):
    """Simulates with an ensemble that was fitted to earlier transitions.

    It is for environments that cannot be copied: a root is an observation, and the environment needs no
    snapshots. Every step is the mean over the ensemble's members. Where they disagree the model is
    pessimistic, so that a search does not exploit what the model does not know: the reward is lowered by
    ``pessimism`` times the members' disagreement times the standard deviation of rewards.

    :param ensemble: the ensemble; may be replaced between searches.
    :param observation_space: of the observations, as replay buffers store them.
    :param action_space: of the environment.
    :param pessimism: how much disagreement lowers the reward.
    :raises ForwardModelError: for spaces that an ensemble cannot predict.
    """

    deterministic = True
    kind = "ensemble"

    def __init__(
        self,
        ensemble: Ensemble,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        pessimism: float = 1.0,
    ) -> None:
        self.ensemble = ensemble
        self._observation_space = check_observation_space(observation_space)
        assert isinstance(action_space, spaces.Box)
        self._low, self._high = action_space.low.ravel(), action_space.high.ravel()
        self.pessimism = pessimism
        self._observations = np.zeros((0, *self._observation_space.shape))
        self.description = f"learned ensemble of {ensemble.shape[0]} networks"

    @property
    def n_rows(self) -> int:
        return len(self._observations)

    def read_roots(self, env_indices: Sequence[int]) -> list[Any]:
        raise ForwardModelError(
            "A learned model reads nothing from environments: its roots are their present observations."
        )

    def set_roots(self, roots: Sequence[Any], index: np.ndarray, rng: np.random.Generator) -> None:
        flat = np.asarray(roots, dtype=np.float64).reshape(len(roots), -1)
        self._observations = flat[index]

    def select(self, index: np.ndarray) -> None:
        self._observations = self._observations[index]

    def step(self, actions: np.ndarray) -> Transition:
        if len(actions) != self.n_rows:
            raise ValueError(f"expected one action for each of {self.n_rows} rows, got {len(actions)}")
        flat = actions.reshape(len(actions), -1)
        scaled = 2.0 * (flat - self._low) / (self._high - self._low) - 1.0
        predicted = self.ensemble.predict(self._observations, scaled)
        penalty = self.pessimism * self.ensemble.reward_scale * predicted.disagreement
        rewards = predicted.rewards - penalty
        self._observations = predicted.next_observations
        valid = np.isfinite(self._observations).all(axis=1) & np.isfinite(rewards)
        space = self._observation_space
        observations = self._observations.reshape(-1, *space.shape).astype(space.dtype)
        return Transition(observations, rewards, predicted.terminated, valid)


def check_observation_space(space: spaces.Space) -> spaces.Box:
    """Refuse observations that an ensemble cannot predict.

    :param space: the observation space.
    :return: the same space.
    :raises ForwardModelError: if it is not a Box of floating-point numbers.
    """
    if isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating):
        return space
    raise ForwardModelError(
        f"forward_model='ensemble' predicts vectors of floating-point numbers, and the observation space is "
        f"{space}. Wrap the environment so that its observations are such a Box (FlattenObservation for a "
        "Dict), or choose another forward_model."
    )
