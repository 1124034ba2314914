"""Partial tree expansion: at every depth the best nodes are kept, and only those grow children.

Axes: ``slots`` places for nodes per environment, some of them empty; ``sim`` simulations of each node. The
forward model holds one row for each simulation that goes on, ordered by environment, simulation and slot.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_mcbs.models.base import ForwardModel, Observations
from sb3_mcbs.search.beam import choose
from sb3_mcbs.search.interface import Agent, FirstStep, SearchResult, take_rows
from sb3_mcbs.search.proposals import (
    best,
    critic_values,
    draw_normal,
    preselect,
    propose,
    scale,
)
from sb3_mcbs.search.settings import SearchSettings


class TreeNoise(NamedTuple):
    """All random numbers of one decision.

    :param roots: ``[n_envs, 1, proposals, act_dim]``, of the root actions.
    :param later: ``[rollout_depth - 1, n_envs, beam, proposals / beam, act_dim]``, of kept nodes' actions.
    """

    roots: np.ndarray
    later: np.ndarray


class _Nodes(NamedTuple):
    """Nodes of one depth.

    :param scores: ``[n_envs, slots]``, return so far plus discounted critic; -inf where the slot is empty.
    :param roots: ``[n_envs, slots]``, which root action the node grew from.
    :param returns: ``[n_envs, sim, slots]``, discounted rewards so far.
    :param rows: ``[n_envs, sim, slots]``, the forward model's row; -1 where the simulation has ended.
    """

    scores: np.ndarray
    roots: np.ndarray
    returns: np.ndarray
    rows: np.ndarray


class _View(NamedTuple):
    """What the agent sees and does in the rows of the forward model.

    :param observations: ``[rows, *obs_shape]``.
    :param policy_actions: ``[rows, act_dim]``; meaningless where a simulation has ended.
    """

    observations: Observations
    policy_actions: np.ndarray


class _Growth(NamedTuple):
    """What one depth brought.

    :param nodes: all children.
    :param view: of the rows after the step.
    :param rewards: ``[rows]``, of the environment.
    :param invalid: rows that diverged or whose value is not finite.
    """

    nodes: _Nodes
    view: _View
    rewards: np.ndarray
    invalid: int


def draw_tree_noise(
    rng: np.random.Generator, settings: SearchSettings, n_envs: int, act_dim: int
) -> TreeNoise:
    """Draw the noise of one decision: first that of the root actions, then depth by depth.

    :param rng: generator of the search.
    :param settings: width, branching, depth and noise.
    :param n_envs: number of environments.
    :param act_dim: entries of one action.
    :return: the noise, clipped to ``noise_clip`` if that is set.
    """
    width, pairs = settings.beam_width, settings.antithetic
    n_proposals = settings.n_proposals or width * settings.branching
    roots = draw_normal(rng, (n_envs, 1, n_proposals, act_dim), 2 if pairs else None)
    nodes = 1 if settings.common_noise else width
    shape = (settings.rollout_depth - 1, n_envs, nodes, n_proposals // width, act_dim)
    later = scale(draw_normal(rng, shape, 3 if pairs else None), settings.effective_rollout_noise, settings)
    everywhere = np.broadcast_to(later, (*shape[:2], width, *shape[3:]))
    return TreeNoise(scale(roots, settings.beam_noise, settings), everywhere)


def tree_search(
    model: ForwardModel,
    roots: Sequence[Any],
    observations: Observations,
    agent: Agent,
    settings: SearchSettings,
    noise: TreeNoise,
    rng: np.random.Generator,
) -> SearchResult:
    """Choose one action per environment: the root action of the best leaf.

    :param model: simulates the nodes.
    :param roots: present states of the environments.
    :param observations: ``[n_envs, *obs_shape]``, present observations.
    :param agent: networks, discount and scales.
    :param settings: width, branching, depth and simulations.
    :param noise: from :func:`draw_tree_noise`.
    :param rng: given to a model with random dynamics.
    :return: actions, and what the search found.
    """
    width, n_sim = settings.beam_width, settings.distinct_simulations(model.deterministic)
    view = _View(observations, agent.policy(observations))
    policy_actions = view.policy_actions
    n_envs, n_roots = len(policy_actions), width * settings.branching
    nodes = _present(n_envs, n_sim)
    estimates = np.full((n_envs, n_roots), -np.inf)
    simulated_steps = invalid = 0
    for depth in range(settings.rollout_depth):
        children = n_roots if depth == 0 else settings.branching
        drawn = noise.roots if depth == 0 else noise.later[depth - 1]
        actions = _child_actions(nodes, view, drawn, children, agent, settings)
        if not len(actions):
            break
        parents = np.repeat(nodes.rows, children, axis=2)
        parents = parents[parents >= 0]
        if depth == 0:
            model.set_roots(roots, parents, rng)
        else:
            model.select(parents)
        growth = _grow(model, nodes, actions, children, depth, agent)
        if depth == 0:
            candidates = actions.reshape(n_envs, n_sim, n_roots, -1)[:, 0]
            first_step = _first_simulation(growth, n_envs, n_sim)
            growth = growth._replace(nodes=_numbered(growth.nodes))
        view = growth.view
        simulated_steps += len(actions)
        invalid += growth.invalid
        ranking = _join(growth.nodes, _finished(nodes))
        scores = _best_per_root(ranking, n_roots)
        estimates = np.where(np.isfinite(scores), scores, estimates)
        nodes = _keep_best(ranking, width, settings.one_node_per_root)

    leaves = _best_per_root(nodes, n_roots)
    result = choose(policy_actions, candidates, leaves[..., None], first_step, simulated_steps)
    return result._replace(
        values=estimates, invalid_rollouts=invalid, surviving_roots=np.isfinite(leaves).sum(axis=1)
    )


def _present(n_envs: int, n_sim: int) -> _Nodes:
    """One node per environment: its present state, whose row is the number of its root."""
    return _Nodes(
        scores=np.zeros((n_envs, 1)),
        roots=np.zeros((n_envs, 1), dtype=int),
        returns=np.zeros((n_envs, n_sim, 1)),
        rows=np.broadcast_to(np.arange(n_envs)[:, None, None], (n_envs, n_sim, 1)),
    )


def _numbered(nodes: _Nodes) -> _Nodes:
    """Children of the present state: each is a root action of its own."""
    return nodes._replace(roots=np.broadcast_to(np.arange(nodes.roots.shape[1]), nodes.roots.shape))


def _child_actions(
    nodes: _Nodes, view: _View, drawn: np.ndarray, children: int, agent: Agent, settings: SearchSettings
) -> np.ndarray:
    """Propose actions in every simulation that goes on.

    :param drawn: ``[n_envs, slots, proposals, act_dim]``, the nodes' noise.
    :param children: how many actions are kept per node.
    :return: ``[simulations that go on * children, act_dim]``.
    """
    goes_on = nodes.rows >= 0
    rows = nodes.rows[goes_on]
    noise = np.broadcast_to(drawn[:, None], (*goes_on.shape, *drawn.shape[2:]))[goes_on]
    actions = propose(view.policy_actions[rows], noise, settings.include_policy_action)
    if settings.n_proposals is not None:
        values = np.zeros((*goes_on.shape, drawn.shape[2]))
        values[goes_on] = critic_values(take_rows(view.observations, rows), actions, agent)
        # Every simulation of a node must take the same children, so that the critics' mean decides.
        of_nodes = values.sum(axis=1).reshape(-1, drawn.shape[2])
        kept = preselect(of_nodes, children, int(settings.include_policy_action))
        kept = kept.reshape(len(drawn), 1, -1, children)
        kept = np.broadcast_to(kept, (*goes_on.shape, children))[goes_on]
        actions = np.take_along_axis(actions, kept[..., None], axis=1)
    return actions.reshape(-1, actions.shape[2])


def _grow(
    model: ForwardModel, nodes: _Nodes, actions: np.ndarray, children: int, depth: int, agent: Agent
) -> _Growth:
    """Step the children, whose rows the forward model holds, and value them.

    :param actions: ``[rows, act_dim]``, scaled.
    """
    step = model.step(agent.unscale_action(actions))
    rewards = np.where(step.valid, agent.scale_reward(step.rewards), np.nan)
    stepped = np.repeat(nodes.rows >= 0, children, axis=2)
    returns = np.repeat(nodes.returns, children, axis=2)
    returns[stepped] += agent.gamma**depth * rewards

    goes_on = step.valid & ~step.terminated
    policy_actions = np.zeros_like(actions)
    row_totals = returns[stepped]
    if goes_on.any():
        observations = take_rows(step.observations, goes_on)
        policy_actions[goes_on] = agent.policy(observations)
        values = agent.value(observations, policy_actions[goes_on]).astype(np.float64)
        row_totals[goes_on] += agent.gamma ** (depth + 1) * values
    totals = returns.copy()
    totals[stepped] = row_totals
    scores = totals.mean(axis=1)
    # A node that did not grow has no children.
    scores[~(np.isfinite(scores) & stepped.any(axis=1))] = -np.inf

    rows = np.full(stepped.shape, -1)
    rows[stepped] = np.where(goes_on, np.arange(len(goes_on)), -1)
    grown = _Nodes(scores, np.repeat(nodes.roots, children, axis=1), returns, rows)
    view = _View(take_rows(step.observations, slice(None)), policy_actions)
    return _Growth(grown, view, step.rewards.copy(), int(np.count_nonzero(~np.isfinite(row_totals))))


def _finished(nodes: _Nodes) -> _Nodes:
    """Nodes whose simulations have all ended: they grow no more, and stay in the ranking as they are."""
    ended = (nodes.rows < 0).all(axis=1)
    return nodes._replace(scores=np.where(ended, nodes.scores, -np.inf))


def _join(left: _Nodes, right: _Nodes) -> _Nodes:
    return _Nodes(*(np.concatenate(pair, axis=-1) for pair in zip(left, right, strict=True)))


def _keep_best(nodes: _Nodes, width: int, one_per_root: bool) -> _Nodes:
    """Keep the best nodes of every environment.

    :param width: how many.
    :param one_per_root: whether the other nodes of a root action go.
    :return: ``width`` slots: the kept nodes in the order in which they were, then empty ones.
    """
    scores = _only_best_of_root(nodes) if one_per_root else nodes.scores
    kept = best(scores, width)
    # The forward model gathers rows in order, so empty slots go to the end instead of in between.
    kept_scores = np.take_along_axis(scores, kept, axis=1)
    order = np.argsort(np.isneginf(kept_scores), axis=1, kind="stable")
    kept, kept_scores = (np.take_along_axis(array, order, axis=1) for array in (kept, kept_scores))
    in_simulations = np.broadcast_to(kept[:, None], (*nodes.rows.shape[:2], width))
    rows = np.take_along_axis(nodes.rows, in_simulations, axis=2)
    return _Nodes(
        scores=kept_scores,
        roots=np.take_along_axis(nodes.roots, kept, axis=1),
        returns=np.take_along_axis(nodes.returns, in_simulations, axis=2),
        rows=np.where(np.isneginf(kept_scores)[:, None], -1, rows),
    )


def _only_best_of_root(nodes: _Nodes) -> np.ndarray:
    """Scores ``[n_envs, slots]`` that are -inf but for the best node of each root action."""
    order = np.lexsort((-nodes.scores, nodes.roots))
    sorted_roots = np.take_along_axis(nodes.roots, order, axis=1)
    is_first = np.ones_like(order, dtype=bool)
    is_first[:, 1:] = sorted_roots[:, 1:] != sorted_roots[:, :-1]
    is_best = np.empty_like(is_first)
    np.put_along_axis(is_best, order, is_first, axis=1)
    return np.where(is_best, nodes.scores, -np.inf)


def _best_per_root(nodes: _Nodes, n_roots: int) -> np.ndarray:
    """The best score of each root action's nodes ``[n_envs, n_roots]``, -inf where there is none."""
    best_scores = np.full((len(nodes.scores), n_roots), -np.inf)
    np.maximum.at(best_scores, (np.arange(len(nodes.scores))[:, None], nodes.roots), nodes.scores)
    return best_scores


def _first_simulation(growth: _Growth, n_envs: int, n_sim: int) -> FirstStep:
    """The first step of every root action in its first simulation, ``[n_envs * n_roots]``."""
    rows = np.arange(len(growth.rewards)).reshape(n_envs, n_sim, -1)[:, 0].ravel()
    return FirstStep(take_rows(growth.view.observations, rows), growth.rewards[rows])
