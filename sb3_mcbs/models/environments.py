"""Runs functions on the real environments, in the process where each of them lives."""

import os
import pickle
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any
from weakref import WeakKeyDictionary, finalize, ref

import cloudpickle
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_mcbs.models.workers import await_answers, collect_tracebacks, worker_error
from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.types import ForwardModelError

_Call = tuple[Callable[..., Any], tuple[Any, ...]]

# Calls that workers still have to make for objects of this process that were collected.
_OVERDUE: WeakKeyDictionary[SubprocVecEnv, list[_Call]] = WeakKeyDictionary()


class WrappingError(ForwardModelError, ValueError):
    """Environments of worker processes do not have a ``SnapshotEnvWrapper`` outermost."""


class Environments(ABC):
    """The environments of a vectorized environment, in this process or in workers."""

    @abstractmethod
    def __len__(self) -> int:
        """How many environments there are."""

    @abstractmethod
    def apply_each(
        self, env_indices: Sequence[int], function: Callable[..., Any], args_per_env: Sequence[Sequence[Any]]
    ) -> list[Any]:
        """Run a function in the process of each environment, with arguments for each.

        :param env_indices: which environments, each at most once.
        :param function: called as ``function(wrapper, *args)``, with the environment's
            :class:`~sb3_mcbs.snapshot.SnapshotEnvWrapper`. It must be importable in that process.
        :param args_per_env: the arguments for each of ``env_indices``.
        :return: the results, in the order of ``env_indices``.
        :raises WorkerError: if the worker process of an environment has ended.
        """

    def apply(self, env_indices: Sequence[int], function: Callable[..., Any], *args: Any) -> list[Any]:
        """Run a function in the process of each environment, with the same arguments.

        :param env_indices: which environments, each at most once.
        :param function: called as ``function(wrapper, *args)``.
        :return: the results, in the order of ``env_indices``.
        """
        return self.apply_each(env_indices, function, [args] * len(env_indices))

    @abstractmethod
    def when_gone(self, owner: object, function: Callable[..., Any], *args: Any) -> None:
        """Run a function on every environment once an object has been garbage-collected.

        :param owner: the object. Neither it nor the environments are kept alive.
        :param function: called as ``function(wrapper, *args)``; worker processes run it at their next call.
        :param args: further arguments.
        """


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

    def when_gone(self, owner: object, function: Callable[..., Any], *args: Any) -> None:
        wrappers = [ref(wrapper) for wrapper in self.wrappers]
        finalize(owner, _call_alive, wrappers, function, args).atexit = False


class WorkerEnvironments(Environments):
    """Environments in the worker processes of a ``SubprocVecEnv``, which run in parallel.

    :param vec_env: the ``SubprocVecEnv``, or a wrapper around one. Each environment must have been
        wrapped in a :class:`~sb3_mcbs.snapshot.SnapshotEnvWrapper`, outermost, when its worker made it.
    :raises WrappingError: if one was not.
    """

    def __init__(self, vec_env: VecEnv) -> None:
        inner = vec_env.unwrapped
        if not isinstance(inner, SubprocVecEnv):
            raise ForwardModelError(f"expected a SubprocVecEnv, got {type(inner).__name__}")
        self._check_available(inner)
        _check_wrapping(inner)
        self.vec_env = inner
        self._process = os.getpid()
        self._overdue = _OVERDUE.setdefault(inner, [])
        collect_tracebacks(inner)

    def __len__(self) -> int:
        return self.vec_env.num_envs

    def apply_each(
        self, env_indices: Sequence[int], function: Callable[..., Any], args_per_env: Sequence[Sequence[Any]]
    ) -> list[Any]:
        self._check_available(self.vec_env)
        if self._process != os.getpid():
            raise ForwardModelError(
                "the workers of this SubprocVecEnv belong to the process that this one was forked from: make "
                "new environments here, and give them to the agent with set_env()"
            )
        while self._overdue:
            overdue, its_args = self._overdue.pop()
            self._call(range(len(self)), overdue, [its_args] * len(self))
        return self._call(env_indices, function, args_per_env)

    def when_gone(self, owner: object, function: Callable[..., Any], *args: Any) -> None:
        # Deferred, since an object may be collected in the middle of a step or of another call.
        finalize(owner, self._overdue.append, (function, args)).atexit = False

    def _call(
        self, env_indices: Sequence[int], function: Callable[..., Any], args_per_env: Sequence[Sequence[Any]]
    ) -> list[Any]:
        remotes = [self.vec_env.remotes[i] for i in env_indices]
        # Pickled here, because a worker that cannot unpickle a command ends without a message.
        calls = [cloudpickle.dumps((function, tuple(args))) for args in args_per_env]
        try:
            for remote, call in zip(remotes, calls, strict=True):
                remote.send(("env_method", ("apply", (_run_call, call), {})))
            await_answers(self.vec_env, env_indices)
            # All answers are received before any error is raised, so that none is left in a pipe.
            answers = [remote.recv() for remote in remotes]
        except (EOFError, OSError) as error:
            reason = worker_error(self.vec_env, error)
            if reason is None:
                raise
            raise reason from error
        results = []
        for env_index, answer in zip(env_indices, answers, strict=True):
            raised, result, trace = pickle.loads(answer)
            if raised is not None:
                raise raised from RuntimeError(f"in the worker process of environment {env_index}:\n{trace}")
            results.append(result)
        return results

    @staticmethod
    def _check_available(vec_env: SubprocVecEnv) -> None:
        if vec_env.closed:
            raise ForwardModelError("the SubprocVecEnv was closed")
        if vec_env.waiting:
            raise ForwardModelError(
                "the workers are in the middle of a step: call step_wait() before looking ahead"
            )


