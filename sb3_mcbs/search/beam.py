"""Monte Carlo Beam Search: Algorithm 1 of the paper for many environments at once.

Arrays in, arrays out. Actions are scaled to [-1, 1], as a policy network returns them.
Axes: ``n_envs`` environments, ``beam`` candidates, ``sim`` simulations, ``act_dim`` action dimensions.
Line numbers are those of the paper's Algorithm 1.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_mcbs.search.interface import (
    CountedValue,
    FirstStep,
    PolicyFunctions,
    Rollouts,
    Roots,
    SearchResult,
    stopped_values,
)
from sb3_mcbs.search.proposals import Noise, clip_actions, critic_values, preselect, propose
from sb3_mcbs.search.settings import SearchSettings
from sb3_mcbs.types import Transition, n_rows, take_rows


def beam_search(
    roots: Roots,
    functions: PolicyFunctions,
    settings: SearchSettings,
    noise: Noise,
    rng: np.random.Generator,
) -> SearchResult:
    """Choose one action per environment (Algorithm 1, lines 6 to 15).

    :param roots: where the rollouts start.
    :param functions: networks, discount and scales.
    :param settings: width, depth and simulations.
    :param noise: from :func:`draw_noise`.
    :param rng: given to a model with random dynamics, see :meth:`ForwardModel.set_roots`.
    :return: actions and details of the search.
    """
    policy_actions = functions.policy(roots.observations)
    candidates, beam_noise = propose(policy_actions, noise.beam, settings.include_policy_action)
    if settings.n_proposals is not None:
        by_critics = critic_values(roots.observations, candidates, functions)
        kept = preselect(by_critics, settings.beam_width, always=int(settings.include_policy_action))
        candidates, beam_noise = (
            np.take_along_axis(each, kept[..., None], axis=1) for each in (candidates, beam_noise)
        )
    if settings.rollout_depth == 0:
        values = critic_values(roots.observations, candidates, functions)[..., None]
        rollouts = Rollouts(candidates, values, None, 0)
    else:
        rollouts = short_horizon(roots, candidates, functions, settings, noise._replace(beam=beam_noise), rng)
    return choose(policy_actions, rollouts)


def short_horizon(
    roots: Roots,
    candidates: np.ndarray,
    functions: PolicyFunctions,
    settings: SearchSettings,
    noise: Noise,
    rng: np.random.Generator,
) -> Rollouts:
    """Evaluate ShortHorizon for every environment, candidate and simulation (Algorithm 1, lines 24 to 38).

    All rollouts advance together. In a deterministic environment the simulations of a candidate are identical
    until their noise differs, so the forward model holds one row for all of them until then.

    :param roots: where the rollouts start.
    :param candidates: ``[n_envs, beam, act_dim]``.
    :param functions: networks, discount and scales.
    :param settings: depth and simulations.
    :param noise: of those candidates; 0 for the policy's own action.
    :param rng: given to a model with random dynamics.
    :return: the rollouts' values. NaN where a simulation was invalid.
    """
    model = roots.model
    assert model is not None, "a rollout needs a forward model"
    if functions.rollout is not None:
        return compiled_short_horizon(roots, candidates, functions, settings, noise)
    n_envs, beam, act_dim = candidates.shape
    n_sim = settings.distinct_simulations(model.deterministic)
    # The rollouts that each row of the model represents.
    rollouts = np.arange(n_envs * beam * n_sim).reshape(-1, n_sim if model.deterministic else 1)
    returns, alpha, simulated_steps = np.zeros(rollouts.size), 1.0, 0  # line 25
    model.set_roots(roots.states, rollouts[:, 0] // (beam * n_sim), rng)
    actions = candidates.reshape(-1, act_dim)[rollouts[:, 0] // n_sim]
    for depth in range(1, settings.horizon + 1):  # line 26
        step = model.step(functions.unscale_action(actions))  # line 27
        simulated_steps += len(actions)
        if depth == 1:
            first_step = _of_first_simulations(step, len(actions) // (n_envs * beam))
        rewards = np.where(step.valid, functions.scale_reward(step.rewards), np.nan)
        returns[rollouts] += alpha * rewards[:, None]  # line 28
        alpha *= functions.gamma
        if step.stopped is not None:
            stopped, values = stopped_values(step, functions)
            returns[rollouts[stopped]] += alpha * values[:, None]
        rows = np.flatnonzero(step.goes_on)
        if not len(rows):  # lines 29 and 30
            break
        observations = step.observations
        if len(rows) < len(actions):
            rollouts, observations = rollouts[rows], take_rows(observations, rows)
        offsets = held_noise(noise, settings, depth, rollouts, n_sim)  # line 32
        proposed = clip_actions(functions.policy(observations)[:, None] + offsets)  # line 33
        actions, copies = proposed.reshape(-1, act_dim), proposed.shape[1]
        if copies > 1:  # from here on the simulations differ
            rows, rollouts = np.repeat(rows, copies), rollouts.reshape(-1, 1)
        if depth < settings.horizon and (copies > 1 or len(rows) < model.n_rows):
            model.select(rows)  # line 34
    else:
        if copies > 1:
            observations = take_rows(observations, np.repeat(np.arange(n_rows(observations)), copies))
        values = functions.value(observations, actions).astype(np.float64)  # line 36
        returns[rollouts] += alpha * values[:, None]  # line 37
    return Rollouts(candidates, returns.reshape(n_envs, beam, n_sim), first_step, simulated_steps)


def compiled_short_horizon(
    roots: Roots, candidates: np.ndarray, functions: PolicyFunctions, settings: SearchSettings, noise: Noise
) -> Rollouts:
    """:func:`short_horizon` where compiled code covers its loop (``models/compiled_rollout.py``)."""
    assert functions.rollout is not None
    n_envs, beam, act_dim = candidates.shape
    n_sim, hold = settings.distinct_simulations(deterministic=True), settings.noise_hold
    later = np.repeat(noise.rollout[:, :, :, :n_sim], hold, axis=0)[: settings.horizon - hold + 1]
    held = np.broadcast_to(noise.beam[:, :, None], (hold - 1, *later.shape[1:]))
    every_noise = np.concatenate([held, later]) if hold > 1 else later
    rolled = functions.rollout(
        roots.states,
        np.repeat(np.arange(n_envs), beam),
        candidates.reshape(-1, act_dim),
        every_noise.reshape(settings.horizon, n_envs * beam, n_sim, act_dim),
        hold,
    )
    if isinstance(functions.value, CountedValue):
        functions.value.count(int(np.count_nonzero(rolled.valid & ~rolled.terminated)))
    returns = np.where(rolled.valid, rolled.returns, np.nan)
    first_step = FirstStep(rolled.first_observations, rolled.first_rewards)
    return Rollouts(candidates, returns.reshape(n_envs, beam, n_sim), first_step, rolled.simulated_steps)


def held_noise(
    noise: Noise, settings: SearchSettings, depth: int, rollouts: np.ndarray, n_sim: int
) -> np.ndarray:
    """Select the noise of the actions after a step, from their macro-step.

    :param noise: all noise of the decision.
    :param settings: contain ``noise_hold``.
    :param depth: the step, counted from 1.
    :param rollouts: ``[rows, simulations]``, the rollouts that each row represents.
    :param n_sim: simulations per candidate.
    :return: ``[rows, simulations, act_dim]``, or ``[rows, 1, act_dim]`` in the first macro-step, where all
        simulations of a candidate share its noise.
    """
    act_dim = noise.beam.shape[-1]
    if depth < settings.noise_hold:
        return noise.beam.reshape(-1, act_dim)[rollouts[:, :1] // n_sim]
    later = noise.rollout[depth // settings.noise_hold - 1, :, :, :n_sim]
    return later.reshape(-1, act_dim)[rollouts]


def _of_first_simulations(step: Transition, n_sim: int) -> FirstStep:
    every_candidate = slice(None, None, n_sim)
    return FirstStep(take_rows(step.observations, every_candidate), step.rewards[every_candidate].copy())


def choose(policy_actions: np.ndarray, rollouts: Rollouts) -> SearchResult:
    """Select the best candidates (Algorithm 1, line 15).

    :param policy_actions: ``[n_envs, act_dim]``, executed where no candidate is valid.
    :param rollouts: of all candidates.
    :return: actions and details of the search.
    """
    candidates, values, first_step, simulated_steps = rollouts
    means, invalid_rollouts = mean_values(values)
    chosen = means.argmax(axis=1)
    envs = np.arange(len(chosen))
    actions = candidates[envs, chosen]
    if first_step is not None:
        index = envs * candidates.shape[1] + chosen
        first_step = FirstStep(take_rows(first_step.observations, index), first_step.rewards[index])
    hopeless = ~np.isfinite(means[envs, chosen])
    if hopeless.any():
        actions[hopeless] = policy_actions[hopeless]
        chosen[hopeless] = -1
    return SearchResult(actions, chosen, candidates, means, first_step, simulated_steps, invalid_rollouts)


def mean_values(values: np.ndarray) -> tuple[np.ndarray, int]:
    """Average the simulations of each candidate (Algorithm 1, line 13).

    :param values: ``[n_envs, beam, sim]``, not finite where a simulation was invalid.
    :return: Q~_i ``[n_envs, beam]``, -inf where a simulation was invalid, and the number of invalid ones.
    """
    finite = np.isfinite(values)
    invalid_rollouts = int(values.size - np.count_nonzero(finite))
    means = values.mean(axis=2)
    if invalid_rollouts:
        means = np.where(finite.all(axis=2), means, -np.inf)
    return means, invalid_rollouts


def join_rounds(rounds: Sequence[Rollouts]) -> Rollouts:
    """Concatenate the candidates of several rounds.

    :param rounds: rollouts of the same environments.
    :return: the rollouts of all candidates.
    """
    n_envs = len(rounds[0].candidates)

    def join(arrays: list[Any]) -> np.ndarray:
        by_env = [array.reshape(n_envs, -1, *array.shape[1:]) for array in arrays]
        return np.concatenate(by_env, axis=1).reshape(-1, *arrays[0].shape[1:])

    first_steps = [each.first_step for each in rounds if each.first_step is not None]
    seen: list[Any] = [step.observations for step in first_steps]
    observations = (
        {key: join([one[key] for one in seen]) for key in seen[0]}
        if isinstance(seen[0], dict)
        else join(seen)
    )
    return Rollouts(
        np.concatenate([each.candidates for each in rounds], axis=1),
        np.concatenate([each.values for each in rounds], axis=1),
        FirstStep(observations, join([step.rewards for step in first_steps])),
        sum(each.simulated_steps for each in rounds),
    )
