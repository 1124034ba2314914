"""The cross-entropy method: rounds of plans around the best plans so far.

A candidate is a *plan*: offsets to the policy's actions at the next ``rollout_depth`` steps,
``a_t = clip(pi(s_t) + plan_t, -1, 1)``. Plans are rolled out like the candidates of Algorithm 1, but the
noise of later steps belongs to the plan. With ``noise_hold`` above 1 a plan has one offset per macro-step,
and axes of ``rollout_depth`` count macro-steps.
"""

from typing import NamedTuple

import numpy as np

from sb3_mcbs.search.beam import choose, join_rounds, mean_values, short_horizon
from sb3_mcbs.search.directions import combine, gain
from sb3_mcbs.search.interface import PolicyFunctions, Rollouts, Roots, SearchResult
from sb3_mcbs.search.proposals import Noise, best, critic_values, draw_normal, preselect, propose, scale
from sb3_mcbs.search.strategy_settings import CEMSettings


class Plans(NamedTuple):
    """The distribution of plans: independent Gaussians.

    :param mean: ``[n_envs, rollout_depth, act_dim]``.
    :param spread: ``[n_envs, rollout_depth, act_dim]``, standard deviations; with ``directions``
        ``[n_envs, rollout_depth, proposal_dims]``, along those.
    """

    mean: np.ndarray
    spread: np.ndarray


def draw_plan_noise(rng: np.random.Generator, settings: CEMSettings, n_envs: int, act_dim: int) -> np.ndarray:
    """Draw the noise of one decision, for all rounds at once.

    :param rng: draws the noise.
    :param settings: rounds, width and depth.
    :param n_envs: number of environments.
    :param act_dim: action dimensions.
    :return: ``[n_rounds, n_envs, proposals, rollout_depth, act_dim]``, with standard deviation 1.
    """
    n_proposals = settings.n_proposals or settings.beam_width
    shape = (settings.n_rounds, n_envs, n_proposals, settings.rollout_depth, act_dim)
    return draw_normal(rng, shape, 2 if settings.antithetic else None)


def cem_search(
    roots: Roots,
    functions: PolicyFunctions,
    settings: CEMSettings,
    noise: np.ndarray,
    rng: np.random.Generator,
    remembered: np.ndarray,
    directions: np.ndarray | None = None,
) -> SearchResult:
    """Choose one action per environment: the first action of the best plan of all rounds.

    :param roots: where the rollouts start.
    :param functions: networks, discount and scales.
    :param settings: rounds, width, depth, elites and spreads.
    :param noise: from :func:`draw_plan_noise`.
    :param rng: given to a model with random dynamics.
    :param remembered: ``[n_envs, rollout_depth, act_dim]``, the mean of the first round; 0 is the policy.
    :param directions: ``[proposal_dims, act_dim]``, in which plans differ from their mean; ``None``: all.
    :return: actions and details of the search, including the chosen plans.
    """
    policy_actions = functions.policy(roots.observations)
    dims = remembered.shape[2] if directions is None else len(directions)
    beginning = first_spread(settings) * np.float32(gain(directions))
    source = Plans(remembered, np.broadcast_to(beginning, (*remembered.shape[:2], dims)))
    plans: list[np.ndarray] = []
    rounds: list[Rollouts] = []
    for number, round_noise in enumerate(noise):
        if number:
            values = np.concatenate([each.values for each in rounds], axis=1)
            source = refit(source, np.concatenate(plans, axis=1), values, settings, beginning, directions)
        offsets = combine(round_noise[..., :dims] * source.spread[:, None], directions)
        # The whole plan is clipped, or its mean would drift over rounds and decisions.
        drawn = scale(source.mean[:, None] + offsets, 1.0, settings)
        always = _put_first(drawn, source.mean, settings.include_policy_action and number == 0)
        proposed, _ = propose(policy_actions, drawn[:, :, 0], include_policy_action=False)
        if settings.n_proposals is not None:
            by_critics = critic_values(roots.observations, proposed, functions)
            kept = preselect(by_critics, settings.beam_width, always)
            proposed = np.take_along_axis(proposed, kept[..., None], axis=1)
            drawn = np.take_along_axis(drawn, kept[..., None, None], axis=1)
        plans.append(drawn)
        noise_of_plans = _as_noise(drawn, settings.n_simulations)
        rounds.append(short_horizon(roots, proposed, functions, settings, noise_of_plans, rng))
    result = choose(policy_actions, join_rounds(rounds))
    chosen_plans = np.concatenate(plans, axis=1)[np.arange(len(policy_actions)), result.chosen]
    chosen_plans[result.chosen < 0] = 0
    return result._replace(rounds=settings.n_rounds, plans=chosen_plans)


def first_spread(settings: CEMSettings) -> np.ndarray:
    """Standard deviations of the first round: ``beam_noise`` now, ``rollout_noise`` later.

    :return: ``[rollout_depth, 1]``.
    """
    spread = np.full((settings.rollout_depth, 1), settings.effective_rollout_noise, dtype=np.float32)
    spread[0] = settings.beam_noise
    return spread


def refit(
    source: Plans,
    plans: np.ndarray,
    values: np.ndarray,
    settings: CEMSettings,
    beginning: np.ndarray,
    directions: np.ndarray | None,
) -> Plans:
    """Fit the Gaussians to the best plans so far.

    :param source: the last round's distribution; kept where no plan was valid.
    :param plans: ``[n_envs, candidates, rollout_depth, act_dim]``, of all rounds so far.
    :param values: ``[n_envs, candidates, sim]``, the plans' values.
    :param settings: the number of elites, and the lower bound of the spread.
    :param beginning: ``[rollout_depth, 1]``, standard deviations of the first round; limits the lower bound.
    :param directions: ``[proposal_dims, act_dim]``; ``None``: all.
    :return: mean and standard deviation of the elites.
    """
    means, _ = mean_values(values)
    elites = best(means, settings.effective_n_elites)
    valid = np.isfinite(np.take_along_axis(means, elites, axis=1))
    count = valid.sum(axis=1)
    weights = (valid / np.maximum(count, 1)[:, None]).astype(np.float32)[..., None, None]
    chosen = np.take_along_axis(plans, elites[..., None, None], axis=1)
    mean = (weights * chosen).sum(axis=1)
    deviations = chosen - mean[:, None]
    if directions is not None:
        deviations = deviations @ directions.T
    spread = np.sqrt((weights * np.square(deviations)).sum(axis=1))
    floor = np.minimum(beginning, np.float32(settings.min_noise * gain(directions)))
    none = (count == 0)[:, None, None]
    return Plans(np.where(none, source.mean, mean), np.where(none, source.spread, np.maximum(spread, floor)))


def _put_first(drawn: np.ndarray, mean: np.ndarray, with_policy: bool) -> int:
    """Make the mean the first plan and, where that differs, the policy alone the second.

    :return: the number of first plans that pre-selection always keeps.
    """
    drawn[:, 0] = mean
    if with_policy:
        drawn[mean.any(axis=(1, 2)), 1] = 0
    return 1 + with_policy


def _as_noise(plans: np.ndarray, n_simulations: int) -> Noise:
    """Plans as the noise of rollouts; the bootstrap uses the policy's own action."""
    later = np.concatenate([plans[:, :, 1:], np.zeros_like(plans[:, :, :1])], axis=2)
    by_depth = np.moveaxis(later, 2, 0)[:, :, :, None]
    shape = (*by_depth.shape[:3], n_simulations, by_depth.shape[4])
    return Noise(plans[:, :, 0], np.broadcast_to(by_depth, shape))