class _OutermostIs:
    """Makes ``env_is_wrapped`` look for a class in the outermost wrapper only.

    A worker calls ``isinstance(layer, ...)`` for each layer, outermost first.
    """

    def __init__(self, cls: type) -> None:
        self._cls = cls
        self._asked = False

    def __instancecheck__(self, layer: object) -> bool:
        first, self._asked = not self._asked, True
        return first and isinstance(layer, self._cls)


def _check_wrapping(vec_env: SubprocVecEnv) -> None:
    outermost: Any = _OutermostIs(SnapshotEnvWrapper)
    wrong = [i for i, right in enumerate(vec_env.env_is_wrapped(outermost)) if not right]
    if not wrong:
        return
    somewhere = vec_env.env_is_wrapped(SnapshotEnvWrapper, wrong)
    # Asking a worker without the wrapper for its class_name would end that worker.
    others = [i for i, there in zip(wrong, somewhere, strict=True) if there]
    outer = dict(zip(others, vec_env.env_method("class_name", indices=others), strict=True))
    problems = []
    if len(outer) < len(wrong):
        missing = [i for i in wrong if i not in outer]
        problems.append(f"environments {missing} were made without a SnapshotEnvWrapper")
    if outer:
        problems.append(
            f"environments {list(outer)} have {', '.join(sorted(set(outer.values())))} outside of their "
            "SnapshotEnvWrapper, where a snapshot cannot see what it does"
        )
    raise WrappingError(
        f"{' and '.join(problems)}. The environments of a SubprocVecEnv live in worker processes and cannot "
        "be wrapped afterwards. Make them with the SnapshotEnvWrapper outermost, outside of Monitor too: "
        "make_vec_env(..., wrapper_class=SnapshotEnvWrapper), SubprocVecEnv([lambda: "
        "SnapshotEnvWrapper(<all other wrappers>)]), or in an RL Zoo hyperparameter file the line\n"
        "  env_wrapper: sb3_mcbs.SnapshotEnvWrapper\n"
        "(as the last of a list, if there are other wrappers)"
    )


def _call_alive(
    wrappers: Sequence["ref[SnapshotEnvWrapper]"], function: Callable[..., Any], args: tuple[Any, ...]
) -> None:
    for alive in wrappers:
        wrapper = alive()
        if wrapper is not None:
            function(wrapper, *args)


def _run_call(wrapper: SnapshotEnvWrapper, call: bytes) -> bytes:
    """Run a pickled call in a worker. An error is returned, since raising it would end the worker."""
    try:
        function, args = pickle.loads(call)
        return pickle.dumps((None, function(wrapper, *args), ""))
    except Exception as error:
        trace = traceback.format_exc()
        try:
            answer = pickle.dumps((error, None, trace))
            pickle.loads(answer)  # some exceptions can be pickled but not unpickled
            return answer
        except Exception:
            return pickle.dumps((RuntimeError(f"{type(error).__name__}: {error}"), None, trace))
