"""The forward model for environments that cannot be copied: learned, and set from observations."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_mcbs.models.ensemble import Ensemble
from sb3_mcbs.types import ForwardModel, ForwardModelError, Transition


class EnsembleModel(ForwardModel):
    """Simulates with an ensemble that was fitted to what happened before.

    A root is an observation: nothing is read from an environment, which needs no snapshot. Every step is the
    mean over the ensemble's members. It is pessimistic where they disagree: from the reward is taken
    ``pessimism`` times the members' disagreement times the standard deviation of rewards, so that a search
    does not run to where the model knows nothing.

    :param ensemble: the ensemble; may be replaced between searches.
    :param observation_space: of the observations, as replay buffers keep them.
    :param action_space: of the environment.
    :param pessimism: see above.
    :raises ForwardModelError: for spaces that the ensemble is not for.

    :ivar deterministic: True, since nothing is drawn.
    :ivar kind: "ensemble".
    :ivar description: one line that says what simulates.
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

    :param space: of the observations.
    :return: the same.
    :raises ForwardModelError: if it is not a Box of floating-point numbers.
    """
    if isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating):
        return space
    raise ForwardModelError(
        f"forward_model='ensemble' predicts vectors of floating-point numbers, and the observation space is "
        f"{space}. Wrap the environment so that its observations are such a Box (FlattenObservation for a "
        "Dict), or choose another forward_model."
    )
