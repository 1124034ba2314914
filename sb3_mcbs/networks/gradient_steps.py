"""The mixin of agents whose gradient steps are not SB3's own where they need not be."""

import inspect
import logging
from abc import abstractmethod
from collections.abc import Callable, Collection
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_mcbs.networks.adam import put_step_counters
from sb3_mcbs.networks.graphs import BACKENDS
from sb3_mcbs.networks.update import GraphMemory, Update

logger = logging.getLogger("sb3_mcbs")


class GradientSteps(OffPolicyAlgorithm):
    """An agent whose gradient steps are those of an :class:`Update` where it covers the agent.

    Networks and optimizers may be changed at any time, so every call of ``train`` asks anew.
    """

    #: What neither ``save`` nor an exact checkpoint contains, and why.
    not_checkpointed: ClassVar[Collection[str]] = {
        "_reasons_said": "messages to the user of this process",
        "_graph_memory": "captured again from the present networks",
    }
    #: ``False`` runs gradient steps on a GPU without CUDA graphs.
    cuda_graphs: bool = True
    #: SB3's ``train``, which an update replaces.
    _sb3s_train: ClassVar[Callable[..., None]]
    #: The messages that said why gradient steps were left to SB3.
    _reasons_said: frozenset[str] = frozenset()
    _graph_memory: GraphMemory

    def _setup_model(self) -> None:
        super()._setup_model()
        self._reasons_said = frozenset()
        self._graph_memory = GraphMemory()
        checked_switch(self, "cuda_graphs")
        self._present_update()  # tells the user at once if the fast steps cannot be used

    @property
    def _in_graphs(self) -> bool:
        """Whether gradient steps shall be captured."""
        return checked_switch(self, "cuda_graphs") and self.device.type in BACKENDS

    def _wants_update(self) -> bool:
        """Whether the settings ask for the :class:`Update`; by default, only to capture it."""
        return self._in_graphs

    @abstractmethod
    def _make_update(self) -> Update:
        """
        :return: the gradient steps for the present networks and optimizers
        :raises TypeError: says what is not covered
        """

    def _present_update(self) -> Update | None:
        """The fast gradient steps for the present networks and optimizers, or None if they cannot be used."""
        if not self._wants_update():
            return None
        try:
            if getattr(super().train, "__func__", None) is not type(self)._sb3s_train:
                raise TypeError("a class of the agent overrides train")
            return self._make_update()
        except TypeError as reason:
            self._say_once(f"Gradient steps are SB3's own, not the fast ones: {reason}.")
            return None

    def _say_once(self, message: str) -> None:
        if message not in self._reasons_said:
            self._reasons_said |= {message}
            logger.info(message)
            if self.verbose >= 1:
                print(message)

    def train(self, gradient_steps: int, batch_size: int | None = None) -> None:
        """
        Update the networks as SB3 does.

        :param gradient_steps: how many gradient steps to do
        :param batch_size: transitions sampled for each (None: SB3's default)
        """
        if batch_size is None:
            batch_size = inspect.signature(type(self)._sb3s_train).parameters["batch_size"].default
        update = self._present_update()
        if update is not None and self._in_graphs:
            try:
                update.check_capturable()
            except TypeError as reason:
                self._say_once(f"Gradient steps are not captured in CUDA graphs: {reason}.")
            else:
                with self._current_device():
                    update.train_in_graphs(gradient_steps, batch_size, self._graph_memory)
                return
        if self.device.type != "cpu":  # captured steps may have left them there
            for optimizer in self._adams():
                put_step_counters(optimizer, th.device("cpu"))
        if update is None:
            super().train(gradient_steps, batch_size)
        else:
            update.train(gradient_steps, batch_size)

    def _current_device(self) -> AbstractContextManager[Any]:
        """Make the agent's GPU the one on which graphs are captured."""
        return th.cuda.device(self.device) if self.device.type == "cuda" else nullcontext()

    def _adams(self) -> list[th.optim.Optimizer]:
        own: Any = self
        found = [own.actor.optimizer, own.critic.optimizer, getattr(self, "ent_coef_optimizer", None)]
        return [optimizer for optimizer in found if isinstance(optimizer, th.optim.Adam)]

    def dump_logs(self) -> None:
        """Write log data, for which the losses of captured steps are read from the GPU."""
        self._graph_memory.record_losses(self.logger)
        super().dump_logs()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *GradientSteps.not_checkpointed]


class FastGradientSteps(GradientSteps):
    """An agent whose gradient steps are those of an :class:`Update` on a CPU too, where it covers the agent.

    A subclass's constructor sets :attr:`fast_update` before the networks are set up.
    """

    #: ``False`` leaves gradient steps to SB3.
    fast_update: bool

    def _wants_update(self) -> bool:
        return checked_switch(self, "fast_update")


def checked_switch(agent: Any, name: str) -> bool:
    """Read a setting that is True or False.

    :param agent: the agent.
    :param name: of the setting.
    :raises TypeError: if it is something else.
    """
    value = getattr(agent, name)
    if not isinstance(value, bool):
        raise TypeError(f"{name} must be True or False, got {value!r}.")
    return value
