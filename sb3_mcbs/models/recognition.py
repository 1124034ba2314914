"""Whether an environment is one whose family is known, and what it does on sample transitions.

These functions run where the environment lives, and only ever step a copy of it.
"""

import pickle
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np

from sb3_mcbs.models.engines import INTEGRATION
from sb3_mcbs.models.families import Constants, Fields, family_of, known_families
from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.snapshot.layers import replaced_method
from sb3_mcbs.snapshot.spaces import random_action
from sb3_mcbs.snapshot.stand_ins import StandIn
from sb3_mcbs.types import ForwardModelError

#: Wrappers that change neither observation nor reward nor action, by their full names: RL Zoo
#: exchanges Gymnasium's TimeLimit for its own when it is imported, before or after ours.
_TRANSPARENT = {
    "gymnasium.wrappers.common.TimeLimit",
    "gymnasium.wrappers.common.OrderEnforcing",
    "gymnasium.wrappers.common.PassiveEnvChecker",
    "gymnasium.wrappers.common.RecordEpisodeStatistics",
    "gymnasium.wrappers.rendering.RecordVideo",
    "gymnasium.wrappers.rendering.RenderCollection",
    "gymnasium.wrappers.rendering.HumanRendering",
    "rl_zoo3.gym_patches.PatchedTimeLimit",
    "stable_baselines3.common.monitor.Monitor",
}

#: Rollouts of the check, steps in each, and random steps taken before each (its number times this).
CHECK_ROLLOUTS, CHECK_STEPS, CHECK_SPACING = 4, 8, 9


class Refusal(NamedTuple):
    """Why the batch model cannot simulate an environment.

    :param reason: in words.
    :param notable: whether a user would have expected it to.
    """

    reason: str
    notable: bool


class KnownEnvironment(NamedTuple):
    """What the batch model must know about one environment of a known family.

    :param env_class: its class.
    :param constants: its model and attributes, as they are now.
    :param packed_model: the model as bytes, to be compared.
    """

    env_class: type
    constants: Constants
    packed_model: bytes


class Sample(NamedTuple):
    """Transitions of a copy of the real environment, stepped at random.

    :param roots: ``[rollouts, steps, root_size]``, before each step.
    :param actions: ``[rollouts, steps, act_dim]``.
    :param observations: ``[rollouts, steps, *obs_shape]``.
    :param rewards: ``[rollouts, steps]`` float64.
    :param terminated: ``[rollouts, steps]`` bool.
    """

    roots: np.ndarray
    actions: np.ndarray
    observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray


def full_name(kind: type) -> str:
    """A class's name with its module."""
    return f"{kind.__module__}.{kind.__qualname__}"


def recognize(wrapper: SnapshotEnvWrapper) -> KnownEnvironment | Refusal:
    """Look at an environment and its wrappers.

    :param wrapper: the environment.
    :return: what the batch model needs, or why it cannot simulate this environment.
    :raises SnapshotUnsupportedError: if its snapshots are not exact.
    """
    layer: gym.Env = wrapper
    base_class = type(wrapper.unwrapped)
    notable = issubclass(base_class, known_families())
    while True:
        replaced = replaced_method(layer)
        if replaced is not None:
            return Refusal(f"{type(layer).__name__}.{replaced} was replaced on the instance", notable)
        if not isinstance(layer, gym.Wrapper):
            break
        kind = type(layer).stands_for if isinstance(layer, StandIn) else type(layer)
        if kind is not SnapshotEnvWrapper and full_name(kind) not in _TRANSPARENT:
            reason = f"the wrapper {kind.__name__} may change observations, rewards or actions"
            return Refusal(reason, notable)
        layer = layer.env
    family = family_of(type(layer))
    if family is None:
        parents = [kind.__name__ for kind in base_class.__mro__[1:] if kind in known_families()]
        of = f"only its parent {parents[0]} is" if parents else "see register_family"
        return Refusal(f"{full_name(base_class)} is not a known family ({of})", notable)
    missing = [name for name in family.attributes if not hasattr(layer, name)]
    if missing:
        return Refusal(
            f"{full_name(base_class)} has no {', '.join(missing)}, which its family reads", notable
        )
    wrapper.verify()
    attributes = {name: getattr(layer, name) for name in family.attributes}
    constants = Constants(layer.model, layer.frame_skip, attributes)  # type: ignore[attr-defined]
    return KnownEnvironment(type(layer), constants, pickle.dumps(layer.model))  # type: ignore[attr-defined]


def read_root(wrapper: SnapshotEnvWrapper, state_size: int, lagging: Sequence[str]) -> np.ndarray:
    """The present state of an environment, as the batch model starts from it.

    :param wrapper: the environment.
    :param state_size: size of its integration state.
    :param lagging: derived fields whose values before the next step count too.
    :return: ``[state_size + sizes of lagging]``.
    :raises ForwardModelError: if the environment's state has another size by now.
    """
    env: Any = wrapper.unwrapped
    data = env.data
    if mujoco.mj_stateSize(env.model, INTEGRATION) != state_size:
        name = type(env).__name__
        raise ForwardModelError(f"{name} has another MuJoCo model than its forward model: call refresh()")
    state = np.empty(state_size)
    mujoco.mj_getState(env.model, data, state, INTEGRATION)
    if not lagging:
        return state
    return np.concatenate([state, *(getattr(data, name).ravel() for name in lagging)])


def fields_of(known: KnownEnvironment) -> Fields:
    """The fields that the family of an environment reads."""
    family = family_of(known.env_class)
    assert family is not None
    return family.fields(known.constants)


def sample_transitions(wrapper: SnapshotEnvWrapper, state_size: int, lagging: Sequence[str]) -> Sample:
    """Step a copy of the environment with random actions.

    :param wrapper: the environment, left as it is.
    :param state_size: size of its integration state.
    :param lagging: derived fields that belong to a root.
    :return: what the copy did.
    """
    rng = np.random.default_rng(0)
    copied = wrapper.clone()
    records: list[list[Any]] = [[], [], [], [], []]
    try:
        for rollout in range(CHECK_ROLLOUTS):
            # The first goes on from where the environment is, if it is anywhere yet.
            if rollout > 0 or wrapper.last_observation is None:
                copied.reset(seed=int(rng.integers(2**31)))
            for _ in range(rollout * CHECK_SPACING):
                copied.step(random_action(copied.action_space, rng))
            for _ in range(CHECK_STEPS):
                action = random_action(copied.action_space, rng)
                root = read_root(copied, state_size, lagging)
                observation, reward, terminated, _, _ = copied.step(action)
                results = (root, action, np.array(observation), np.float64(reward), bool(terminated))
                for record, result in zip(records, results, strict=True):
                    record.append(result)
    finally:
        copied.close()
    arrays = [np.stack(record) for record in records]
    return Sample(*(array.reshape(CHECK_ROLLOUTS, CHECK_STEPS, *array.shape[1:]) for array in arrays))
