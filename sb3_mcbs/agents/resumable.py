"""What exact checkpoints need from an agent. They import the agents, not the other way round."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from typing import Any, ClassVar, Protocol, Self

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv


class StoppedRun(Protocol):
    """A stopped run, which the agent's next call of ``learn`` finishes."""

    def check_call(self, agent: Any, callback: BaseCallback) -> None:
        """Refuse a call of ``learn`` that would not finish the run.

        :param agent: the agent, set up to learn.
        :param callback: its callback.
        """


class Resumable(OffPolicyAlgorithm):
    """An agent that can continue a stopped run. The checkpoint callback restores the run's state.

    Without that callback the run would silently start from the beginning, so the agent checks the call of
    ``learn``.
    """

    not_checkpointed: ClassVar[Collection[str]] = {"_stopped_run": "only set until the run continues"}
    #: Set by ``sb3_mcbs.checkpoints``.
    _resume_as: ClassVar[Callable[..., Any]]
    _stopped_run: StoppedRun | None = None

    @classmethod
    def resume(cls, path: str, env: GymEnv | None = None, **kwargs: Any) -> Self:
        """
        Continue a run from its exact checkpoints, see :func:`sb3_mcbs.resume`.

        :param path: the folder of checkpoints
        :param env: the environment, made like the original one; None makes it from its id
        :param kwargs: the other arguments of :func:`sb3_mcbs.resume`
        :return: the agent
        :raises CheckpointError: if there is no intact checkpoint, or it is of another class
        """
        resumed: Self = Resumable._resume_as(cls, path, env, **kwargs)
        return resumed

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        total_timesteps, callback = super()._setup_learn(*args, **kwargs)
        if self._stopped_run is not None:
            self._stopped_run.check_call(self, callback)
        return total_timesteps, callback

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *Resumable.not_checkpointed]


class Searching(ABC):
    """An object whose search has a memory besides its attributes: that of its planner."""

    planner: Any

    @abstractmethod
    def _follow_settings(self) -> None:
        """Use the current settings from the next decision on."""

    def _search_memory(self) -> dict[str, Any]:
        """Return the memory of the search."""
        return self.planner.memory

    def _go_on_searching(self, memory: dict[str, Any]) -> None:
        """Restore the memory of the search, after all attributes are restored.

        :param memory: from :meth:`_search_memory`.
        """
        self._follow_settings()  # callbacks may have changed them
        self.planner.memory = memory
