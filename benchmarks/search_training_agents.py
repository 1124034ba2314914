"""Agents that are tried in ``benchmarks.search_training`` and are not part of the package."""

from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs import MCBSTD3
from sb3_mcbs.networks.td3_update import FastUpdate, TD3Update
from sb3_mcbs.search import Roots, search

#: Lazy re-planning: so many states, once in so many updates of the critics.
REPLANNED, REPLAN_EVERY = 20, 10


class PlainTD3(FastUpdate):
    """SB3's TD3 with this package's gradient step, which is the same but for rounding."""

    fast_update = True


class RowsReplayBuffer(ReplayBuffer):
    """A replay buffer of one environment that remembers which rows were sampled, and keeps more of each.

    :ivar rows: of the last batch.
    :ivar roots: of the forward model, the state before the step.
    :ivar plans: ``[rows, act_dim]``, the action that a search found.
    :ivar is_planned: ``[rows]``.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.rows = np.zeros(0, dtype=int)
        self.roots: list[Any] = [None] * self.buffer_size
        self.plans = np.zeros((self.buffer_size, self.action_dim), dtype=np.float32)
        self.is_planned = np.zeros(self.buffer_size, dtype=bool)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        self.rows = batch_inds
        return super()._get_samples(batch_inds, env)


class PlanningTD3(MCBSTD3):
    """MCBS-TD3 in one environment without normalisation that learns from stored states.

    :param imitation: weight of the squared distance between the actor's action and the searched one, at
        searched transitions, in units of the critics' mean absolute value.
    :param replan: whether old searched actions are planned again, a few at a time.
    """

    def __init__(
        self,
        *args: Any,
        imitation: float = 0.0,
        replan: bool = False,
        **kwargs: Any,
    ) -> None:
        self.imitation, self.replan = imitation, replan
        super().__init__(*args, **{"replay_buffer_class": RowsReplayBuffer, **kwargs})

    def _make_update(self) -> TD3Update:
        return PlanningUpdate(self)

    def _sample_action(self, *args: Any, **kwargs: Any) -> tuple[np.ndarray, np.ndarray]:
        assert self.planner is not None
        self._root = self.planner.read_states()[0]
        return super()._sample_action(*args, **kwargs)

    def _store_transition(self, replay_buffer: ReplayBuffer, *args: Any, **kwargs: Any) -> None:
        assert isinstance(replay_buffer, RowsReplayBuffer)
        row = replay_buffer.pos
        replay_buffer.roots[row] = self._root
        replay_buffer.is_planned[row] = self._prediction is not None
        if self._prediction is not None:
            replay_buffer.plans[row] = self._prediction.actions[0]
        super()._store_transition(replay_buffer, *args, **kwargs)


class PlanningUpdate(TD3Update):
    """TD3's gradient step with what :class:`PlanningTD3` adds.

    :param agent: the agent.
    """

    _agent: PlanningTD3

    @property
    def _buffer(self) -> RowsReplayBuffer:
        # With a part of the batches from simulations there is something that passes itself off as the buffer.
        return cast(RowsReplayBuffer, self._agent.replay_buffer)

    def _targets(self, data: ReplayBufferSamples) -> th.Tensor:
        targets = super()._targets(data)
        if self._agent.replan and self._agent._n_updates % REPLAN_EVERY == 0:
            self._plan_again()
        return targets

    def _plan_again(self) -> None:
        agent, planner, buffer = self._agent, self._agent.planner, self._buffer
        assert planner is not None and agent.search_rng is not None
        rows = buffer.rows[buffer.is_planned[buffer.rows]][:REPLANNED]
        if not len(rows):
            return
        roots = [buffer.roots[row] for row in rows]
        start = Roots(planner.model, roots, buffer.observations[rows, 0])
        result = search(start, planner.functions(), planner.settings, agent.search_rng)
        agent.n_simulated_steps += result.simulated_steps
        buffer.plans[rows] = result.actions

    def _action_gradient(self, pairs: th.Tensor, n_obs: int) -> tuple[th.Tensor, th.Tensor]:
        """As TD3's, with actions held towards searched ones.

        :param pairs: ``[obs_dim + act_dim, batch]``, with the actor's actions.
        :param n_obs: obs_dim.
        :return: the first critic's values, and the gradient.
        """
        values, gradient = super()._action_gradient(pairs, n_obs)
        if not self._agent.imitation:
            return values, gradient
        rows = self._buffer.rows  # the first of the batch; what comes from simulations is behind them
        is_planned = th.as_tensor(self._buffer.is_planned[rows], dtype=th.float32)
        away = pairs[n_obs:, : len(rows)] - th.as_tensor(self._buffer.plans[rows]).t()
        weight = self._agent.imitation * values.abs().mean() / values.numel()
        gradient[:, : len(rows)] += 2 * weight * is_planned * away
        return values, gradient
