"""Proposes candidates: noise around the policy's actions, and pre-selection by the critics.

All random numbers of a decision are drawn before the simulation, as float32 and in a fixed order, so they do
not depend on the simulation's results.
"""

from typing import NamedTuple

import numpy as np

from sb3_mcbs.search.directions import low_dimensional
from sb3_mcbs.search.interface import PolicyFunctions
from sb3_mcbs.search.settings import SearchSettings
from sb3_mcbs.types import Observations, take_rows


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
