"""``SnapshotEnvWrapper``: exact snapshots of a whole environment."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_mcbs.snapshot.errors import SnapshotMismatchError
from sb3_mcbs.snapshot.faults import diverged_step
from sb3_mcbs.snapshot.graph import Node, RngMode, private_copy
from sb3_mcbs.snapshot.layers import describe_space
from sb3_mcbs.snapshot.state import FrozenLayer, Stack


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """The whole state of an environment at one moment. Immutable and picklable.

    :ivar layers: the captured layers of the environment, outermost first.
    :ivar nodes: the objects that their attributes refer to.
    :ivar spaces: description of the observation space and the action space.
    :ivar last_observation: what the last reset or step had returned, None before the first reset.
    """

    layers: tuple[FrozenLayer, ...]
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

    :param env: the environment with its wrappers.
    :raises SnapshotUnsupportedError: if part of it cannot be captured; names the class and the attribute.
    """

    #: What the last reset or step returned, None before the first reset. Not to be altered.
    last_observation: Any
    #: How often the environment was reset or restored, and the steps since then. Not part of snapshots.
    moment: tuple[int, int]

    def __new__(cls, env: Any = None) -> "SnapshotEnvWrapper":
        if isinstance(env, SnapshotEnvWrapper):
            return env
        return super().__new__(cls)

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        if env is self:
            return
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self.last_observation = None
        self.moment = (0, 0)
        self._spaces = (describe_space(self.observation_space), describe_space(self.action_space))
        self._stack = Stack(self)
        # Whatever cannot be captured is better known before training than in the middle of it.
        self.snapshot()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment.

        :param seed: as in Gymnasium.
        :param options: as in Gymnasium.
        :return: observation and info.
        """
        observation, info = self.env.reset(seed=seed, options=options)
        self.last_observation = private_copy(observation)
        self.moment = (self.moment[0] + 1, 0)
        self._stack.find_simulators()
        return observation, info

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
        self.moment = (self.moment[0], self.moment[1] + 1)
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
        layers, nodes = self._stack.freeze(monitor)
        return Snapshot(layers, nodes, self._spaces, private_copy(self.last_observation))

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
        self._stack.check(snapshot.layers)
        for what, ours, its in zip(("observation", "action"), self._spaces, snapshot.spaces, strict=True):
            if ours != its:
                raise SnapshotMismatchError(
                    f"The {what} space is {its} in the snapshot and {ours} in this environment."
                )
        self._stack.thaw(snapshot.layers, snapshot.nodes, rng)
        self.last_observation = private_copy(snapshot.last_observation)
        self.moment = (self.moment[0] + 1, 0)

    def clone(self) -> "SnapshotEnvWrapper":
        """Make an independent copy of the environment in its present state.

        The copy carries the present values of attributes and simulator, edited models included. It does not
        render, writes no files and is not monitored: ``render_mode`` is None, and SB3's ``Monitor`` and
        recording wrappers are left out. Neither this environment nor any global generator is touched.

        :return: the copy, wrapped.
        """
        copy = SnapshotEnvWrapper(self._stack.clone())
        if self._stack.incomplete_clones:
            copy.restore(self.snapshot(monitor=False))
        copy.last_observation = private_copy(self.last_observation)
        return copy

    def apply(self, function: Callable[..., Any], *args: Any) -> Any:
        """Call a function with this wrapper: lets ``env_method`` run it where the environment lives.

        :param function: called as ``function(self, *args)``. Importable by its name if the environment
            lives in another process.
        :param args: further arguments.
        :return: what it returns.
        """
        return function(self, *args)
