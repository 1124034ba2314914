"""Copies of what searches: they simulate with networks and environments of their own."""

import os
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from sb3_mcbs.models import ForwardModel
from sb3_mcbs.networks.torch_settings import go_on_in_process

#: What is made of environments. A forward model has threads and memory that are not Python's.
_MADE_OF_ENVIRONMENTS = ("model", "view", "environments", "_all_envs", "_ensemble_model")


class InOwnEnvironments(ABC):
    """Has a forward model of environments, which its copies make anew of theirs.

    They do so when they need it first: while an object is unpickled, the others that it knows are not
    complete, and ``VecNormalize`` never has its environments then.

    :ivar model: the forward model; ``None`` if nothing is simulated.
    """

    model: ForwardModel | None

    def __init__(self) -> None:
        self._process = os.getpid()

    @abstractmethod
    def _connect(self) -> None:
        """Make the forward model, and what else is made of environments."""

    @abstractmethod
    def _go_on_with(self, kind: str, deterministic: bool) -> None:
        """Simulate as another one did.

        :param kind: of its forward model.
        :param deterministic: see :class:`~sb3_mcbs.types.ForwardModel`.
        """

    def go_on_here(self) -> None:
        """Notice a fork of the process since this object was made."""
        self._process = go_on_in_process(self._process)

    def __getstate__(self) -> dict[str, Any]:
        self.go_on_here()
        state = {name: value for name, value in vars(self).items() if name not in _MADE_OF_ENVIRONMENTS}
        if "model" in vars(self):
            if self.model is None:
                state["model"] = None
            else:
                state["_simulated_with"] = self.model.kind, self.model.deterministic
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._process = os.getpid()

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            before = vars(self).get("_simulated_with")
            if name not in _MADE_OF_ENVIRONMENTS or before is None:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            self._connect()
            self._go_on_with(*before)
            del self._simulated_with
            return vars(self)[name]

    def close(self) -> None:
        """Release the forward model."""
        model = vars(self).get("model")
        if model is not None:
            model.close()
