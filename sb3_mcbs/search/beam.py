"""Monte Carlo Beam Search: Algorithm 1 of the paper for many environments at once.

Arrays in, arrays out. Actions are scaled to [-1, 1] here, as a policy network gives them.
Axes: ``n_envs`` environments, ``beam`` candidates, ``sim`` simulations, ``act_dim`` action entries.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sb3_mcbs.search.interface import FirstStep, PolicyFunctions, SearchResult, stopped_values
from sb3_mcbs.search.proposals import (
    Noise,
    clip_actions,
    critic_values,
    preselect,
    propose,
    without_first,
)
from sb3_mcbs.search.settings import SearchSettings
from sb3_mcbs.types import ForwardModel, Observations, take_rows

_ALL = slice(None)


class OutOfTimeError(Exception):
    """A round was given up before its rollouts were finished.

    :ivar simulated_steps: what it had simulated until then.
    """

    def __init__(self, simulated_steps: int) -> None:
        super().__init__(f"given up after {simulated_steps} simulated steps")
        self.simulated_steps = simulated_steps


def beam_search(
    model: ForwardModel | None,
    roots: Sequence[Any],
    observations: Observations,
    functions: PolicyFunctions,
    settings: SearchSettings,
    noise: Noise,
    rng: np.random.Generator,
) -> SearchResult:
    """Choose one action per environment (Algorithm 1, steps 1 to 3).

    :param model: simulates the candidates; may be ``None`` if ``rollout_depth`` is 0.
    :param roots: present states of the environments, from :meth:`ForwardModel.read_roots`.
    :param observations: ``[n_envs, *obs_shape]``, present observations.
    :param functions: networks, discount and scales.
    :param settings: width, depth and simulations.
    :param noise: from :func:`draw_noise`.
    :param rng: given to a model with random dynamics, see :meth:`ForwardModel.set_roots`.
    :return: actions, and what the search found.
    """
    policy_actions = functions.policy(observations)
    if settings.include_policy_action:
        noise = noise._replace(beam=without_first(noise.beam))
    candidates = propose(policy_actions, noise.beam, settings.include_policy_action)
    if settings.n_proposals is not None:
        by_critics = critic_values(observations, candidates, functions)
        kept = preselect(by_critics, settings.beam_width, always=int(settings.include_policy_action))
        candidates = np.take_along_axis(candidates, kept[..., None], axis=1)
        noise = noise._replace(beam=np.take_along_axis(noise.beam, kept[..., None], axis=1))
    if settings.rollout_depth == 0:
        values = critic_values(observations, candidates, functions)[..., None]
        return choose(policy_actions, candidates, values, None, 0)
    assert model is not None, "a rollout needs a forward model"
    evaluated = rollout_values(model, roots, candidates, functions, settings, noise, rng)
    return choose(policy_actions, candidates, *evaluated)


def choose(
    policy_actions: np.ndarray,
    candidates: np.ndarray,
    values: np.ndarray,
    first_step: FirstStep | None,
    simulated_steps: int,
) -> SearchResult:
    """Select the best candidates (Algorithm 1, step 3).

    :param policy_actions: ``[n_envs, act_dim]``, what is done where no candidate is valid.
    :param candidates: ``[n_envs, beam, act_dim]``.
    :param values: ``[n_envs, beam, sim]``, not finite where a simulation was invalid.
    :param first_step: of every candidate, ``[n_envs * beam]``.
    :param simulated_steps: how many.
    """
    means, invalid_rollouts = mean_values(values)
    chosen = means.argmax(axis=1)
    envs = np.arange(len(chosen))
    actions = candidates[envs, chosen]
    if first_step is not None:
        first_step = _take_first_step(first_step, envs * candidates.shape[1] + chosen)
    hopeless = ~np.isfinite(means[envs, chosen])
    if hopeless.any():
        actions[hopeless] = policy_actions[hopeless]
        chosen[hopeless] = -1
    return SearchResult(actions, chosen, candidates, means, first_step, simulated_steps, invalid_rollouts)


def mean_values(values: np.ndarray) -> tuple[np.ndarray, int]:
    """Average the simulations of each candidate (Algorithm 1, step 2).

    :param values: ``[n_envs, beam, sim]``, not finite where a simulation was invalid.
    :return: Q~_i ``[n_envs, beam]``, -inf where a simulation was invalid, and how many were.
    """
    finite = np.isfinite(values)
    invalid_rollouts = int(values.size - np.count_nonzero(finite))
    means = values.mean(axis=2)
    if invalid_rollouts:
        means = np.where(finite.all(axis=2), means, -np.inf)
    return means, invalid_rollouts


def rollout_values(
    model: ForwardModel,
    roots: Sequence[Any],
    candidates: np.ndarray,
    functions: PolicyFunctions,
    settings: SearchSettings,
    noise: Noise,
    rng: np.random.Generator,
    out_of_time: Callable[[], bool] = lambda: False,
) -> tuple[np.ndarray, FirstStep, int]:
    """Evaluate ShortHorizon for every environment, candidate and simulation (Algorithm 1, step 2).

    All rollouts advance together; the forward model holds one row for each of the ``unfinished`` ones, in
    order. In a deterministic environment the simulations of a candidate are one until their noise differs,
    after the first macro-step: until then a row stands for ``shared`` of them.

    :param candidates: ``[n_envs, beam, act_dim]``.
    :param noise: of those candidates: 0 where one is the policy's own action.
    :param out_of_time: asked before every step; True gives up.
    :return: values ``[n_envs, beam, sim]`` in float64 (NaN where a simulation was invalid), the first step of
        every candidate ``[n_envs * beam]``, and the number of simulated steps.
    :raises OutOfTimeError: if it gave up.
    """
    n_envs, beam, act_dim = candidates.shape
    hold, n_sim = settings.noise_hold, settings.distinct_simulations(model.deterministic)
    shared = n_sim if model.deterministic else 1
    n_first = n_sim // shared
    first_noise = np.repeat(noise.beam.reshape(-1, act_dim), n_first, axis=0)
    later_noise = noise.rollout[:, :, :, :n_sim].reshape(-1, n_envs * beam * n_sim, act_dim)

    returns = np.zeros(n_envs * beam * n_first)
    unfinished: np.ndarray | slice = _ALL
    discount = 1.0
    simulated_steps = 0
    model.set_roots(roots, np.repeat(np.arange(n_envs), beam * n_first), rng)
    actions = np.repeat(candidates.reshape(-1, act_dim), n_first, axis=0)
    for step_number in range(1, settings.horizon + 1):
        if out_of_time():
            raise OutOfTimeError(simulated_steps)
        step = model.step(functions.unscale_action(actions))
        observations = step.observations
        simulated_steps += len(actions)
        if step_number == 1:
            every_candidate = slice(None, None, n_first)
            first_step = FirstStep(
                take_rows(observations, every_candidate), step.rewards[every_candidate].copy()
            )
        rewards = functions.scale_reward(step.rewards)
        all_valid = step.valid.all()
        if not all_valid:
            rewards = np.where(step.valid, rewards, np.nan)
        returns[unfinished] += discount * rewards
        discount *= functions.gamma

        rows: np.ndarray | None = None  # which of the model's rows go on, if not all as they are
        if step.stopped is not None:
            stopped, values = stopped_values(step, functions)
            returns[np.arange(len(returns))[unfinished][stopped]] += discount * values
        if not all_valid or step.terminated.any() or step.stopped is not None:
            rows = np.flatnonzero(step.goes_on)
            if not len(rows):
                break
            unfinished = np.arange(len(returns))[unfinished][rows]
            observations = take_rows(observations, rows)
        # Simulations that are still one: the policy sees their observation once.
        actions = functions.policy(observations)
        is_last = step_number == settings.horizon
        if step_number == hold and shared > 1:
            returns, actions = np.repeat(returns, shared), np.repeat(actions, shared, axis=0)
            if unfinished is not _ALL:
                unfinished = _split(unfinished, shared)
            rows = np.repeat(np.arange(len(actions) // shared) if rows is None else rows, shared)
            if is_last:
                observations = take_rows(observations, np.arange(len(actions)) // shared)
        held = first_noise if step_number < hold else later_noise[step_number // hold - 1]
        actions = clip_actions(actions + held[unfinished])
        if is_last:
            returns[unfinished] += discount * functions.value(observations, actions).astype(np.float64)
        elif rows is not None:
            model.select(rows)
    # Simulations that ended before they differed have the same value.
    values = np.repeat(returns, n_envs * beam * n_sim // len(returns))
    return values.reshape(n_envs, beam, n_sim), first_step, simulated_steps


def _split(index: Any, into: int) -> np.ndarray:
    """The places of what each of some rows became."""
    return (index[:, None] * into + np.arange(into)).ravel()


def join_rounds(first_steps: list[FirstStep], n_envs: int) -> FirstStep:
    """Put the first steps of several rounds into the order of one.

    :param first_steps: each of ``[n_envs * width]`` candidates.
    :param n_envs: number of environments.
    :return: of all candidates, those of an environment next to one another.
    """

    def join(arrays: list[Any]) -> np.ndarray:
        by_env = [array.reshape(n_envs, -1, *array.shape[1:]) for array in arrays]
        return np.concatenate(by_env, axis=1).reshape(-1, *arrays[0].shape[1:])

    seen: list[Any] = [step.observations for step in first_steps]
    observations = (
        {key: join([one[key] for one in seen]) for key in seen[0]}
        if isinstance(seen[0], dict)
        else join(seen)
    )
    return FirstStep(observations, join([step.rewards for step in first_steps]))


def _take_first_step(first_step: FirstStep, index: np.ndarray) -> FirstStep:
    return FirstStep(take_rows(first_step.observations, index), first_step.rewards[index])
