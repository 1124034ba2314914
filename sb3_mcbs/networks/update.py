"""Gradient steps with SB3's mathematics instead of SB3's own, on a GPU as CUDA graphs."""

from abc import abstractmethod
from collections.abc import Hashable, Sequence
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_mcbs.networks import adam
from sb3_mcbs.networks.acting import Acting
from sb3_mcbs.networks.batches import Batches, MirroredBatches, batches_of
from sb3_mcbs.networks.graphs import Graphs

Losses = dict[str, th.Tensor]


class Update:
    """The gradient steps of an agent, whose losses and networks a subclass knows.

    It keeps the networks, optimizers and parameters that the agent has when it is made.

    :param agent: the agent; its networks, optimizers, replay buffer and settings are used, and changed, as
        by its own ``train``.
    :param optimizers: Adams with a single group of parameters each.
    """

    #: What is logged as ``train/...``, in this order.
    losses: ClassVar[tuple[str, ...]]

    def __init__(self, agent: Any, optimizers: Sequence[th.optim.Optimizer]) -> None:
        self._agent, self._optimizers = agent, list(optimizers)
        self._counts = HostCounts()
        #: The optimizers' learning rates, where captured steps read them.
        self._rates: Sequence[th.Tensor | None] = [None] * len(self._optimizers)

    @abstractmethod
    def next_kind(self, number: int) -> Hashable:
        """Begin a gradient step.

        :param number: since ``train`` was called, from 0.
        :return: all that Python decides in the step.
        """

    @abstractmethod
    def step(self, data: ReplayBufferSamples, kind: Any) -> Losses:
        """Do a gradient step.

        :param data: the batch.
        :param kind: from :meth:`next_kind`.
        :return: what is logged, scalars by name.
        """

    def losses_in(self, kind: Any) -> tuple[str, ...]:
        """The names of the losses in a step of this kind."""
        return self.losses

    @abstractmethod
    def constants(self) -> tuple[Any, ...]:
        """All that a captured step contains besides the optimizers: settings, and addresses."""

    def check_capturable(self) -> None:
        """Refuse to capture steps of optimizers that are not the usual ones.

        :raises TypeError: says why.
        """
        for optimizer in self._optimizers:
            adam.check_capturable(optimizer)

    def adam_step(self, index: int) -> None:
        """Step one of the optimizers."""
        adam.adam_step(self._optimizers[index], self._rates[index])

    def update_targets(self, targets: list[th.Tensor], networks: list[th.Tensor]) -> None:
        """Move target networks towards networks, by the agent's ``tau``.

        :param targets: their parameters.
        :param networks: those of the networks, in the same order.
        """
        th._foreach_mul_(targets, 1 - self._agent.tau)
        th._foreach_add_(targets, networks, alpha=self._agent.tau)

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Do what the agent's own ``train`` does.

        :param gradient_steps: how many.
        :param batch_size: transitions sampled for each.
        """
        agent = self._agent
        agent._update_learning_rate(self._optimizers)
        found: dict[str, list[float]] = {name: [] for name in self.losses}
        with th.no_grad():
            for number in range(gradient_steps):
                kind = self.next_kind(number)
                data = agent.replay_buffer.sample(batch_size, env=agent._vec_normalize_env)
                for name, loss in self.step(data, kind).items():
                    found[name].append(loss.item())
        agent.logger.record("train/n_updates", agent._n_updates, exclude="tensorboard")
        for name, values in found.items():
            if values:
                agent.logger.record(f"train/{name}", np.mean(values))

    def train_in_graphs(self, gradient_steps: int, batch_size: int, memory: "GraphMemory") -> None:
        """Do the same with captured steps. Losses stay on the device until they are logged.

        :param gradient_steps: how many.
        :param batch_size: transitions sampled for each.
        :param memory: what the agent keeps from one call to the next.
        """
        agent, device = self._agent, self._agent.device
        agent._update_learning_rate(self._optimizers)
        for optimizer in self._optimizers:
            adam.put_step_counters(optimizer, device)
        self._rates = memory.rates_of(self._optimizers, device)
        sums = memory.begin_losses(self.losses, device)
        batches = memory.batches_for(agent, batch_size)
        self._counts = memory.counts
        with th.no_grad():
            for number in range(gradient_steps):
                kind = self.next_kind(number)
                batches.draw(agent._vec_normalize_env)
                memory.reset_losses(self.losses_in(kind))

                def step(kind: Hashable = kind) -> Any:
                    for name, loss in self.step(batches.read(), kind).items():
                        row = sums[self.losses.index(name)]
                        row[0] += loss
                        row[1] += 1
                    return [p.grad for each in self._optimizers for p in each.param_groups[0]["params"]]

                memory.graphs.follow(self._signature(batches), self)
                memory.graphs.run(kind, step, device)
                batches.simulate_ahead()  # does not wait for the step
        agent.logger.record("train/n_updates", agent._n_updates, exclude="tensorboard")

    def _signature(self, batches: Batches) -> tuple[Any, ...]:
        return (
            type(self),
            self.constants(),
            [adam.signature(optimizer) for optimizer in self._optimizers],
            batches.key,
            th.get_float32_matmul_precision(),
            th.are_deterministic_algorithms_enabled(),
        )


def pairs_of(observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Put observations above actions.

    :return: float32 ``[obs_dim + act_dim, batch]``.
    """
    observations = observations.flatten(1)
    n_obs = observations.shape[1]
    pairs = th.empty((n_obs + actions.shape[1], len(actions)), dtype=th.float32, device=actions.device)
    pairs[:n_obs] = observations.t()
    pairs[n_obs:] = actions.t()
    return pairs


