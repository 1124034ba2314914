"""Trust, but check: whether an environment really does the same again after a restore, and in a clone.

What is captured of environments that are not known is all that Python can see. A simulator in compiled code
behind an integer, a global, or a mutable class attribute is not among it, and nothing about the environment
says so. So its first steps are compared, bit by bit.
"""

import copy
import logging
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any
from weakref import WeakKeyDictionary, ref

import gymnasium as gym
import numpy as np

from sb3_mcbs.snapshot.errors import SnapshotError, SnapshotMismatchError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.generators import globals_kept, seed_globals
from sb3_mcbs.snapshot.layers import Layer, replaced_method
from sb3_mcbs.snapshot.object_graph import private_copy
from sb3_mcbs.snapshot.objects import attributes_of
from sb3_mcbs.snapshot.outcomes import Outcome, first_difference
from sb3_mcbs.snapshot.registry import SnapshotAdapter, find_adapter
from sb3_mcbs.snapshot.spaces import random_action
from sb3_mcbs.snapshot.stack import Stack, State

logger = logging.getLogger("sb3_mcbs")

#: Steps before the first snapshot, in each run that is compared, and before the second snapshot.
WARM_UP, STEPS, BETWEEN = 3, 8, 6
#: How often other actions are tried if an environment takes the first one for an error.
TRIES = 10

_KNOWN_ENVIRONMENTS = tuple(
    f"gymnasium.envs.{part}." for part in ("mujoco", "classic_control", "box2d", "toy_text")
)
_KNOWN_WRAPPERS = (
    "gymnasium.wrappers.",
    "stable_baselines3.common.monitor.",
    "rl_zoo3.gym_patches.",
    "sb3_mcbs.snapshot.wrapper.",
)
#: They call a function that is not known.
_CALLING_WRAPPERS = {
    f"gymnasium.wrappers.{module}.{name}"
    for module, name in (
        ("transform_observation", "TransformObservation"),
        ("transform_reward", "TransformReward"),
        ("transform_action", "TransformAction"),
    )
}

_NOT_SEEN = (
    "State outside of Python objects, in globals or in class attributes cannot be seen. Say how it is "
    "captured with sb3_mcbs.snapshot.register_adapter(...); if the environment always does the same from the "
    "same seed, with a ReplayAdapter()."
)
_WITHOUT = (
    "Without exact copies there are forward_model='ensemble', which learns a model, and rollout_depth=0. "
    "SnapshotEnvWrapper(env, verify=False) leaves out this check."
)
_USES_BULLET = (
    "PyBullet is imported: if {0} uses it, capture it with register_adapter("
    'lambda env: isinstance(env, {0}), BulletAdapter(client="<attribute that holds the server\'s handle>")).'
)

#: Which environments passed: by the class of the innermost, how it was made and what is around it.
_passed: "WeakKeyDictionary[type, set[Any]]" = WeakKeyDictionary()


class CannotResetError(SnapshotUnsupportedError):
    """An environment cannot be reset for the check, as it may need ``options``."""


class InexactError(SnapshotUnsupportedError):
    """An environment does not do the same after a restore, or in a clone.

    :param what: what differed.
    :param what_to_do: about it.
    """

    def __init__(self, what: str, what_to_do: str) -> None:
        super().__init__(f"{what} {what_to_do}")
        self.what = what
        self.what_to_do = what_to_do


