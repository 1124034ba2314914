"""Low-dimensional proposals: noise in the few directions in which recent actions varied most."""

from typing import Any

import numpy as np

#: Number of remembered actions, and how many are needed to learn directions.
RECENT, ENOUGH = 1000, 100
#: Directions whose variance is below this fraction of the largest are ignored.
_NEGLIGIBLE = 1e-6


class RecentActions:
    """An agent's last executed actions, in all its environments and episodes.

    :param act_dim: action dimensions.
    """

    def __init__(self, act_dim: int) -> None:
        self._actions = np.zeros((RECENT, act_dim), dtype=np.float32)
        self._count = 0

    def __len__(self) -> int:
        return min(self._count, RECENT)

    def note(self, actions: np.ndarray) -> None:
        """Store actions in place of the oldest ones.

        :param actions: ``[n, act_dim]``, scaled, as executed.
        """
        places = (self._count + np.arange(len(actions))) % RECENT
        self._actions[places[-RECENT:]] = actions[-RECENT:]
        self._count += len(actions)

    def directions(self, n_directions: int) -> np.ndarray | None:
        """Find the principal directions: those in which the actions vary most around their mean.

        :param n_directions: number of directions.
        :return: ``[n_directions, act_dim]``, orthonormal; ``None`` while fewer than ``ENOUGH`` actions are
            known, or if they vary in fewer directions.
        """
        if len(self) < ENOUGH:
            return None
        actions = self._actions[: len(self)].astype(np.float64)
        deviations = actions - actions.mean(axis=0)
        variances, axes = np.linalg.eigh(deviations.T @ deviations)
        if variances[-n_directions] <= _NEGLIGIBLE * variances[-1]:
            return None
        return axes[:, ::-1][:, :n_directions].T.astype(np.float32)

    def state(self) -> dict[str, Any]:
        """The state for :meth:`set_state`, as plain values."""
        return {"actions": self._actions.copy(), "count": self._count}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state.

        :param state: from :meth:`state`.
        """
        self._actions[:] = state["actions"]
        self._count = int(state["count"])


def gain(directions: np.ndarray | None) -> float:
    """The factor that gives noise along directions the total variance of noise in all directions.

    :param directions: ``[n_directions, act_dim]``, orthonormal; ``None`` is all.
    """
    return 1.0 if directions is None else float(np.sqrt(directions.shape[1] / len(directions)))


def combine(coordinates: np.ndarray, directions: np.ndarray | None) -> np.ndarray:
    """Turn coordinates along directions into actions.

    :param coordinates: ``[..., act_dim]``, of which only the first ``n_directions`` are used.
    :param directions: ``[n_directions, act_dim]``; ``None``: coordinates are actions already.
    :return: ``[..., act_dim]``.
    """
    return coordinates if directions is None else coordinates[..., : len(directions)] @ directions


def low_dimensional(noise: np.ndarray, directions: np.ndarray | None) -> np.ndarray:
    """Turn noise in all directions into noise in some, with the same total variance.

    :param noise: ``[..., act_dim]``, independent entries of equal standard deviation.
    :param directions: ``[n_directions, act_dim]``, orthonormal; ``None`` leaves it unchanged.
    :return: ``[..., act_dim]``.
    """
    return noise if directions is None else combine(noise, np.float32(gain(directions)) * directions)