class HostCounts:
    """Counters on a device whose values the host knows without waiting for the device.

    Replayed steps count without torch's knowledge; what else changes a tensor also changes its version.
    """

    def __init__(self) -> None:
        self._known: dict[int, tuple[th.Tensor, int, int]] = {}

    def count(self, counter: th.Tensor) -> int:
        """Note that the next step adds one.

        :param counter: a scalar.
        :return: its value before that.
        """
        known, version, value = self._known.get(id(counter), (None, 0, 0))
        if known is not counter or version != counter._version:
            value = int(counter.item())
        self._known[id(counter)] = counter, counter._version, value + 1
        return value


class GraphMemory:
    """What an agent whose gradient steps are captured keeps from one ``train`` to the next.

    Copies and pickles are empty: the copy captures its own steps.
    """

    def __init__(self) -> None:
        self.graphs = Graphs()
        self.counts = HostCounts()
        self.acting = Acting()
        self._batches: Batches | None = None
        self._rates: list[th.Tensor] = []
        self._rate_values: list[float] = []
        self._losses: th.Tensor | None = None
        self._names: tuple[str, ...] = ()
        self._from_before: set[str] = set()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), ()

    def batches_for(self, agent: Any, batch_size: int) -> Batches:
        """The batches of an agent's present replay buffer.

        :param agent: the agent.
        :param batch_size: transitions.
        """
        buffer, env = agent.replay_buffer, agent._vec_normalize_env
        if self._batches is None or not self._batches.fits(buffer, batch_size, env):
            self._batches = None  # room for the next ones
            self._batches = batches_of(buffer, batch_size, env, agent.device)
        if isinstance(self._batches, MirroredBatches):
            self._batches.copy_rows(agent.num_timesteps // agent.n_envs)
        return self._batches

    def rates_of(self, optimizers: Sequence[th.optim.Optimizer], device: th.device) -> list[th.Tensor]:
        """The present learning rates as tensors, which stay the same ones."""
        if len(self._rates) != len(optimizers):
            self._rates = [th.zeros((), device=device) for _ in optimizers]
            self._rate_values = [0.0 for _ in optimizers]
        for index, optimizer in enumerate(optimizers):
            rate = float(optimizer.param_groups[0]["lr"])
            if rate != self._rate_values[index]:
                self._rates[index].fill_(rate)
                self._rate_values[index] = rate
        return self._rates

    def begin_losses(self, names: tuple[str, ...], device: th.device) -> th.Tensor:
        """Note that ``train`` was called.

        :param names: of all losses.
        :return: ``[names, 2]``, at the same address: sums and numbers of the losses.
        """
        if self._losses is None:
            self._losses = th.zeros((len(names), 2), device=device)
        self._names, self._from_before = names, {*names}
        return self._losses

    def reset_losses(self, names: tuple[str, ...]) -> None:
        """Forget the losses of previous calls of ``train``, if this one has others of these names.

        :param names: of the losses of the next step.
        """
        assert self._losses is not None
        stale = self._from_before.intersection(names)
        self._from_before -= stale
        if len(stale) == len(self._names):
            self._losses.zero_()
        else:
            for name in stale:
                self._losses[self._names.index(name)].zero_()

    def record_losses(self, logger: Logger) -> None:
        """Record the mean losses of the last ``train`` that had them, once.

        :param logger: of the agent.
        """
        if self._losses is not None:
            for name, (total, number) in zip(self._names, self._losses.tolist(), strict=True):
                if number:
                    logger.record(f"train/{name}", total / number)
            self._losses.zero_()
