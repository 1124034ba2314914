"""Monte Carlo Beam Search: Algorithm 1 of the paper for many environments at once.

Arrays in, arrays out. Actions are scaled to [-1, 1] here, as a policy network gives them.
Axes: ``n_envs`` environments, ``beam`` candidates, ``sim`` simulations, ``act_dim`` action entries.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sb3_mcbs.models.base import ForwardModel, Observations, Transition
from sb3_mcbs.search.interface import (
    Agent,
    FirstStep,
    Rollouts,
    SearchResult,
    map_arrays,
    put_rows,
    take_rows,
)
from sb3_mcbs.search.proposals import (
    Noise,
    clip_actions,
    critic_values,
    preselect,
    propose,
)
from sb3_mcbs.search.settings import SearchSettings

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
    agent: Agent,
    settings: SearchSettings,
    noise: Noise,
    rng: np.random.Generator,
    record: bool = False,
) -> SearchResult:
    """Choose one action per environment (Algorithm 1, steps 1 to 3).

    :param model: simulates the candidates; may be ``None`` if ``rollout_depth`` is 0.
    :param roots: present states of the environments, from :meth:`ForwardModel.read_roots`.
    :param observations: ``[n_envs, *obs_shape]``, present observations.
    :param agent: networks, discount and scales.
    :param settings: width, depth and simulations.
    :param noise: from :func:`draw_noise`.
    :param rng: given to a model with random dynamics, see :meth:`ForwardModel.set_roots`.
    :param record: whether the result holds the rollouts, if there are any.
    :return: actions, and what the search found.
    """
    policy_actions = agent.policy(observations)
    candidates = propose(policy_actions, noise.beam, settings.include_policy_action)
    if settings.n_proposals is not None:
        by_critics = critic_values(observations, candidates, agent)
        kept = preselect(by_critics, settings.beam_width, always=int(settings.include_policy_action))
        candidates = np.take_along_axis(candidates, kept[..., None], axis=1)
    if settings.rollout_depth == 0:
        values = critic_values(observations, candidates, agent)[..., None]
        return choose(policy_actions, candidates, values, None, 0)
    assert model is not None, "a rollout needs a forward model"
    recorder = RolloutRecorder(settings.rollout_depth) if record else None
    evaluated = rollout_values(model, roots, candidates, agent, settings, noise, rng, recorder=recorder)
    result = choose(policy_actions, candidates, *evaluated)
    return result if recorder is None else result._replace(rollouts=recorder.rollouts(candidates))


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
    agent: Agent,
    settings: SearchSettings,
    noise: Noise,
    rng: np.random.Generator,
    out_of_time: Callable[[], bool] = lambda: False,
    recorder: "RolloutRecorder | None" = None,
) -> tuple[np.ndarray, FirstStep, int]:
    """Evaluate ShortHorizon for every environment, candidate and simulation (Algorithm 1, step 2).

    All rollouts advance together. The forward model holds one row for each of the ``unfinished``
    rollouts, in order, and then ``row_of`` is None; otherwise ``row_of`` says which row is whose:
    the simulations of a candidate share one in the first step of a deterministic environment, and
    rows of rollouts that ended are not yet dropped.

    :param candidates: ``[n_envs, beam, act_dim]``.
    :param noise: of ``beam`` candidates at least.
    :param out_of_time: asked before every step; True gives up.
    :param recorder: is told every step.
    :return: values ``[n_envs, beam, sim]`` in float64 (NaN where a simulation was invalid), the first step of
        every candidate ``[n_envs * beam]``, and the number of simulated steps.
    :raises OutOfTimeError: if it gave up.
    """
    n_envs, beam, act_dim = candidates.shape
    depth_limit, n_sim = settings.rollout_depth, settings.distinct_simulations(model.deterministic)
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
                take_rows(observations, slice(None, None, n_first)), step.rewards[::n_first].copy()
            )
        if recorder is not None:
            recorder.note_step(step, unfinished, row_of, n_rollouts)
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
            observations = take_rows(observations, open_rows)
            observation_of = (np.cumsum(open_rows) - 1)[row_of]
        actions = _spread(agent.policy(observations), observation_of)
        actions = clip_actions(actions + rollout_noise[depth, unfinished])
        is_last = depth + 1 == depth_limit
        if is_last or agent.entropy_bonus is not None:
            if observation_of is not None:
                observations = take_rows(observations, observation_of)
            returns[unfinished] += discount * _beyond_rewards(agent, observations, actions, is_last)
        if not is_last and row_of is not None:
            model.select(row_of)
            row_of = None
    return returns.reshape(n_envs, beam, n_sim), first_step, simulated_steps


def _beyond_rewards(agent: Agent, observations: Observations, actions: np.ndarray, is_last: bool) -> Any:
    """What an action after the first is worth beside its rewards, in float64.

    :param is_last: whether the critics' value closes the rollout.
    :return: ``[rows]``.
    """
    worth = agent.value(observations, actions).astype(np.float64) if is_last else 0.0
    if agent.entropy_bonus is not None:
        worth = worth + agent.entropy_bonus(observations, actions).astype(np.float64)
    return worth


class RolloutRecorder:
    """Keeps what rollouts went through.

    :param rollout_depth: steps of a rollout.
    """

    def __init__(self, rollout_depth: int) -> None:
        self._depth_limit = rollout_depth
        self._depth = 0

    def note_step(
        self, step: Transition, unfinished: np.ndarray | slice, row_of: np.ndarray | None, n_rollouts: int
    ) -> None:
        """Keep a step of all rollouts that go on.

        :param step: ``[rows]``.
        :param unfinished: which rollouts those are.
        :param row_of: the row of each; ``None`` if rows are in the order of ``unfinished``.
        :param n_rollouts: of all environments.
        """
        rows = np.arange(len(step.rewards)) if row_of is None else row_of
        if self._depth == 0:
            self._rewards = np.zeros((n_rollouts, self._depth_limit))
            self._lengths = np.zeros(n_rollouts, dtype=int)
            self._terminated = np.zeros(n_rollouts, dtype=bool)
            self._observations = take_rows(step.observations, rows)
        else:
            put_rows(self._observations, unfinished, step.observations, rows)
        self._rewards[unfinished, self._depth] = step.rewards[rows]
        self._lengths[unfinished] = np.where(step.valid[rows], self._depth + 1, 0)
        self._terminated[unfinished] = step.terminated[rows]
        self._depth += 1

    def rollouts(self, candidates: np.ndarray) -> Rollouts:
        """All of them.

        :param candidates: ``[n_envs, beam, act_dim]``, their first actions.
        """
        n_envs, beam = candidates.shape[:2]
        n_sim = len(self._lengths) // (n_envs * beam)

        def by_env(array: np.ndarray) -> np.ndarray:
            return array.reshape(n_envs, beam * n_sim, *array.shape[1:])

        return Rollouts(
            np.repeat(candidates, n_sim, axis=1),
            by_env(self._rewards),
            by_env(self._lengths),
            by_env(self._terminated),
            map_arrays(by_env, self._observations),
        )


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


def _spread(values: np.ndarray, index: np.ndarray | None) -> np.ndarray:
    return values if index is None else values[index]


def _take_first_step(first_step: FirstStep, index: np.ndarray) -> FirstStep:
    return FirstStep(take_rows(first_step.observations, index), first_step.rewards[index])
