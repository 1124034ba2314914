"""Warm start of the cross-entropy method: plans remembered between decisions."""

from collections.abc import Sequence
from typing import Any

import numpy as np

#: Identifies the time of a decision: number of resets and restores of the environment, and steps since then.
EpisodeClock = tuple[int, int]


class WarmStart:
    """The last plan of every environment.

    A plan covers the steps after its decision. The rest of it is recalled later, unless the environment was
    reset or restored since.

    :param n_envs: number of environments.
    :param horizon: environment steps of a plan.
    :param act_dim: action dimensions.
    """

    def __init__(self, n_envs: int, horizon: int, act_dim: int) -> None:
        #: By environment step, since macro-steps of later decisions may start at other steps.
        self._plans = np.zeros((n_envs, horizon, act_dim), dtype=np.float32)
        self._episode_clocks: list[EpisodeClock | None] = [None] * n_envs

    def recall(self, envs: Sequence[int], now: Sequence[EpisodeClock], noise_hold: int = 1) -> np.ndarray:
        """Shift the plans by the steps since their decisions.

        :param envs: indices of the environments.
        :param now: the current episode clock of each.
        :param noise_hold: environment steps in a macro-step.
        :return: ``[len(envs), rollout_depth, act_dim]``, by macro-steps; 0 beyond the remembered plan.
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
        for plan, env, moment in zip(by_step, envs, now, strict=True):
            self._plans[env] = plan
            self._episode_clocks[env] = moment

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
