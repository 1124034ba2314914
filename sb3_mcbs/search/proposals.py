"""Proposes candidates: noise around the policy's actions, and pre-selection by the critics.

All random numbers of a decision are drawn before the simulation, as float32 and in a fixed order, so they do
not depend on the simulation's results.
"""

from typing import Any, NamedTuple

import numpy as np

from sb3_mcbs.search.interface import PolicyFunctions
from sb3_mcbs.search.settings import SearchSettings
from sb3_mcbs.types import Observations, take_rows

#: Actions that are remembered, and how many are needed before directions are learned from them.
RECENT, ENOUGH = 1000, 100
#: A direction whose variance is below this share of the largest is none.
_NEGLIGIBLE = 1e-6


class Noise(NamedTuple):
    """All random numbers of one decision by Algorithm 1.

    :param beam: ``[n_envs, proposals, act_dim]``, eta_i in Algorithm 1, for the first macro-step.
    :param rollout: ``[rollout_depth, n_envs, beam, sim, act_dim]``, eta in ShortHorizon, for the later
        macro-steps and the action of the bootstrap.
    """

    beam: np.ndarray
    rollout: np.ndarray


def draw_noise(
    rng: np.random.Generator,
    settings: SearchSettings,
    n_envs: int,
    act_dim: int,
    beam_width: int | None = None,
    directions: np.ndarray | None = None,
) -> Noise:
    """Draw the noise of one decision: first for the candidates, then for the rollouts.

    :param rng: draws the noise.
    :param settings: width, depth, simulations, noise scales and ``antithetic``.
    :param n_envs: number of environments.
    :param act_dim: action dimensions.
    :param beam_width: number of candidates; ``None``: that of the settings.
    :param directions: ``[proposal_dims, act_dim]``, in which candidates differ; ``None``: all.
    :return: the noise, clipped to ``noise_clip`` if that is set.
    """
    b, d, n = beam_width or settings.beam_width, settings.rollout_depth, settings.n_simulations
    n_proposals = settings.n_proposals or b
    pairs = settings.antithetic
    beam = draw_normal(rng, (n_envs, n_proposals, act_dim), 1 if pairs else None)
    shape = (d, n_envs, b, n, act_dim)
    rollout = scale(draw_normal(rng, shape, 3 if pairs else None), settings.effective_rollout_noise, settings)
    beam = scale(low_dimensional(beam, directions), settings.beam_noise, settings)
    return Noise(beam, rollout)


def draw_normal(rng: np.random.Generator, shape: tuple[int, ...], pairs: int | None) -> np.ndarray:
    """Draw Gaussian noise, or antithetic pairs of it.

    With pairs the second half along their axis is minus the first half, and with an odd number the first
    draw is 0, so the sum is always 0. A single draw is unchanged.

    :param rng: draws the noise.
    :param shape: shape of the noise.
    :param pairs: axis of the pairs; ``None``: all draws are independent.
    :return: float32 noise with standard deviation 1.
    """
    if pairs is None or shape[pairs] < 2:
        return rng.standard_normal(shape, dtype=np.float32)

    def of_count(count: int) -> tuple[int, ...]:
        return (*shape[:pairs], count, *shape[pairs + 1 :])

    half = rng.standard_normal(of_count(shape[pairs] // 2), dtype=np.float32)
    unpaired = np.zeros(of_count(shape[pairs] % 2), dtype=np.float32)
    return np.concatenate([unpaired, half, -half], axis=pairs)


def scale(noise: np.ndarray, spread: float | np.ndarray, settings: SearchSettings) -> np.ndarray:
    """Scale noise to a standard deviation, and clip it to ``noise_clip`` if that is set.

    :param noise: noise with standard deviation 1.
    :param spread: standard deviation, or an array that broadcasts.
    :param settings: contain ``noise_clip``.
    :return: the noise in the action space scaled to [-1, 1].
    """
    noise = noise * np.asarray(spread, dtype=np.float32)
    if settings.noise_clip is not None:
        np.clip(noise, -settings.noise_clip, settings.noise_clip, out=noise)
    return noise


def propose(
    policy_actions: np.ndarray, noise: np.ndarray, include_policy_action: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Generate candidate actions (Algorithm 1, lines 6 to 10).

    :param policy_actions: ``[n_envs, act_dim]``.
    :param noise: ``[n_envs, beam, act_dim]``.
    :param include_policy_action: whether the first candidate has no noise.
    :return: candidates ``[n_envs, beam, act_dim]`` in [-1, 1], and their noise.
    """
    candidates = clip_actions(policy_actions[:, None] + noise)
    if include_policy_action:
        noise = noise.copy()
        candidates[:, 0], noise[:, 0] = policy_actions, 0
    return candidates, noise


def preselect(values: np.ndarray, keep: int, always: int) -> np.ndarray:
    """Find the actions that the critics value most.

    :param values: ``[n, proposals]``, from :func:`critic_values`.
    :param keep: number of actions to keep.
    :param always: number of first actions that are always kept.
    :return: ``[n, keep]``, indices of proposals, ascending.
    """
    values = np.where(np.isfinite(values), values, -np.inf)
    values[:, :always] = np.inf
    return best(values, keep)


def best(values: np.ndarray, keep: int) -> np.ndarray:
    """Find the highest values; of equal ones the first.

    :param values: ``[n, candidates]``.
    :param keep: number of values to keep.
    :return: ``[n, keep]``, their indices, ascending.
    """
    return np.sort(np.argsort(-values, axis=1, kind="stable")[:, :keep], axis=1)


def critic_values(
    observations: Observations, candidates: np.ndarray, functions: PolicyFunctions
) -> np.ndarray:
    """Rank candidates by the critics alone: the paper's first evaluation step.

    :param observations: ``[n, *obs_shape]``.
    :param candidates: ``[n, beam, act_dim]``.
    :param functions: the critics.
    :return: ``[n, beam]`` in float64.
    """
    n, beam, act_dim = candidates.shape
    repeated = take_rows(observations, np.repeat(np.arange(n), beam))
    values = functions.value(repeated, candidates.reshape(-1, act_dim))
    return values.reshape(n, beam).astype(np.float64)


def clip_actions(actions: np.ndarray) -> np.ndarray:
    """Clip to [-1, 1] in place; two ufuncs are faster than ``np.clip``.

    :param actions: array of any shape.
    :return: the same array.
    """
    return np.maximum(np.minimum(actions, 1, out=actions), -1, out=actions)


class RecentActions:
    """The last actions that an agent executed, in all its environments and episodes.

    :param act_dim: entries of one action.
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
        rows = (self._count + np.arange(len(actions))) % RECENT
        self._actions[rows[-RECENT:]] = actions[-RECENT:]
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
