"""Detects and reports faults of environments, networks and simulations."""

import logging
import math
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
)
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

from sb3_mcbs.models.workers import worker_error
from sb3_mcbs.search.interface import SearchResult
from sb3_mcbs.types import ForwardModel, Observations

logger = logging.getLogger("sb3_mcbs")

_LOOPS_OVER_ENVIRONMENTS = (DummyVecEnv.step_wait.__code__, DummyVecEnv.reset.__code__)


class NonFiniteError(ValueError):
    """An environment or a network returned NaN or infinity."""


@contextmanager
def environment_named(vec_env: VecEnv) -> Iterator[None]:
    """Add to an error which environment it came from.

    An error of an environment in this process is raised unchanged, with a note.

    :param vec_env: the environments that are stepped inside the context.
    :raises WorkerError: if the worker process of an environment has ended; a hanging one is not detected.
    :raises ValueError: see :func:`check_whole`.
    """
    check_whole(vec_env)
    try:
        yield
    except Exception as error:
        base = vec_env.unwrapped
        if isinstance(base, SubprocVecEnv) and isinstance(error, EOFError | OSError):
            reason = worker_error(base, error)
            if reason is not None:
                raise reason from error
        for frame, _ in traceback.walk_tb(error.__traceback__):
            if frame.f_code in _LOOPS_OVER_ENVIRONMENTS and frame.f_locals["self"] is base:
                error.add_note(
                    f"This happened in environment {frame.f_locals['env_idx']} of {base.num_envs}."
                )
        raise


def check_whole(vec_env: VecEnv) -> None:
    """Refuse wrappers without environments.

    :param vec_env: the environments.
    :raises ValueError: if there are none, as in a copy of a ``VecNormalize``.
    """
    layer: Any = vec_env
    while isinstance(layer, VecEnvWrapper):
        name, layer = type(layer).__name__, vars(layer).get("venv")
        if layer is None:
            raise ValueError(
                f"There are no environments in this {name}: SB3 leaves them out of its copies. Give it some "
                "with set_venv(...), or the agent others with set_env(...)."
            )


def check_observations(observations: Any) -> None:
    """Refuse observations of a reset that are not finite.

    :param observations: ``[n_envs, *]``, or a dict of such arrays.
    :raises NonFiniteError: names the environment.
    """
    broken = broken_row(observations)
    if broken is not None:
        raise NonFiniteError(
            f"Environment {broken[0]} is in a state whose observation is not finite: {broken[1]}. Check "
            "what its reset or its last step computes "
            "(stable_baselines3.common.env_checker.check_env helps)."
        )


def check_networks(
    policy: Callable[[Observations], np.ndarray],
    value: Callable[[Observations, np.ndarray], np.ndarray],
    observations: Observations,
) -> None:
    """Check whether networks, rather than rollouts, have diverged.

    :param policy: the actor.
    :param value: the critics.
    :param observations: ``[n_envs, *]``, current observations.
    :raises NonFiniteError: if the networks' outputs, or the observations, are not finite.
    """
    check_observations(observations)
    actions = policy(observations)
    if not is_finite(actions):
        answer = "The actor returns"
    elif not is_finite(value(observations, actions)):
        answer = "The critics return"
    else:
        return
    raise NonFiniteError(
        f"{answer} NaN or infinity for the current observations: the networks have diverged, and no action "
        "can be chosen. Go back to an agent that was saved earlier, and train with a lower "
        "learning_rate, or with rewards and observations on a smaller scale (VecNormalize)."
    )


class InvalidDecisions:
    """Warns of consecutive decisions in which every simulation was invalid: after 10, 100, 1000, ..."""

    def __init__(self) -> None:
        self._in_a_row = 0
        self._said_why = False

    def note(self, result: SearchResult, model: ForwardModel | None) -> None:
        """Count a decision.

        :param result: the search's result.
        :param model: the forward model; ``None`` if nothing was simulated.
        """
        if (result.chosen >= 0).any() or not result.invalid_rollouts:
            self._in_a_row = 0
            return
        before, self._in_a_row = self._in_a_row, self._in_a_row + len(result.chosen)
        if self._in_a_row < 10 or len(str(before)) == len(str(self._in_a_row)):
            return
        message = (
            f"All simulations of the last {self._in_a_row} decisions were invalid: nothing is chosen by "
            "search, and the policy's own actions are executed instead. "
        )
        error = "" if model is None else model.first_error
        if error:
            message += f"A copy of the environment raised {error.strip().splitlines()[-1]}"
        else:
            message += (
                "They diverged, or their observations, rewards or values were not finite. A smaller "
                "rollout_depth or beam_noise may help."
            )
        logger.error("%s%s", message, f"\n{error}" if error and not self._said_why else "")
        warnings.warn(message, stacklevel=5)
        self._said_why = True


def is_finite(values: np.ndarray) -> bool:
    """Whether all values are finite; checks the sum first, which is faster.

    :param values: array of any shape.
    """
    return bool(math.isfinite(values.sum(dtype=np.float64)) or np.isfinite(values).all())


def broken_row(observations: Any) -> tuple[int, str] | None:
    """Find an environment whose observation is not finite.

    :param observations: ``[n_envs, *]``, or a dict of such arrays.
    :return: its index, and the observation as text.
    """
    if isinstance(observations, dict):
        return next(filter(None, (broken_row(values) for values in observations.values())), None)
    values = np.asarray(observations)
    if values.dtype.kind != "f" or is_finite(values):
        return None
    index = int(np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))[0])
    return index, np.array2string(values[index], threshold=20)