class CheckedEnvironment:
    """An environment as the check uses it.

    :param stack: its layers.
    :param env: the outermost one that is stepped.
    :param reset_arguments: of every reset; without a seed, it is 0.
    :param clone: makes a clone of layers: its layers, and the wrapper around them.
    :param wrapper: the wrapper around it, if it is a clone.
    """

    def __init__(
        self,
        stack: Stack,
        env: Any,
        reset_arguments: dict[str, Any],
        clone: Callable[[Stack], tuple[Stack, Any]],
        wrapper: Any = None,
    ) -> None:
        self.stack = stack
        self._env = env
        self._reset_arguments = reset_arguments
        self._clone = clone
        self._wrapper = wrapper

    def capture(self) -> State:
        """Return its state."""
        return self._named("capturing its state", lambda: self.stack.capture(monitor=False))

    def put_back(self, state: State) -> None:
        """Put it into a captured state.

        :param state: of :meth:`capture`.
        """
        self._named("putting its state back", lambda: self.stack.restore(state.layers, state.nodes))

    def copy(self) -> "CheckedEnvironment":
        """Return an independent copy in the present state."""
        stack, wrapper = self._named("making a clone of it", lambda: self._clone(self.stack))
        return CheckedEnvironment(stack, wrapper.env, self._reset_arguments, self._clone, wrapper)

    def reset(self) -> None:
        """Reset it, always with the same seed.

        :raises CannotResetError: if that raised anything.
        """
        arguments = private_copy(self._reset_arguments)
        try:
            self._env.reset(seed=arguments["seed"] or 0, options=arguments["options"])
        except Exception as error:
            raise CannotResetError(
                f"The snapshots of {type(self._env.unwrapped).__name__} could not be checked: its reset "
                f"raised {type(error).__name__}: {error}. SnapshotEnvWrapper(env, verify=False) leaves out "
                "the check."
            ) from error

    def step(self, action: Any) -> Any:
        """Step it.

        :param action: as in Gymnasium.
        """
        return self._env.step(action)

    def close(self) -> None:
        """Close it, if it is a copy."""
        if self._wrapper is not None:
            self._wrapper.close()

    def _named(self, what: str, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except SnapshotError:
            raise
        except Exception as error:
            name = type(self._env.unwrapped).__name__
            raise SnapshotUnsupportedError(
                f"{name} cannot be captured: {what} raised {type(error).__name__}: {error}"
            ) from error


def is_known_exact(layers: Sequence[Layer], own_adapters: tuple[type, ...]) -> bool:
    """Return whether the snapshots of an environment are exact by what is known of its classes.

    :param layers: of the environment.
    :param own_adapters: adapters that are part of this package.
    """
    for layer in layers:
        adapter = find_adapter(layer.env)
        if adapter is not None and type(adapter) not in own_adapters:
            return False
        known = _KNOWN_WRAPPERS if isinstance(layer.env, gym.Wrapper) else _KNOWN_ENVIRONMENTS
        if not layer.name.startswith(known) or layer.name in _CALLING_WRAPPERS:
            return False
        if replaced_method(layer.env) is not None:
            return False
    return True


def has_passed(layers: Sequence[Layer]) -> bool:
    """Return whether an environment of these classes, made the same way, was checked in this process.

    :param layers: of the environment.
    """
    return _fingerprint(layers) in _passed.get(type(layers[-1].env), ())


def _fingerprint(layers: Sequence[Layer]) -> Any:
    base = layers[-1].env
    made = None if base.spec is None else (base.spec.id, _text(base.spec.kwargs))
    attributes = attributes_of(base).items()
    # Classes that are made inside functions shall not live on for this.
    holds = frozenset((name, ref(type(value))) for name, value in attributes if name != "_np_random")
    return made, holds, tuple(ref(type(layer.env)) for layer in layers)


def _text(value: Any) -> Any:
    try:
        return repr(value)
    except Exception:  # whoever has no text is like no other
        return object()


def check_exact(checked: CheckedEnvironment, action_space: gym.Space, n_later: int = 0) -> int:
    """Compare what an environment does after a restore, and in a clone, with what it did before.

    The environment is left somewhere; global generators are left as they were.

    :param checked: the environment.
    :param action_space: of the environment.
    :param n_later: from how many states, farther and farther from the reset, steps are compared at least.
    :return: how many steps the comparisons took.
    :raises SnapshotUnsupportedError: names what differed, and at which step.
    """
    start = time.perf_counter()
    layers = checked.stack.layers
    name = type(layers[-1].env).__name__
    as_it_came = _fingerprint(layers)
    with globals_kept():
        n_steps = _check_each_way(checked, layers[-1].env, action_space, n_later)
    # A reset may have given it more attributes, as it may have done with the next one.
    _passed.setdefault(type(layers[-1].env), set()).update((as_it_came, _fingerprint(layers)))
    seconds = time.perf_counter() - start
    logger.info("snapshots of %s were checked: exact in %d steps (%.2f s)", name, n_steps, seconds)
    return n_steps


def _check_each_way(checked: CheckedEnvironment, env: Any, action_space: gym.Space, n_later: int) -> int:
    """Check an environment, and again if its adapter knows another way to capture it.

    :return: how many steps the comparisons took.
    """
    adapter = find_adapter(env)
    try:
        return _Check(checked, env, action_space, adapter, n_later).run()
    except (InexactError, SnapshotMismatchError) as error:
        if adapter is None or not adapter.fall_back(env):
            if isinstance(error, InexactError):
                raise
            raise SnapshotUnsupportedError(str(error)) from error
        first = error.what if isinstance(error, InexactError) else str(error)
        logger.info("%s It is captured another way.", first)
    try:
        return _Check(checked, env, action_space, adapter, n_later).run()
    except SnapshotError as error:
        raise SnapshotUnsupportedError(f"{first} Captured another way: {error}") from error


class _Check:
    def __init__(
        self,
        checked: CheckedEnvironment,
        env: Any,
        action_space: gym.Space,
        adapter: SnapshotAdapter | None,
        n_later: int,
    ) -> None:
        self._env = checked
        self._name = type(env).__name__
        self._n_later = max(n_later, 1 if adapter is None else adapter.n_later_checks)
        advice = _NOT_SEEN if adapter is None else adapter.advice or _NOT_SEEN
        if adapter is None and "pybullet" in sys.modules:
            advice = f"{_USES_BULLET.format(self._name)} {advice}"
        self._what_to_do = f"{advice} {_WITHOUT}"
        self._sample = _sampler(action_space)
        self._n_steps = 0

    def run(self) -> int:
        """Make the comparisons.

        :return: how many steps they took.
        """
        if any(outcome.ends for outcome in self._reset(WARM_UP)):
            self._reset(0)
        state = self._env.capture()
        actions, expected = self._first_run(state)
        self._env.put_back(state)
        self._compare(expected, self._steps(self._env, actions), "After a restore", self._repeats)
        self._env.put_back(state)
        copy_of_env = self._env.copy()
        try:
            self._check_copy(copy_of_env, actions, state, expected)
            ended = expected[-1].ends
            for _ in range(self._n_later):
                ended = ended or any(o.ends for o in self._steps(self._env, self._draw(BETWEEN)))
                if ended and self._n_later > 1:
                    ended = any(outcome.ends for outcome in self._reset(0))
                if not ended:
                    ended = self._check_later(copy_of_env)
        finally:
            copy_of_env.close()
        return self._n_steps

    def _first_run(self, state: Any) -> tuple[list[Any], list[Outcome]]:
        """Take steps from a state, with actions of which the environment takes the first one at least."""
        for _ in range(TRIES):
            actions = self._draw(STEPS)
            expected = self._steps(self._env, actions)
            if not expected[0].raised:
                return actions, expected
            self._env.put_back(state)
        raise SnapshotUnsupportedError(
            f"The snapshots of {self._name} could not be checked: its step raised {expected[0].error}. "
            "SnapshotEnvWrapper(env, verify=False) leaves out the check."
        )

    def _check_copy(
        self, copy_of_env: CheckedEnvironment, actions: list[Any], state: Any, expected: list[Outcome]
    ) -> None:
        """Step a copy and the original in turns: each must do what it does alone."""
        half = min(STEPS // 2, len(expected))
        seen = self._steps(copy_of_env, actions[:half])
        self._compare(expected[:half], seen, "In a clone")
        original = self._steps(self._env, actions)
        self._compare(expected, original, "After steps of a clone, which moved the original,")
        if len(expected) > half:
            rest = self._steps(copy_of_env, actions[half:], half)
            self._compare(expected[half:], rest, "In a clone, which the original's steps moved,", first=half)
        copy_of_env.put_back(state)
        self._compare(expected, self._steps(copy_of_env, actions), "In a clone after a restore")

    def _check_later(self, copy_of_env: CheckedEnvironment) -> bool:
        """The same from a state that is farther from the reset. Return whether the episode ended."""
        actions, state = self._draw(STEPS), self._env.capture()
        expected = self._steps(self._env, actions)
        for env, where in ((self._env, "After a restore"), (copy_of_env, "In a clone after a restore")):
            env.put_back(state)
            self._compare(expected, self._steps(env, actions), f"{where} farther from the reset")
        return expected[-1].ends

    def _draw(self, n: int) -> list[Any]:
        return [self._sample() for _ in range(n)]

    def _reset(self, n_steps: int) -> list[Outcome]:
        seed_globals(0)
        self._env.reset()
        return self._steps(self._env, self._draw(n_steps))

    def _steps(self, env: CheckedEnvironment, actions: list[Any], first: int = 0) -> list[Outcome]:
        outcomes: list[Outcome] = []
        for number, action in enumerate(actions, first):
            self._n_steps += 1
            seed_globals(number)  # who draws from them draws the same
            try:
                observation, reward, terminated, truncated, _ = env.step(copy.deepcopy(action))
                outcome = Outcome(private_copy(observation), reward, terminated, truncated)
            except SnapshotError:
                raise
            except Exception as error:
                name = type(error).__name__
                outcome = Outcome(raised=name, error=f"{name}: {error}")
            outcomes.append(outcome)
            if outcome.ends:
                break
        return outcomes

    def _repeats(self, actions: list[Any]) -> bool:
        """Return whether the environment does the same from the same seed, without any restore."""
        runs = []
        for _ in range(2):
            seed_globals(0)
            self._env.reset()
            runs.append(self._steps(self._env, actions))
        return first_difference(*runs) is None

    def _compare(
        self,
        expected: list[Outcome],
        seen: list[Outcome],
        where: str,
        repeats: Callable[[list[Any]], bool] | None = None,
        first: int = 0,
    ) -> None:
        difference = first_difference(expected, seen)
        if difference is None:
            return
        step, what = difference
        reason = f"{where} step {first + step + 1} of {self._name} {what}."
        if repeats is not None and not repeats(self._draw(STEPS)):
            reason += (
                " It does not repeat itself after two resets with the same seed either: it draws random "
                "numbers that no generator of its own gives, or remembers earlier episodes somewhere else."
            )
        raise InexactError(reason, self._what_to_do)


def _sampler(space: gym.Space) -> Callable[[], Any]:
    if isinstance(space, gym.spaces.Box):
        rng = np.random.default_rng(0)
        return lambda: random_action(space, rng)
    own = copy.deepcopy(space)
    own.seed(0)
    return own.sample
