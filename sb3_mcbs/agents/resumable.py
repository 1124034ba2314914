"""What exact checkpoints need of an agent. They know the agents, and not the other way round."""

from abc import ABC, abstractmethod
from collections.abc import Collection
from typing import Any, ClassVar, Protocol

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm


class StoppedRun(Protocol):
    """A run that was stopped, and that the next ``learn`` of an agent finishes."""

    def check_call(self, agent: Any, callback: BaseCallback) -> None:
        """Refuse a call of ``learn`` that would not finish the run.

        :param agent: the agent, set up to learn.
        :param callback: its callback.
        """


class Resumable(OffPolicyAlgorithm):
    """An agent that can be given a stopped run. The checkpoint callback puts the run's state back.

    Without that callback nobody would notice that the run starts from the beginning, so the agent itself has
    the call of ``learn`` checked.
    """

    not_checkpointed: ClassVar[Collection[str]] = {"_stopped_run": "only there until the run goes on"}
    _stopped_run: StoppedRun | None = None

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        total_timesteps, callback = super()._setup_learn(*args, **kwargs)
        if self._stopped_run is not None:
            self._stopped_run.check_call(self, callback)
        return total_timesteps, callback

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *Resumable.not_checkpointed]


class Searching(ABC):
    """Something that searches: its search remembers more than its attributes say."""

    @abstractmethod
    def _search_memory(self) -> dict[str, Any]:
        """Return what the search remembers."""

    @abstractmethod
    def _go_on_searching(self, memory: dict[str, Any]) -> None:
        """Search on as another one did, once all attributes are put back.

        :param memory: from :meth:`_search_memory`.
        """
