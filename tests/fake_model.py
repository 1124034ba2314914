"""A forward model of a tiny made-up world, for tests of the search alone."""

import numpy as np

from sb3_mcbs.types import ForwardModel, Transition


class LineWorld(ForwardModel):
    """A point on a line: ``x += action`` and the reward is ``-x**2``.

    It terminates beyond ``|x| > limit``, truncates the episode beyond ``|x| > stop`` and diverges where an
    action is larger than ``bad_action``.
    With ``spread`` above 0 every step adds noise from the generator given to :meth:`set_roots`.
    """

    def __init__(
        self,
        limit: float = np.inf,
        bad_action: float = np.inf,
        spread: float = 0.0,
        stop: float = np.inf,
    ) -> None:
        self.deterministic = spread == 0
        self.limit, self.bad_action, self.spread, self.stop = limit, bad_action, spread, stop
        self.x = np.zeros(0)
        self.steps_taken = 0

    @property
    def n_rows(self) -> int:
        return len(self.x)

    def read_roots(self, env_indices):
        raise NotImplementedError("tests hand the roots over themselves")

    def set_roots(self, roots, index, rng):
        self.x = np.asarray(roots, dtype=float)[index]
        self.rng = rng

    def select(self, index):
        assert (np.diff(index) >= 0).all(), "rows are gathered in order"
        self.x = self.x[index]

    def step(self, actions):
        assert actions.shape == (self.n_rows, 1)
        self.steps_taken += self.n_rows
        self.x = self.x + actions[:, 0]
        if self.spread:
            self.x = self.x + self.spread * self.rng.standard_normal(self.n_rows)
        observations, distance = self.x[:, None].copy(), np.abs(self.x)
        stopped = distance > self.stop
        return Transition(
            observations,
            -(self.x**2),
            distance > self.limit,
            actions[:, 0] <= self.bad_action,
            stopped if stopped.any() else None,
        )
