"""Where the real environments live, and how to run a function next to each of them."""

import pickle
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import cloudpickle
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_mcbs.models.base import ForwardModelError
from sb3_mcbs.models.workers import await_answers, collect_tracebacks, worker_error
from sb3_mcbs.snapshot import SnapshotEnvWrapper


class Environments(ABC):
    """The environments of a vectorized environment, wherever they run."""

    @abstractmethod
    def __len__(self) -> int:
        """How many environments there are."""

    @abstractmethod
    def apply_each(
        self, env_indices: Sequence[int], function: Callable[..., Any], args_per_env: Sequence[Sequence[Any]]
    ) -> list[Any]:
        """Run a function next to some environments, each with arguments of its own.

        :param env_indices: which environments, each at most once.
        :param function: called as ``function(wrapper, *args)``, with the environment's
            :class:`~sb3_mcbs.snapshot.SnapshotEnvWrapper`. It must be importable where the
            environment lives.
        :param args_per_env: the arguments for each of ``env_indices``.
        :return: the results, in the order of ``env_indices``.
        :raises WorkerError: if the worker process of an environment has ended.
        """

    def apply(self, env_indices: Sequence[int], function: Callable[..., Any], *args: Any) -> list[Any]:
        """Run a function next to some environments, with the same arguments.

        :param env_indices: which environments, each at most once.
        :param function: called as ``function(wrapper, *args)``.
        :return: the results, in the order of ``env_indices``.
        """
        return self.apply_each(env_indices, function, [args] * len(env_indices))


class LocalEnvironments(Environments):
    """Environments of this process.

    :param wrappers: one :class:`~sb3_mcbs.snapshot.SnapshotEnvWrapper` per environment.
    """

    def __init__(self, wrappers: Sequence[SnapshotEnvWrapper]) -> None:
        for number, wrapper in enumerate(wrappers):
            if not isinstance(wrapper, SnapshotEnvWrapper):
                raise ForwardModelError(
                    f"environment {number} is {wrapper}, not a SnapshotEnvWrapper: wrap it in one"
                )
        self.wrappers = list(wrappers)

    def __len__(self) -> int:
        return len(self.wrappers)

    def apply_each(
        self, env_indices: Sequence[int], function: Callable[..., Any], args_per_env: Sequence[Sequence[Any]]
    ) -> list[Any]:
        wrappers = self.wrappers
        return [function(wrappers[i], *args) for i, args in zip(env_indices, args_per_env, strict=True)]


class WorkerEnvironments(Environments):
    """Environments in the worker processes of a ``SubprocVecEnv``, which work at the same time.

    :param vec_env: the ``SubprocVecEnv``, or a wrapper around one. Each environment must have been
        wrapped in a :class:`~sb3_mcbs.snapshot.SnapshotEnvWrapper` when its worker made it.
    :raises ForwardModelError: if one was not.
    """

    def __init__(self, vec_env: VecEnv) -> None:
        inner = vec_env.unwrapped
        if not isinstance(inner, SubprocVecEnv):
            raise ForwardModelError(f"expected a SubprocVecEnv, got {type(inner).__name__}")
        self._check_available(inner)
        wrapped = inner.env_is_wrapped(SnapshotEnvWrapper)
        if not all(wrapped):
            missing = [i for i, there in enumerate(wrapped) if not there]
            raise ForwardModelError(
                f"the worker processes of environments {missing} made them without a SnapshotEnvWrapper, "
                "and it cannot be added afterwards; with RL Zoo add the line "
                "'env_wrapper: sb3_mcbs.SnapshotEnvWrapper' to the hyperparameters, otherwise pass "
                "wrapper_class=SnapshotEnvWrapper to make_vec_env"
            )
        self.vec_env = inner
        collect_tracebacks(inner)

    def __len__(self) -> int:
        return self.vec_env.num_envs

    def apply_each(
        self, env_indices: Sequence[int], function: Callable[..., Any], args_per_env: Sequence[Sequence[Any]]
    ) -> list[Any]:
        self._check_available(self.vec_env)
        remotes = [self.vec_env.remotes[i] for i in env_indices]
        # Packed here: what a worker cannot unpack would otherwise end the worker without a word.
        calls = [cloudpickle.dumps((function, tuple(args))) for args in args_per_env]
        try:
            for remote, call in zip(remotes, calls, strict=True):
                remote.send(("env_method", ("apply", (_run_call, call), {})))
            await_answers(self.vec_env, env_indices)
            # All answers are taken before any is judged, so that the pipes stay in step.
            answers = [remote.recv() for remote in remotes]
        except (EOFError, OSError) as error:
            reason = worker_error(self.vec_env)
            if reason is None:
                raise
            raise reason from error
        return [self._unpack(i, answer) for i, answer in zip(env_indices, answers, strict=True)]

    @staticmethod
    def _check_available(vec_env: SubprocVecEnv) -> None:
        if vec_env.closed:
            raise ForwardModelError("the SubprocVecEnv was closed")
        if vec_env.waiting:
            raise ForwardModelError(
                "the workers are in the middle of a step: call step_wait() before looking ahead"
            )

    @staticmethod
    def _unpack(env_index: int, answer: bytes) -> Any:
        error, result, trace = pickle.loads(answer)
        if error is not None:
            raise error from RuntimeError(f"in the worker process of environment {env_index}:\n{trace}")
        return result


def _run_call(wrapper: SnapshotEnvWrapper, call: bytes) -> bytes:
    """Run a packed call in a worker; pack its result, or its error, which must not end the worker."""
    try:
        function, args = pickle.loads(call)
        return pickle.dumps((None, function(wrapper, *args), ""))
    except Exception as error:
        trace = traceback.format_exc()
        try:
            return _checked(pickle.dumps((error, None, trace)))
        except Exception:
            return pickle.dumps((RuntimeError(f"{type(error).__name__}: {error}"), None, trace))


def _checked(answer: bytes) -> bytes:
    # Some exceptions can be packed but not unpacked.
    pickle.loads(answer)
    return answer
