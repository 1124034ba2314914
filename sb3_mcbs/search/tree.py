"""Partial tree expansion: at every depth the best nodes are kept and expanded.

Axes: ``slots`` for nodes per environment, some of them empty; ``sim`` simulations of each node. The forward
model holds one row per running simulation, ordered by environment, simulation and slot. A depth is a
macro-step of ``noise_hold`` environment steps.
"""

from typing import NamedTuple

import numpy as np

from sb3_mcbs.search.beam import choose
from sb3_mcbs.search.interface import (
    FirstStep,
    PolicyFunctions,
    Rollouts,
    Roots,
    SearchResult,
    stopped_values,
)
from sb3_mcbs.search.proposals import (
    best,
    clip_actions,
    critic_values,
    draw_normal,
    low_dimensional,
    preselect,
    propose,
    scale,
)
from sb3_mcbs.search.strategy_settings import TreeSettings
from sb3_mcbs.types import ForwardModel, Observations, take_rows


class TreeNoise(NamedTuple):
    """All random numbers of one decision.

    :param roots: ``[n_envs, 1, proposals, act_dim]``, for the root actions.
    :param later: ``[rollout_depth - 1, n_envs, beam, proposals / beam, act_dim]``, for kept nodes' actions.
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
    """Observations and the policy's actions in the rows of the forward model.

    :param observations: ``[rows, *obs_shape]``.
    :param policy_actions: ``[rows, act_dim]``; meaningless where a simulation has ended.
    """

    observations: Observations
    policy_actions: np.ndarray


class _Growth(NamedTuple):
    """The results of one depth.

    :param nodes: all children.
    :param view: of the forward model's rows after the last step.
    :param first_step: of every simulated child.
    :param steps: number of simulated steps.
    :param invalid: number of simulations that diverged or whose value is not finite.
    """

    nodes: _Nodes
    view: _View
    first_step: FirstStep
    steps: int
    invalid: int


def draw_tree_noise(
    rng: np.random.Generator,
    settings: TreeSettings,
    n_envs: int,
    act_dim: int,
    directions: np.ndarray | None = None,
) -> TreeNoise:
    """Draw the noise of one decision: first for the root actions, then depth by depth.

    :param rng: draws the noise.
    :param settings: width, branching, depth and noise.
    :param n_envs: number of environments.
    :param act_dim: action dimensions.
    :param directions: ``[proposal_dims, act_dim]``, in which children differ; ``None``: all.
    :return: the noise, clipped to ``noise_clip`` if that is set.
    """
    width, pairs = settings.beam_width, settings.antithetic
    n_proposals = settings.n_proposals or width * settings.branching
    roots = draw_normal(rng, (n_envs, 1, n_proposals, act_dim), 2 if pairs else None)
    shape = (settings.rollout_depth - 1, n_envs, width, n_proposals // width, act_dim)
    later = low_dimensional(draw_normal(rng, shape, 3 if pairs else None), directions)
    later = scale(later, settings.effective_rollout_noise, settings)
    roots = scale(low_dimensional(roots, directions), settings.beam_noise, settings)
    return TreeNoise(roots, later)


def tree_search(
    roots: Roots,
    functions: PolicyFunctions,
    settings: TreeSettings,
    noise: TreeNoise,
    rng: np.random.Generator,
) -> SearchResult:
    """Choose one action per environment: the root action of the best leaf.

    :param roots: where the tree starts.
    :param functions: networks, discount and scales.
    :param settings: width, branching, depth and simulations.
    :param noise: from :func:`draw_tree_noise`.
    :param rng: given to a model with random dynamics.
    :return: actions and details of the search.
    """
    model = roots.model
    assert model is not None, "a tree needs a forward model"
    width, n_sim = settings.beam_width, settings.distinct_simulations(model.deterministic)
    view = _View(roots.observations, functions.policy(roots.observations))
    policy_actions = view.policy_actions
    n_envs, n_roots = len(policy_actions), width * settings.branching
    nodes = _present(n_envs, n_sim)
    estimates = np.full((n_envs, n_roots), -np.inf)
    simulated_steps = invalid = 0
    for depth in range(settings.rollout_depth):
        children = n_roots if depth == 0 else settings.branching
        drawn = noise.roots if depth == 0 else noise.later[depth - 1]
        if not (nodes.rows >= 0).any():
            break
        actions, offsets = _children(nodes, view, drawn, children, functions, settings)
        parents = np.repeat(nodes.rows, children, axis=2)
        parents = parents[parents >= 0]
        if depth == 0:
            model.set_roots(roots.states, parents, rng)
        else:
            model.select(parents)
        growth = _grow(
            model, nodes, actions, offsets, children, depth * settings.noise_hold, functions, settings
        )
        if depth == 0:
            candidates = actions.reshape(n_envs, n_sim, n_roots, -1)[:, 0]
            first_step = _first_simulation(growth, n_envs, n_sim)
            growth = growth._replace(nodes=_numbered(growth.nodes))
        view = growth.view
        simulated_steps += growth.steps
        invalid += growth.invalid
        ranking = _join(growth.nodes, _finished(nodes))
        scores = _best_per_root(ranking, n_roots)
        estimates = np.where(np.isfinite(scores), scores, estimates)
        nodes = _keep_best(ranking, width)

    leaves = _best_per_root(nodes, n_roots)
    result = choose(policy_actions, Rollouts(candidates, leaves[..., None], first_step, simulated_steps))
    return result._replace(
        values=estimates, invalid_rollouts=invalid, surviving_roots=np.isfinite(leaves).sum(axis=1)
    )


def _present(n_envs: int, n_sim: int) -> _Nodes:
    """One node per environment for its current state; its row is the index of the root."""
    return _Nodes(
        scores=np.zeros((n_envs, 1)),
        roots=np.zeros((n_envs, 1), dtype=int),
        returns=np.zeros((n_envs, n_sim, 1)),
        rows=np.broadcast_to(np.arange(n_envs)[:, None, None], (n_envs, n_sim, 1)),
    )


def _numbered(nodes: _Nodes) -> _Nodes:
    """Children of the current state, each with its own root action."""
    return nodes._replace(roots=np.broadcast_to(np.arange(nodes.roots.shape[1]), nodes.roots.shape))


def _children(
    nodes: _Nodes,
    view: _View,
    drawn: np.ndarray,
    children: int,
    functions: PolicyFunctions,
    settings: TreeSettings,
) -> tuple[np.ndarray, np.ndarray]:
    """Propose actions in every running simulation.

    :param drawn: ``[n_envs, slots, proposals, act_dim]``, the nodes' noise.
    :param children: number of actions kept per node.
    :return: actions and their noise, ``[running simulations * children, act_dim]``.
    """
    goes_on = nodes.rows >= 0
    rows = nodes.rows[goes_on]
    noise = np.broadcast_to(drawn[:, None], (*goes_on.shape, *drawn.shape[2:]))[goes_on]
    actions, noise = propose(view.policy_actions[rows], noise, settings.include_policy_action)
    if settings.n_proposals is not None:
        values = np.zeros((*goes_on.shape, drawn.shape[2]))
        values[goes_on] = critic_values(take_rows(view.observations, rows), actions, functions)
        # All simulations of a node must have the same children, so the critics' mean decides.
        of_nodes = values.sum(axis=1).reshape(-1, drawn.shape[2])
        kept = preselect(of_nodes, children, int(settings.include_policy_action))
        kept = kept.reshape(len(drawn), 1, -1, children)
        kept = np.broadcast_to(kept, (*goes_on.shape, children))[goes_on]
        actions, noise = (np.take_along_axis(array, kept[..., None], axis=1) for array in (actions, noise))
    return actions.reshape(-1, actions.shape[2]), noise.reshape(-1, actions.shape[2])


def _grow(
    model: ForwardModel,
    nodes: _Nodes,
    actions: np.ndarray,
    offsets: np.ndarray,
    children: int,
    steps_before: int,
    functions: PolicyFunctions,
    settings: TreeSettings,
) -> _Growth:
    """Step the children in the forward model for a macro-step, and compute their scores.

    :param actions: ``[rows, act_dim]``, scaled actions of the first step.
    :param offsets: ``[rows, act_dim]``, added to the policy's actions in the later steps.
    :param steps_before: environment steps from the root to the nodes.
    """
    stepped = np.repeat(nodes.rows >= 0, children, axis=2)
    returns = np.repeat(nodes.returns, children, axis=2)
    totals, running, steps = returns[stepped], np.arange(len(actions)), 0
    for number in range(settings.noise_hold):
        step = model.step(functions.unscale_action(actions))
        steps += len(actions)
        if number == 0:
            first_step = FirstStep(take_rows(step.observations, slice(None)), step.rewards.copy())
        rewards = np.where(step.valid, functions.scale_reward(step.rewards), np.nan)
        totals[running] += functions.gamma ** (steps_before + number) * rewards
        if step.stopped is not None:
            stopped, values = stopped_values(step, functions)
            totals[running[stopped]] += functions.gamma ** (steps_before + number + 1) * values
        goes_on = step.goes_on
        view = _look(step.observations, goes_on, functions, actions.shape[1])
        stepping, running = running, running[goes_on]
        if not len(running):
            break
        if number + 1 < settings.noise_hold:
            actions = clip_actions(view.policy_actions[goes_on] + offsets[running])
            if not goes_on.all():
                model.select(np.flatnonzero(goes_on))
    returns[stepped] = totals
    if len(running):
        values = functions.value(take_rows(view.observations, goes_on), view.policy_actions[goes_on])
        totals[running] += functions.gamma ** (steps_before + settings.noise_hold) * values.astype(np.float64)
    with_values = returns.copy()
    with_values[stepped] = totals
    scores = with_values.mean(axis=1)
    # Nodes that were not expanded have no children.
    scores[~(np.isfinite(scores) & stepped.any(axis=1))] = -np.inf

    row_of = np.full(len(totals), -1)
    row_of[stepping] = np.where(goes_on, np.arange(len(goes_on)), -1)
    rows = np.full(stepped.shape, -1)
    rows[stepped] = row_of
    grown = _Nodes(scores, np.repeat(nodes.roots, children, axis=1), returns, rows)
    return _Growth(grown, view, first_step, steps, int(np.count_nonzero(~np.isfinite(totals))))


def _look(observations: Observations, goes_on: np.ndarray, functions: PolicyFunctions, act_dim: int) -> _View:
    """Observe rows of the forward model, and compute the policy's actions in running simulations."""
    policy_actions = np.zeros((len(goes_on), act_dim), dtype=np.float32)
    if goes_on.any():
        policy_actions[goes_on] = functions.policy(take_rows(observations, goes_on))
    return _View(take_rows(observations, slice(None)), policy_actions)


