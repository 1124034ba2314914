"""Monte Carlo Beam Search: Algorithm 1 of the paper for many environments at once.

Arrays in, arrays out. Actions are scaled to [-1, 1] here, as a policy network gives them.
Axes: ``n_envs`` environments, ``beam`` candidates, ``sim`` simulations, ``act_dim`` action entries.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_mcbs.models.base import ForwardModel, Observations
from sb3_mcbs.search.settings import SearchSettings

_ALL = slice(None)


class Agent(NamedTuple):
    """What a search has to know of the agent.

    :param policy: observations ``[rows, ...]`` -> actions ``[rows, act_dim]`` in [-1, 1], without
        exploration noise.
    :param value: observations ``[rows, ...]``, scaled actions ``[rows, act_dim]`` -> the critics'
        estimate of the return ``[rows]``, already the minimum over the critics.
    :param gamma: discount factor per environment step.
    :param unscale_action: scaled actions ``[rows, act_dim]`` -> actions of the environment.
    :param scale_reward: rewards of the environment ``[rows]`` -> the scale that the critics know.
    """

    policy: Callable[[Observations], np.ndarray]
    value: Callable[[Observations, np.ndarray], np.ndarray]
    gamma: float
    unscale_action: Callable[[np.ndarray], np.ndarray]
    scale_reward: Callable[[np.ndarray], np.ndarray]


class Noise(NamedTuple):
    """All random numbers of one decision.

    :param beam: ``[n_envs, beam, act_dim]``, eta_i in Algorithm 1.
    :param rollout: ``[rollout_depth, n_envs, beam, sim, act_dim]``, eta in ShortHorizon.
    """

    beam: np.ndarray
    rollout: np.ndarray


class FirstStep(NamedTuple):
    """What the forward model says that the chosen actions will do.

    :param observations: ``[n_envs, *obs_shape]``.
    :param rewards: ``[n_envs]``, of the environment.
    """

    observations: Observations
    rewards: np.ndarray


class SearchResult(NamedTuple):
    """The outcome of one decision in every environment.

    :param actions: ``[n_envs, act_dim]``, the actions to execute, scaled.
    :param chosen: ``[n_envs]``, which candidate that is; -1 where every candidate was invalid and the
        policy's own action was taken.
    :param candidates: ``[n_envs, beam, act_dim]``.
    :param values: ``[n_envs, beam]``, Q~_i; -inf where a simulation of the candidate was invalid.
    :param first_step: the chosen candidates' first simulated step (of their first simulation);
        ``None`` if nothing was simulated. Meaningless where ``chosen`` is -1.
    :param simulated_steps: environment steps that were simulated, each counted once.
    :param invalid_rollouts: rollouts that diverged or whose value is not finite.
    :param rounds: finished rounds: 1, or any number if the search had a time budget.
    """

    actions: np.ndarray
    chosen: np.ndarray
    candidates: np.ndarray
    values: np.ndarray
    first_step: FirstStep | None
    simulated_steps: int
    invalid_rollouts: int
    rounds: int = 1


class OutOfTimeError(Exception):
    """A round was given up before its rollouts were finished.

    :ivar simulated_steps: what it had simulated until then.
    """

    def __init__(self, simulated_steps: int) -> None:
        super().__init__(f"given up after {simulated_steps} simulated steps")
        self.simulated_steps = simulated_steps


def draw_noise(
    rng: np.random.Generator,
    settings: SearchSettings,
    n_envs: int,
    act_dim: int,
    beam_width: int | None = None,
) -> Noise:
    """Draw the noise of one decision.

    :param rng: generator of the search.
    :param settings: width, depth, simulations and noise scales.
    :param n_envs: number of environments.
    :param act_dim: entries of one action.
    :param beam_width: candidates; ``None``: as many as the settings say.
    :return: the noise, clipped to ``noise_clip`` if that is set.
    """
    b, d, n = beam_width or settings.beam_width, settings.rollout_depth, settings.n_simulations
    beam = _gaussian(rng, (n_envs, b, act_dim), settings.beam_noise, settings.noise_clip)
    rollout = _gaussian(
        rng, (d, n_envs, b, n, act_dim), settings.effective_rollout_noise, settings.noise_clip
    )
    return Noise(beam, rollout)


def beam_search(
    model: ForwardModel | None,
    roots: Sequence[Any],
    observations: Observations,
    agent: Agent,
    settings: SearchSettings,
    noise: Noise,
    rng: np.random.Generator,
) -> SearchResult:
    """Choose one action per environment (Algorithm 1, steps 1 to 3).

    :param model: simulates the candidates; may be ``None`` if ``rollout_depth`` is 0.
    :param roots: present states of the environments, from :meth:`ForwardModel.read_roots`.
    :param observations: ``[n_envs, *obs_shape]``, present observations.
    :param agent: networks, discount and scales.
    :param settings: width, depth and simulations.
    :param noise: from :func:`draw_noise`.
    :param rng: given to a model with random dynamics, see :meth:`ForwardModel.set_roots`.
    :return: actions, and what the search found.
    """
    policy_actions = agent.policy(observations)
    candidates = propose(policy_actions, noise.beam, settings.include_policy_action)
    if settings.rollout_depth == 0:
        values = _critic_values(observations, candidates, agent)[..., None]
        return choose(policy_actions, candidates, values, None, 0)
    assert model is not None, "a rollout needs a forward model"
    rollouts = rollout_values(model, roots, candidates, agent, settings, noise, rng)
    return choose(policy_actions, candidates, *rollouts)


def propose(policy_actions: np.ndarray, noise: np.ndarray, include_policy_action: bool) -> np.ndarray:
    """Generate candidate actions (Algorithm 1, step 1).

    :param policy_actions: ``[n_envs, act_dim]``.
    :param noise: ``[n_envs, beam, act_dim]``.
    :param include_policy_action: whether the first candidate has no noise.
    :return: ``[n_envs, beam, act_dim]`` in [-1, 1].
    """
    candidates = _clip(policy_actions[:, None] + noise)
    if include_policy_action:
        candidates[:, 0] = policy_actions
    return candidates


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
    finite = np.isfinite(values)
    invalid_rollouts = int(values.size - np.count_nonzero(finite))
    means = values.mean(axis=2)
    if invalid_rollouts:
        means = np.where(finite.all(axis=2), means, -np.inf)
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


def rollout_values(
    model: ForwardModel,
    roots: Sequence[Any],
    candidates: np.ndarray,
    agent: Agent,
    settings: SearchSettings,
    noise: Noise,
    rng: np.random.Generator,
    out_of_time: Callable[[], bool] = lambda: False,
) -> tuple[np.ndarray, FirstStep, int]:
    """Evaluate ShortHorizon for every environment, candidate and simulation (Algorithm 1, step 2).

    All rollouts advance together. The forward model holds one row for each of the ``unfinished``
    rollouts, in order, and then ``row_of`` is None; otherwise ``row_of`` says which row is whose:
    the simulations of a candidate share one in the first step of a deterministic environment, and
    rows of rollouts that ended are not yet dropped.

    :param candidates: ``[n_envs, beam, act_dim]``.
    :param noise: of ``beam`` candidates at least.
    :param out_of_time: asked before every step; True gives up.
    :return: values ``[n_envs, beam, sim]`` in float64 (NaN where a simulation was invalid), the first step of
        every candidate ``[n_envs * beam]``, and the number of simulated steps.
    :raises OutOfTimeError: if it gave up.
    """
    n_envs, beam, act_dim = candidates.shape
    depth_limit, n_sim = settings.rollout_depth, settings.n_simulations
    if model.deterministic and settings.effective_rollout_noise == 0:
        n_sim = 1  # all simulations of a candidate would be the same
    n_first = 1 if model.deterministic else n_sim
    n_rollouts = n_envs * beam * n_sim
    rollout_noise = noise.rollout[:, :, :, :n_sim].reshape(depth_limit, n_rollouts, act_dim)

    returns = np.zeros(n_rollouts)
    unfinished: np.ndarray | slice = _ALL
    row_of = np.arange(n_rollouts) // n_sim if n_first < n_sim else None
    discount = 1.0
    simulated_steps = 0

    model.set_roots(roots, np.repeat(np.arange(n_envs), beam * n_first), rng)
    actions = np.repeat(candidates.reshape(-1, act_dim), n_first, axis=0)
    for depth in range(depth_limit):
        if out_of_time():
            raise OutOfTimeError(simulated_steps)
        step = model.step(agent.unscale_action(actions))
        observations = step.observations
        simulated_steps += len(actions)
        if depth == 0:
            first_step = FirstStep(
                _take(observations, slice(None, None, n_first)), step.rewards[::n_first].copy()
            )
        rewards = agent.scale_reward(step.rewards)
        all_valid = step.valid.all()
        if not all_valid:
            rewards = np.where(step.valid, rewards, np.nan)
        returns[unfinished] += discount * _spread(rewards, row_of)
        discount *= agent.gamma

        # Simulations of one candidate share their first observation: the policy sees it once.
        observation_of = row_of
        if not all_valid or step.terminated.any():
            open_rows = step.valid & ~step.terminated
            rows = np.arange(len(open_rows)) if row_of is None else row_of
            still_open = open_rows[rows]
            row_of = rows[still_open]
            unfinished = np.arange(n_rollouts)[unfinished][still_open]
            if not len(row_of):
                break
            observations = _take(observations, open_rows)
            observation_of = (np.cumsum(open_rows) - 1)[row_of]
        actions = _spread(agent.policy(observations), observation_of)
        actions = _clip(actions + rollout_noise[depth, unfinished])
        if depth + 1 < depth_limit:
            if row_of is not None:
                model.select(row_of)
                row_of = None
        else:
            if observation_of is not None:
                observations = _take(observations, observation_of)
            returns[unfinished] += discount * agent.value(observations, actions).astype(np.float64)
    return returns.reshape(n_envs, beam, n_sim), first_step, simulated_steps


def _critic_values(observations: Observations, candidates: np.ndarray, agent: Agent) -> np.ndarray:
    """Rank candidates by the critics alone: the paper's first evaluation step.

    :return: ``[n_envs, beam]``.
    """
    n_envs, beam, act_dim = candidates.shape
    repeated = _take(observations, np.repeat(np.arange(n_envs), beam))
    values = agent.value(repeated, candidates.reshape(-1, act_dim))
    return values.reshape(n_envs, beam).astype(np.float64)


def _gaussian(
    rng: np.random.Generator, shape: tuple[int, ...], scale: float, clip: float | None
) -> np.ndarray:
    noise = rng.standard_normal(shape, dtype=np.float32)
    noise *= np.float32(scale)
    if clip is not None:
        np.clip(noise, -clip, clip, out=noise)
    return noise


def _clip(actions: np.ndarray) -> np.ndarray:
    """Clip to [-1, 1] in place; two ufuncs are quicker than ``np.clip``."""
    return np.maximum(np.minimum(actions, 1, out=actions), -1, out=actions)


def _spread(values: np.ndarray, index: np.ndarray | None) -> np.ndarray:
    return values if index is None else values[index]


def _take(observations: Observations, index: np.ndarray | slice) -> Observations:
    """Copy rows out of observations."""
    if isinstance(observations, dict):
        return {key: value[index].copy() for key, value in observations.items()}
    return observations[index].copy()


def _take_first_step(first_step: FirstStep, index: np.ndarray) -> FirstStep:
    return FirstStep(_take(first_step.observations, index), first_step.rewards[index])
