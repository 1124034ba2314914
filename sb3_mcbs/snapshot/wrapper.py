"""``SnapshotEnvWrapper``: exact snapshots of a whole environment."""

import contextlib
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_mcbs.snapshot.divergence import diverged_step
from sb3_mcbs.snapshot.errors import SnapshotError, SnapshotMismatchError
from sb3_mcbs.snapshot.layers import CapturedLayer
from sb3_mcbs.snapshot.object_graph import Node, RngMode, private_copy
from sb3_mcbs.snapshot.pygame_values import display_kept
from sb3_mcbs.snapshot.replay import Box2DAdapter
from sb3_mcbs.snapshot.spaces import describe_space
from sb3_mcbs.snapshot.stack import Stack
from sb3_mcbs.snapshot.verification import (
    CannotResetError,
    CheckedEnvironment,
    check_exact,
    has_passed,
    is_known_exact,
)

# Names of an attribute, and of what only pickles have.
_STACK, _KEPT = "_known_stack", "_kept_state"


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """The whole state of an environment at one moment. Immutable and picklable.

    :ivar layers: the captured layers of the environment, outermost first.
    :ivar nodes: the objects that their attributes refer to.
    :ivar spaces: description of the observation space and the action space.
    :ivar last_observation: what the last reset or step had returned, None before the first reset.
    """

    layers: tuple[CapturedLayer, ...]
    nodes: tuple[Node, ...]
    spaces: tuple[str, str]
    last_observation: Any

    def __repr__(self) -> str:
        return f"<Snapshot of {' '.join(layer.name.rpartition('.')[2] for layer in self.layers)}>"


