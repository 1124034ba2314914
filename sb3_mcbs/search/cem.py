"""The cross-entropy method: rounds of plans around the best plans so far.

A candidate is a *plan*: offsets to the policy's actions at the next ``rollout_depth`` steps,
``a_t = clip(pi(s_t) + plan_t, -1, 1)``. Plans are rolled out like the candidates of Algorithm 1, but the
noise of later steps belongs to the plan. With ``noise_hold`` above 1 a plan has one offset per macro-step,
and axes of ``rollout_depth`` count macro-steps.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_mcbs.search.beam import choose, join_rounds, mean_values, short_horizon
from sb3_mcbs.search.interface import PolicyFunctions, Rollouts, Roots, SearchResult
from sb3_mcbs.search.proposals import (
    Noise,
    best,
    combine,
    critic_values,
    draw_normal,
    gain,
    preselect,
    propose,
    scale,
)
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


#: When a decision was made: how often its environment had been reset or restored, and the steps since then.
EpisodeClock = tuple[int, int]


class WarmStart:
    """The plan that was followed last in every environment.

    A plan is for the steps right after its decision. It is recalled for what is left of it then, and not at
    all if the environment was reset or restored since.

    :param n_envs: number of environments.
    :param horizon: environment steps of a plan.
    :param act_dim: entries of one action.
    """

    def __init__(self, n_envs: int, horizon: int, act_dim: int) -> None:
        #: By environment step: a decision's macro-steps need not begin where those of the last one did.
        self._plans = np.zeros((n_envs, horizon, act_dim), dtype=np.float32)
        self._episode_clocks: list[EpisodeClock | None] = [None] * n_envs

    def recall(self, envs: Sequence[int], now: Sequence[EpisodeClock], noise_hold: int = 1) -> np.ndarray:
        """Shift the plans by the steps since their decisions.

        :param envs: the environments that decide.
        :param now: the episode clock of each, at present.
        :param noise_hold: environment steps in a macro-step.
        :return: ``[len(envs), rollout_depth, act_dim]``, by macro-steps; 0 where nothing is left.
        """
        horizon = self._plans.shape[1]
        recalled = np.zeros((len(envs), *self._plans.shape[1:]), dtype=self._plans.dtype)
        for row, (env, age) in enumerate(zip(envs, self._ages(envs, now), strict=True)):
            if 0 <= age < horizon:
                recalled[row, : horizon - age] = self._plans[env, age:]
        return recalled.reshape(len(envs), -1, noise_hold, recalled.shape[2]).mean(axis=2)

    def keep(self, plans: np.ndarray, envs: Sequence[int], now: Sequence[EpisodeClock]) -> None:
        """Remember the plans of a decision.

        :param plans: ``[len(envs), rollout_depth, act_dim]``, by macro-steps.
        :param envs: indices of the environments.
        :param now: the current episode clock of each.
        """
        by_step = np.repeat(plans, self._plans.shape[1] // plans.shape[1], axis=1)
        for plan, env, clock in zip(by_step, envs, now, strict=True):
            self._plans[env] = plan
            self._episode_clocks[env] = clock

    def _ages(self, envs: Sequence[int], now: Sequence[EpisodeClock]) -> list[int]:
        """Steps since the decisions; -1 where there is no plan for this episode."""
        thens = [self._episode_clocks[env] for env in envs]
        return [
            present[1] - then[1] if then is not None and then[0] == present[0] else -1
            for then, present in zip(thens, now, strict=True)
        ]

    def state(self, now: Sequence[EpisodeClock]) -> dict[str, Any]:
        """The state for :meth:`set_state`, as plain values that do not depend on the number of resets.

        :param now: the current episode clock of every environment.
        :return: the plans and their ages.
        """
        return {"plans": self._plans.copy(), "ages": self._ages(range(len(now)), now)}

    def set_state(self, state: dict[str, Any], now: Sequence[EpisodeClock]) -> None:
        """Restore a state.

        :param state: from :meth:`state`.
        :param now: the current episode clock of every environment, each in its state at that time.
        """
        self._plans[:] = state["plans"]
        self._episode_clocks = [
            (resets, steps - age) if age >= 0 else None
            for (resets, steps), age in zip(now, state["ages"], strict=True)
        ]
