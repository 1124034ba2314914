"""The replay buffer of value expansion: it stores simulator states, and rolls some of its samples forward."""

import functools
import logging
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs.agents.branches import as_samples
from sb3_mcbs.agents.compiled_policy import CompiledPolicy
from sb3_mcbs.models import ForwardModelError
from sb3_mcbs.networks.functions import STOCHASTIC, Actor, target_actor
from sb3_mcbs.networks.torch_settings import one_thread

logger = logging.getLogger("sb3_mcbs")

#: The additional arrays of a replay buffer; a saved buffer has them under these names.
ARRAYS = ("expansion_states", "expansion_held")


class ExpandedReplayBuffer(ReplayBuffer):
    """A replay buffer that stores simulator states, and rolls some of its samples forward.

    For every row and environment it stores the state after the step, and whether there is one (not where the
    episode ended). :func:`expand` converts a replay buffer of any class. It is pickled as that class, so it
    can be loaded without this package.

    :ivar expanding_agent: the :class:`~sb3_mcbs.MCBS` agent that learns from it. Simulated steps are added
        to its ``n_simulated_steps``.
    :ivar expansion_states: ``[buffer_size, n_envs, state_size]``, the state after each step.
    :ivar expansion_held: ``[buffer_size, n_envs]`` bool, whether that state is stored.
    """

    #: Its class without expansion.
    base_class: ClassVar[type[ReplayBuffer]]
    not_checkpointed = ("expanding_agent", "states_after", "_ahead")

    expanding_agent: Any
    #: States of the environments after the step that is added next; None for rows of others.
    states_after: np.ndarray | None = None
    #: What was simulated for the next batch, and its settings.
    _ahead: tuple[tuple[Any, ...], ReplayBufferSamples | None] | None = None
    expansion_states: np.ndarray
    expansion_held: np.ndarray

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store a step, and the environments' states after it.

        :param done: ``[n_envs]``, whether the episode ended: the state is then of the next one.
        """
        states, self.states_after = self.states_after, None
        if states is not None:
            make_room(self, states.shape[1])
            self.expansion_states[self.pos] = states
        self.expansion_held[self.pos] = False if states is None else ~np.asarray(done, dtype=bool)
        super().add(obs, next_obs, action, reward, done, infos)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """Sample transitions, ``expanded_share`` of them expanded, or simulated where there are branches.

        :param batch_size: number of transitions.
        :param env: normalises observations and rewards.
        :return: n-step transitions. Those that ended an episode are not expanded.
        """
        n_expanded = self._n_expanded(batch_size)
        simulated = self._simulated(n_expanded, env)
        n_own = batch_size if simulated is None else batch_size - n_expanded
        samples = []
        if n_own:
            own: Any = super().sample(n_own, env=env)
            if own.discounts is None:
                own = own._replace(discounts=th.full_like(own.rewards, self.expanding_agent.gamma))
            samples.append(own)
        if simulated is not None:
            samples.append(simulated)
        return ReplayBufferSamples(*(th.cat(fields) for fields in zip(*samples, strict=True)))

    def next_simulation(self, batch_size: int, env: VecNormalize | None) -> Callable[[], None]:
        """What can be simulated for the next batch while a GPU learns from this one.

        It follows the actor as it is now: networks on a GPU are copied before they are updated. So the
        results do not depend on how long the GPU takes.

        :param batch_size: number of transitions.
        :param env: normalises observations and rewards.
        :return: to be called once the update was started.
        """
        n_expanded = self._n_expanded(batch_size)
        if not n_expanded:
            return lambda: None
        settings, simulate = self._settings(n_expanded, env), self._simulation(n_expanded, env)

        def simulate_ahead() -> None:
            self._ahead = settings, simulate()

        return simulate_ahead

    def _n_expanded(self, batch_size: int) -> int:
        agent = self.expanding_agent
        # After a callback has switched value expansion off, no sample is expanded.
        return round(agent.expanded_share * batch_size) if agent.value_expansion else 0

    def _settings(self, n: int, env: VecNormalize | None) -> tuple[Any, ...]:
        """What transitions that were simulated ahead depend on."""
        agent = self.expanding_agent
        lengths = agent.value_expansion, agent.branch_length
        return n, env, self.device, agent, agent.planner.model, *lengths, agent.gamma

    def _simulated(self, n: int, env: VecNormalize | None) -> ReplayBufferSamples | None:
        """The simulated part of a batch. What was simulated ahead is used for this batch or not at all.

        :param n: number of transitions; may be 0.
        :return: ``None`` if there is nothing to simulate, or no stored state to branch off.
        """
        (settings, samples), self._ahead = self._ahead or (None, None), None
        if not n:
            return None
        if settings is not None and settings == self._settings(n, env):
            return samples
        return self._simulation(n, env)()

    def _simulation(self, n: int, env: VecNormalize | None) -> Callable[[], ReplayBufferSamples | None]:
        agent = self.expanding_agent
        rng, branches = agent.rollout_rng, agent.current_branches()
        if branches is None:
            return functools.partial(self.sample_expanded, n, rng, env, self._forward(rng, env))
        act = target_actor(agent)

        def simulate() -> ReplayBufferSamples | None:
            branches.go_on(self, agent, act, rng, env)
            return branches.sample(n, self, rng, env) if len(branches) else None

        return simulate

    def _forward(self, rng: np.random.Generator, env: VecNormalize | None) -> "_Forward":
        """The simulation of the target actor from stored states, in compiled code where that covers it."""
        try:
            return functools.partial(self._roll_forward_compiled, compiled_target(self.expanding_agent, env))
        except TypeError:
            return functools.partial(self._roll_forward, target_actor(self.expanding_agent), rng, env)

    def sample_expanded(
        self, n: int, rng: np.random.Generator, env: VecNormalize | None, forward: "_Forward | None" = None
    ) -> ReplayBufferSamples:
        """Sample transitions, and roll them forward.

        :param n: number of transitions.
        :param rng: samples them, and is given to the forward model.
        :param env: normalises observations and rewards.
        :param forward: rolls them forward; ``None``: with the present target actor.
        """
        at = rng.integers(0, self.size(), n), rng.integers(0, self.n_envs, n)
        path = _Path(
            np.array(self._normalize_reward(self.rewards[at], env), dtype=np.float64),
            np.ones(n, dtype=int),
            (self.dones[at] * (1 - self.timeouts[at])).astype(bool),
            self.next_observations[at],
        )
        going = np.flatnonzero(self.expansion_held[at])
        if len(going):
            states = self.expansion_states[at[0][going], at[1][going]]
            with one_thread():
                (forward or self._forward(rng, env))(states, going, path)
        return self._as_samples(at, path, env)

    def _roll_forward(
        self,
        act: Actor,
        rng: np.random.Generator,
        env: VecNormalize | None,
        states: np.ndarray,
        going: np.ndarray,
        path: "_Path",
    ) -> None:
        """Simulate the target actor from stored states.

        :param act: the target actor.
        :param rng: given to the forward model and the actor.
        :param env: normalises observations and rewards.
        :param states: ``[m, state_size]``.
        :param going: ``[m]``, the transitions' indices.
        :param path: of all transitions; changed in place.
        """
        returns, lengths, terminated, last = path
        agent, planner = self.expanding_agent, self.expanding_agent.planner
        model, view = planner.model, planner.source.view
        model.set_roots(list(states), np.arange(len(going)), rng)
        seen: Any = self._normalize_obs(last[going], env)
        for number in range(1, agent.value_expansion + 1):
            actions, bonus = act(seen, rng)
            step = model.step(planner.unscale(actions))
            agent.n_simulated_steps += len(going)
            valid = np.flatnonzero(step.valid)  # a simulation that diverged ends one step earlier
            at = going[valid]
            rewards = self._normalize_reward(step.rewards[valid], env) + bonus[valid]
            returns[at] += agent.gamma**number * rewards
            terminated[at] = step.terminated[valid]
            lengths[at] += 1
            after: Any = view.observe(step.observations, normalize=False)
            last[at] = after[valid]
            still = np.flatnonzero(step.goes_on)
            if not len(still):
                return
            seen = view.observe(step.observations)[still]
            if len(still) < len(going):
                model.select(still)
                going = going[still]

    def _roll_forward_compiled(
        self, compiled: CompiledPolicy, states: np.ndarray, going: np.ndarray, path: "_Path"
    ) -> None:
        """:meth:`_roll_forward` in compiled code.

        :param compiled: the target actor.
        """
        agent = self.expanding_agent
        returns, lengths, terminated, last = path
        rolled = compiled.follow(list(states), last[going], agent.value_expansion)
        agent.n_simulated_steps += rolled.simulated_steps
        returns[going] += agent.gamma * rolled.returns[:, 0]
        lengths[going] += rolled.lengths[:, 0]
        simulated = rolled.lengths[:, 0] > 0
        terminated[going[simulated]] = rolled.terminated[simulated, 0]
        last[going[simulated]] = rolled.observations[simulated, 0]

    def _as_samples(
        self, at: tuple[np.ndarray, ...], path: "_Path", env: VecNormalize | None
    ) -> ReplayBufferSamples:
        """Make a batch, with discounts for the next observations' values.

        :param at: rows and environments ``[n]`` of the transitions.
        """
        discounts = self.expanding_agent.gamma**path.lengths
        columns = (c.astype(np.float32)[:, None] for c in (path.terminated, path.returns, discounts))
        return as_samples(self, env, self.observations[at], self.actions[at], path.observations, *columns)

    def __reduce_ex__(self, protocol: Any) -> Any:
        held: Any = self.__getstate__()
        state = {name: value for name, value in held.items() if name not in self.not_checkpointed}
        return object.__new__, (self.base_class,), state


def expand(buffer: ReplayBuffer, agent: Any) -> None:
    """Convert a replay buffer to one that expands its samples.

    The buffer becomes an :class:`ExpandedReplayBuffer` in place, so references to it stay valid.

    :param buffer: a replay buffer of any class.
    :param agent: see :class:`ExpandedReplayBuffer`.
    :raises ForwardModelError: if the forward model's states are not arrays.
    """
    if not isinstance(buffer, ExpandedReplayBuffer):
        make_room(buffer, batched_states(agent).shape[1])
        buffer.__class__ = _expanded_class(type(buffer))
    vars(buffer)["expanding_agent"] = agent


def make_room(buffer: ReplayBuffer, state_size: int) -> None:
    """Give a replay buffer room for states. It loses those of a simulator with other states.

    :param buffer: the replay buffer.
    :param state_size: of the present simulator.
    """
    held: Any = buffer
    shape = (buffer.buffer_size, buffer.n_envs, state_size)
    known = getattr(held, "expansion_states", None)
    if known is None or known.shape != shape:
        if known is not None:
            logger.info("The replay buffer's states are dropped: they are those of another simulator.")
        held.expansion_states = np.zeros(shape)
        held.expansion_held = np.zeros(shape[:2], dtype=bool)


@functools.cache
def _expanded_class(base: type[ReplayBuffer]) -> type[ExpandedReplayBuffer]:
    return type(f"Expanded{base.__name__}", (ExpandedReplayBuffer, base), {"base_class": base})


def drop_states(buffer: ReplayBuffer | None) -> None:
    """Drop a replay buffer's states from an earlier training that this one does not use.

    :param buffer: the replay buffer.
    """
    if buffer is None:
        return
    if isinstance(buffer, ExpandedReplayBuffer):
        del buffer.expanding_agent
        vars(buffer).pop("_ahead", None)  # it leads to the agent, which would be pickled with the buffer
        buffer.__class__ = buffer.base_class  # type: ignore[assignment]
    kept = [name for name in ARRAYS if name in vars(buffer)]
    for name in kept:
        delattr(buffer, name)
    if kept:
        logger.info("The replay buffer's %s are dropped: no setting uses them.", ", ".join(kept))


def batched_states(agent: Any) -> np.ndarray:
    """Read the current states of an agent's environments.

    :param agent: an :class:`~sb3_mcbs.MCBS` agent.
    :return: ``[n_envs, state_size]``.
    :raises ForwardModelError: if the forward model's states are not arrays.
    """
    planner = agent.planner
    states = planner.read_states() if _is_batched(planner.model) else []
    if not _is_batched(planner.model):  # reading may have replaced the forward model
        raise ForwardModelError(
            "value_expansion keeps the simulator's states in the replay buffer, which needs batched "
            f"MuJoCo; the forward model is: {planner.description}. Leave value_expansion out."
        )
    return np.stack(states)


def has_batched_states(agent: Any) -> bool:
    """Whether an agent's forward model simulates from states that are arrays.

    :param agent: an :class:`~sb3_mcbs.MCBS` agent.
    """
    try:
        batched_states(agent)
    except ForwardModelError:
        return False
    return True


def _is_batched(model: Any) -> bool:
    return model is not None and model.kind == "mujoco"


class _Path(NamedTuple):
    """The outcome of n-step transitions.

    :param returns: ``[n]``, discounted sums of rewards, scaled for the networks.
    :param lengths: ``[n]``, numbers of steps.
    :param terminated: ``[n]`` bool, whether the environment ended the episode.
    :param observations: ``[n, obs_dim]``, the last ones, as stored in replay buffers.
    """

    returns: np.ndarray
    lengths: np.ndarray
    terminated: np.ndarray
    observations: np.ndarray


#: Continues n-step transitions from states ``[m, state_size]``; ``[m]``: which ones.
_Forward = Callable[[np.ndarray, np.ndarray, _Path], None]


def compiled_target(agent: Any, env: VecNormalize | None) -> CompiledPolicy:
    """The current actor of the targets in compiled code.

    :param agent: an :class:`~sb3_mcbs.MCBS` agent.
    :param env: normalises the observations and rewards that it learns from.
    :raises TypeError: says what compiled code does not cover.
    """
    if isinstance(agent, STOCHASTIC):
        raise TypeError("the actor draws its actions")
    compiled: CompiledPolicy = agent.planner.compiled_policy(target=True)
    if not compiled.normalizes_like(env):
        raise TypeError("they are not normalized as rollouts are")
    return compiled