class SnapshotEnvWrapper(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Takes snapshots of an environment, wrappers and random generators included, and puts them back.

    What follows a :meth:`restore` is bit-identical to what followed the :meth:`snapshot`: observation,
    reward, terminated, truncated and numeric info. Wrapping an environment twice returns the wrapper
    that is there.

    Example::

        env = SnapshotEnvWrapper(gym.make("Ant-v5"))
        env.reset(seed=0)
        state = env.snapshot()
        first = env.step(action)
        env.restore(state)
        again = env.step(action)  # equal to first, bit for bit

    An environment that is not known to be exact is checked before its first snapshot, restore or clone: a few
    dozen steps from a seeded reset must repeat themselves after a restore and in a clone, bit for bit. This
    happens once per class and spec in a process, and the environment is then as it was.

    :param env: the environment with its wrappers.
    :param verify: False leaves out that check.
    :raises SnapshotUnsupportedError: if part of it cannot be captured; names the class and the attribute.
    """

    #: What the last reset or step returned, None before the first reset. Not to be altered.
    last_observation: Any
    #: How often the environment was reset or restored, and the steps since then. Not part of snapshots.
    episode_clock: tuple[int, int]
    #: The seed and the options of the last reset; the last seed that was given. Not part of snapshots.
    reset_arguments: dict[str, Any]
    #: Whether the environment is checked, if it is not known to be exact.
    verifies: bool
    _verified: bool

    def __new__(cls, env: Any = None, verify: bool = True) -> "SnapshotEnvWrapper":
        if isinstance(env, SnapshotEnvWrapper):
            return env
        return super().__new__(cls)

    def __init__(self, env: gym.Env[Any, Any], verify: bool = True) -> None:
        if not isinstance(verify, bool):
            raise TypeError(f"verify must be True or False, got {verify!r}")
        if env is self:
            self.verifies = self.verifies and verify
            self._verified = self._verified or not verify
            return
        gym.utils.RecordConstructorArgs.__init__(self, verify=verify)
        gym.Wrapper.__init__(self, env)
        self.last_observation = None
        self.episode_clock = (0, 0)
        self.reset_arguments = {"seed": None, "options": None}
        self._known_stack: Stack | None = Stack(self)
        # One below may say so, and be below a Monitor by now.
        below = [layer.env for layer in self._stack.layers if isinstance(layer.env, SnapshotEnvWrapper)]
        self.verifies = verify and all(wrapper.verifies for wrapper in below)
        self._verified = not self.verifies
        self._is_copy = False
        self._spaces = (describe_space(self.observation_space), describe_space(self.action_space))
        # Whatever cannot be captured is better known before training than in the middle of it.
        self._stack.capture()
        self._own_attributes = frozenset((*vars(self), "_own_attributes"))

    def __setattr__(self, name: str, value: Any) -> None:
        # ``VecEnv.set_attr`` means the outermost layer. Without this wrapper, that is the one below.
        own = vars(self).get("_own_attributes")
        if own is None or name in own or name == "__class__" or type(self) is not SnapshotEnvWrapper:
            super().__setattr__(name, value)
        else:
            setattr(self.env, name, value)

    # Deep copies and pickles of many environments are made by their constructor. Those of this wrapper are in
    # the same state besides. The layers are known by their identity, which a copy does not share.

    def __getstate__(self) -> dict[str, Any]:
        state = {name: value for name, value in vars(self).items() if name != _STACK}
        if self.last_observation is not None:
            state[_KEPT] = self._stack.capture()._replace(objects=[])
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        kept = state.pop(_KEPT, None)
        vars(self).update(state, **{_STACK: None})
        if kept is not None:
            self._stack.become(kept, shares=False)

    def __deepcopy__(self, memo: dict[int, Any]) -> "SnapshotEnvWrapper":
        made = memo[id(self)] = type(self).__new__(type(self))
        attributes = {name: value for name, value in vars(self).items() if name != _STACK}
        vars(made).update(deepcopy(attributes, memo), **{_STACK: None})
        if self.last_observation is not None:
            made._stack.become(self._stack.capture(), shares=True)
        return made

    @property
    def _stack(self) -> Stack:
        stack = self._known_stack
        if stack is None or not stack.is_whole:  # a wrapper may have exchanged what it wraps
            stack = self._known_stack = Stack(self)
        return stack

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment.

        :param seed: as in Gymnasium.
        :param options: as in Gymnasium.
        :return: observation and info.
        """
        self.reset_arguments = {
            "seed": self.reset_arguments["seed"] if seed is None else seed,
            "options": options,
        }
        _ = self._stack  # adapters prepare the environment
        observation, info = self.env.reset(seed=seed, options=options)
        self.last_observation = private_copy(observation)
        self.episode_clock = (self.episode_clock[0] + 1, 0)
        self._stack.find_simulators()
        return observation, info

    def verify(self) -> bool:
        """Check that snapshots of this environment are exact, if that is not known already.

        The environment is then as it was, in the middle of an episode, too. Neither a ``Monitor`` nor global
        generators notice.

        :return: False if it has never been reset and a reset with a seed alone fails: it is checked later.
        :raises SnapshotUnsupportedError: if part of it cannot be captured, or it does not do the same after a
            restore or in a clone. It is reset then, as it was reset last.
        """
        if self._verified:
            return True
        layers = self._stack.layers
        if not is_known_exact(layers, (Box2DAdapter,)) and not has_passed(layers):
            try:
                self.check()
            except SnapshotError as error:
                if isinstance(error, CannotResetError) and self.last_observation is None:
                    return False
                with contextlib.suppress(Exception):  # the error that is raised says more
                    self.reset(**private_copy(self.reset_arguments))
                raise
        self._verified = True
        return True

    def check(self, n_states: int = 0) -> int:
        """Check that snapshots of this environment are exact, also if that is known already.

        :param n_states: from how many states steps are compared at least.
        :return: how many steps were compared.
        :raises SnapshotUnsupportedError: as :meth:`verify` does; the environment is left anywhere then.
        """
        stack = self._stack
        with stack.bare():
            checked = CheckedEnvironment(stack, self.env, self.reset_arguments, _clone)
            return check_exact(checked, self.action_space, n_states)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment.

        Where a simulator diverges and starts afresh by itself, as MuJoCo does, the episode is truncated, the
        reward is 0 and ``info`` has ``simulation_diverged``.

        :param action: as in Gymnasium.
        :return: observation, reward, terminated, truncated and info.
        """
        watches = self._stack.watches
        for forget_the_past in watches:
            forget_the_past()
        result = self.env.step(action)
        self.last_observation = private_copy(result[0])
        self.episode_clock = (self.episode_clock[0], self.episode_clock[1] + 1)
        for diverged in watches:
            if diverged():
                return diverged_step(result, self._stack.monitors)
        return result

    def snapshot(self, monitor: bool = True) -> Snapshot:
        """Capture the present state.

        :param monitor: whether what SB3's ``Monitor`` holds is captured. It grows with every episode, and a
            ``clone()`` has no use for it; without it the snapshot can be restored into those alone.
        :raises SnapshotUnsupportedError: if something that came up since the environment was wrapped
            cannot be captured.
        """
        self.verify()
        state = self._stack.capture(monitor)
        return Snapshot(state.layers, state.nodes, self._spaces, private_copy(self.last_observation))

    def restore(self, snapshot: Snapshot, rng: RngMode = "restore") -> None:
        """Put the environment back into a captured state.

        :param snapshot: of this environment, or of another instance that is made the same way.
        :param rng: what becomes of the environment's random generators. ``"restore"``: they are put back
            as well. ``"keep"``: they stay where they are. A generator: all of them are seeded from it, so
            that what follows has nothing to do with the random draws that the environment will make.
        :raises SnapshotMismatchError: if the snapshot is of another environment, model or shape; the
            environment is left as it is.
        """
        if not isinstance(snapshot, Snapshot):
            raise TypeError(f"Expected a Snapshot, got {type(snapshot).__name__}")
        named = isinstance(rng, str) and rng in ("restore", "keep")
        if not named and not isinstance(rng, np.random.Generator):
            raise ValueError(f'rng must be "restore", "keep" or a numpy.random.Generator, got {rng!r}')
        self.verify()
        self._stack.check(snapshot.layers)
        for what, ours, its in zip(("observation", "action"), self._spaces, snapshot.spaces, strict=True):
            if ours != its:
                raise SnapshotMismatchError(
                    f"The {what} space is {its} in the snapshot and {ours} in this environment."
                )
        self._stack.restore(snapshot.layers, snapshot.nodes, rng)
        self.last_observation = private_copy(snapshot.last_observation)
        self.episode_clock = (self.episode_clock[0] + 1, 0)

    @property
    def simulators(self) -> list[Any]:
        """The objects and layers of this environment that adapters capture."""
        return self._stack.simulators

    def clone(self) -> "SnapshotEnvWrapper":
        """Make an independent copy of the environment in its present state.

        The copy carries the present values of attributes and simulator, edited models included. It does not
        render, writes no files and is not monitored: ``render_mode`` is None, and in the place of SB3's
        ``Monitor`` and of recording wrappers is what only holds what others have set on them. Neither this
        environment nor any global generator is touched.

        :return: the copy, wrapped.
        """
        self.verify()
        _, copy = _clone(self._stack)
        copy._spaces, copy.verifies = self._spaces, self.verifies
        copy.reset_arguments = self.reset_arguments
        copy.last_observation = private_copy(self.last_observation)
        return copy

    def close(self) -> None:
        """Close the environment. A copy has no window, and leaves those of others alone."""
        with display_kept() if self._is_copy else contextlib.nullcontext():
            super().close()

    def apply(self, function: Callable[..., Any], *args: Any) -> Any:
        """Call a function with this wrapper: lets ``env_method`` run it where the environment lives.

        :param function: called as ``function(self, *args)``. Importable by its name if the environment
            lives in another process.
        :param args: further arguments.
        :return: what it returns.
        """
        return function(self, *args)


def _clone(stack: Stack) -> tuple[Stack, SnapshotEnvWrapper]:
    copy = SnapshotEnvWrapper(stack.clone(), verify=False)
    copy._is_copy = True
    if stack.incomplete_clones:
        state = stack.capture(monitor=False)
        copy._stack.restore(state.layers, state.nodes)
    return copy._stack, copy
