"""Recognises environments of known families, and records sample transitions of them.

These functions run in the process where the environment lives, and only ever step a copy of it.
"""

import pickle
from types import SimpleNamespace
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np

from sb3_mcbs.models.families import Constants, family_of, known_families
from sb3_mcbs.models.libmujoco import INTEGRATION
from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.snapshot.layers import replaced_method
from sb3_mcbs.snapshot.object_graph import class_name
from sb3_mcbs.snapshot.spaces import random_action
from sb3_mcbs.snapshot.stand_ins import StandIn
from sb3_mcbs.types import ForwardModelError

#: Wrappers that change neither observations nor rewards nor actions. They are named, because RL Zoo
#: replaces Gymnasium's TimeLimit when it is imported, before or after this package.
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

#: Rollouts of the check, and steps of each; rollout i starts after i * CHECK_SPACING random steps.
CHECK_ROLLOUTS, CHECK_STEPS, CHECK_SPACING = 4, 8, 9


class NotRecognizedError(ForwardModelError):
    """The batch model refuses an environment.

    :ivar notable: whether a user would have expected that it can be simulated.
    """

    def __init__(self, message: str, notable: bool = True) -> None:
        super().__init__(message)
        self.notable = notable


class KnownEnvironment(NamedTuple):
    """What the batch model must know about one environment of a known family.

    :param env_class: its class.
    :param constants: what its family reads from it at present.
    :param model: its present model.
    :param frame_skip: MuJoCo steps in an environment step.
    :param packed_model: the model as bytes, to be compared.
    """

    env_class: type
    constants: Constants
    model: mujoco.MjModel
    frame_skip: int
    packed_model: bytes

    def difference(self, other: "KnownEnvironment") -> str:
        """What distinguishes another environment from this one; empty if nothing does."""
        if self.env_class is not other.env_class:
            return f"class ({self.env_class.__name__}, {other.env_class.__name__})"
        if self.frame_skip != other.frame_skip:
            return f"frame_skip ({self.frame_skip}, {other.frame_skip})"
        for name, value in self.constants.items():
            if not np.array_equal(value, other.constants[name]):
                return f"{name} ({value}, {other.constants[name]})"
        return "MuJoCo models" if self.packed_model != other.packed_model else ""


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


def recognize(wrapper: SnapshotEnvWrapper) -> KnownEnvironment | NotRecognizedError:
    """Look at an environment and its wrappers.

    :param wrapper: the environment.
    :return: what the batch model needs, or the error that says why it cannot simulate this environment.
    :raises SnapshotUnsupportedError: if its snapshots are not exact.
    """
    env: Any = wrapper.unwrapped
    reason = _reason_against(wrapper)
    if reason:
        return NotRecognizedError(reason, notable=isinstance(env, known_families()))
    wrapper.verify()
    family = family_of(type(env))
    assert family is not None
    try:
        constants = {"dt": env.dt, **family.constants(env)}
    except AttributeError as error:
        return NotRecognizedError(f"its family reads what {class_name(type(env))} does not have: {error}")
    return KnownEnvironment(type(env), constants, env.model, env.frame_skip, pickle.dumps(env.model))


def _reason_against(wrapper: SnapshotEnvWrapper) -> str:
    """Why the batch model cannot simulate an environment; empty if it can."""
    layer: gym.Env = wrapper
    while True:
        replaced = replaced_method(layer)
        if replaced is not None:
            return f"{type(layer).__name__}.{replaced} was replaced on the instance"
        if not isinstance(layer, gym.Wrapper):
            break
        kind = type(layer).stands_for if isinstance(layer, StandIn) else type(layer)
        if kind is not SnapshotEnvWrapper and class_name(kind) not in _TRANSPARENT:
            return f"the wrapper {kind.__name__} may change observations, rewards or actions"
        layer = layer.env
    env_class = type(layer)
    family = family_of(env_class)
    if family is None:
        parents = [kind.__name__ for kind in env_class.__mro__[1:] if kind in known_families()]
        of = f"only its parent {parents[0]} is" if parents else "see register_family"
        return f"{class_name(env_class)} is not a known family ({of})"
    return ""


def read_root(wrapper: SnapshotEnvWrapper, state_size: int, constants: SimpleNamespace) -> np.ndarray:
    """Read the present state of an environment, as a root of the batch model.

    :param wrapper: the environment.
    :param state_size: size of its integration state.
    :param constants: what its family read from it.
    :return: ``[state_size + n_kept]``, the state and what the family keeps beside it.
    :raises ForwardModelError: if the size of the environment's state has changed.
    """
    env: Any = wrapper.unwrapped
    data = env.data
    if mujoco.mj_stateSize(env.model, INTEGRATION) != state_size:
        name = type(env).__name__
        raise ForwardModelError(f"{name} has another MuJoCo model than its forward model: call refresh()")
    family = family_of(type(env))
    assert family is not None
    root = np.empty(state_size + family.n_kept)
    mujoco.mj_getState(env.model, data, root[:state_size], INTEGRATION)
    if family.n_kept:
        family.keep(constants, data, root[state_size:])
    return root


def sample_transitions(wrapper: SnapshotEnvWrapper, state_size: int, constants: SimpleNamespace) -> Sample:
    """Step a copy of the environment with random actions.

    :param wrapper: the environment, left as it is.
    :param state_size: size of its integration state.
    :param constants: what its family read from it.
    :return: the transitions of the copy.
    """
    rng = np.random.default_rng(0)
    copied = wrapper.clone()
    steps: list[tuple[Any, ...]] = []
    try:
        for rollout in range(CHECK_ROLLOUTS):
            # The first rollout starts from the environment's present state, unless it was never reset.
            if rollout > 0 or wrapper.last_observation is None:
                copied.reset(seed=int(rng.integers(2**31)))
            for _ in range(rollout * CHECK_SPACING):
                copied.step(random_action(copied.action_space, rng))
            for _ in range(CHECK_STEPS):
                action = random_action(copied.action_space, rng)
                root = read_root(copied, state_size, constants)
                observation, reward, terminated, _, _ = copied.step(action)
                steps.append((root, action, np.array(observation), np.float64(reward), bool(terminated)))
    finally:
        copied.close()
    arrays = [np.stack(values) for values in zip(*steps, strict=True)]
    return Sample(*(array.reshape(CHECK_ROLLOUTS, CHECK_STEPS, *array.shape[1:]) for array in arrays))
