"""What a refinement remembers from one decision to the next."""

from collections.abc import Sequence
from typing import Any

import numpy as np

#: When a decision was made: how often its environment had been reset or restored, and the steps since then.
Moment = tuple[int, int]


class PlanMemory:
    """The plan that was followed last in every environment.

    A plan is for the steps right after its decision. It is recalled for what is left of it then, and not at
    all if the environment was reset or restored since.

    :param n_envs: number of environments.
    :param rollout_depth: steps of a plan.
    :param act_dim: entries of one action.
    """

    def __init__(self, n_envs: int, rollout_depth: int, act_dim: int) -> None:
        self._plans = np.zeros((n_envs, rollout_depth, act_dim), dtype=np.float32)
        self._moments: list[Moment | None] = [None] * n_envs

    def recall(self, now: Sequence[Moment]) -> np.ndarray:
        """Shift the plans by the steps since their decisions.

        :param now: the present moment of every environment.
        :return: ``[n_envs, rollout_depth, act_dim]``; 0, the policy's own action, where nothing is left.
        """
        recalled = np.zeros_like(self._plans)
        depth = recalled.shape[1]
        for env, age in enumerate(self.ages(now)):
            if 0 <= age < depth:
                recalled[env, : depth - age] = self._plans[env, age:]
        return recalled

    def keep(self, plans: np.ndarray, now: Sequence[Moment]) -> None:
        """Remember the plans of a decision.

        :param plans: ``[n_envs, rollout_depth, act_dim]``.
        :param now: the present moment of every environment.
        """
        self._plans[:] = plans
        self._moments = list(now)

    def ages(self, now: Sequence[Moment]) -> list[int]:
        """Steps since the decisions.

        :param now: the present moment of every environment.
        :return: one number per environment; -1 where there is no plan for this episode.
        """
        return [
            present[1] - then[1] if then is not None and then[0] == present[0] else -1
            for then, present in zip(self._moments, now, strict=True)
        ]

    def state(self, now: Sequence[Moment]) -> dict[str, Any]:
        """What :meth:`set_state` takes, as plain values that do not depend on how often was reset.

        :param now: the present moment of every environment.
        :return: the plans, and their ages.
        """
        return {"plans": self._plans.copy(), "ages": self.ages(now)}

    def set_state(self, state: dict[str, Any], now: Sequence[Moment]) -> None:
        """Remember what another memory did.

        :param state: from :meth:`state`.
        :param now: the present moment of every environment, which are in the states of then.
        """
        self._plans[:] = state["plans"]
        self._moments = [
            (resets, steps - age) if age >= 0 else None
            for (resets, steps), age in zip(now, state["ages"], strict=True)
        ]