def _finished(nodes: _Nodes) -> _Nodes:
    """Nodes whose simulations have all ended: they are not expanded, and stay in the ranking."""
    ended = (nodes.rows < 0).all(axis=1)
    return nodes._replace(scores=np.where(ended, nodes.scores, -np.inf))


def _join(left: _Nodes, right: _Nodes) -> _Nodes:
    return _Nodes(*(np.concatenate(pair, axis=-1) for pair in zip(left, right, strict=True)))


def _keep_best(nodes: _Nodes, width: int) -> _Nodes:
    """Keep the best nodes of every environment.

    :param width: number of nodes to keep.
    :return: ``width`` slots: the kept nodes in their previous order, then empty ones.
    """
    kept = best(nodes.scores, width)
    # The forward model gathers rows in order, so empty slots must be at the end.
    kept_scores = np.take_along_axis(nodes.scores, kept, axis=1)
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


def _best_per_root(nodes: _Nodes, n_roots: int) -> np.ndarray:
    """The best score of each root action's nodes ``[n_envs, n_roots]``, -inf where there is none."""
    best_scores = np.full((len(nodes.scores), n_roots), -np.inf)
    np.maximum.at(best_scores, (np.arange(len(nodes.scores))[:, None], nodes.roots), nodes.scores)
    return best_scores


def _first_simulation(growth: _Growth, n_envs: int, n_sim: int) -> FirstStep:
    """The first step of every root action in its first simulation, ``[n_envs * n_roots]``."""
    observations, rewards = growth.first_step
    rows = np.arange(len(rewards)).reshape(n_envs, n_sim, -1)[:, 0].ravel()
    return FirstStep(take_rows(observations, rows), rewards[rows])
