"""Finds out whether the steps of an environment draw random numbers."""

import logging
import sys
from typing import Any, NamedTuple

import numpy as np

from sb3_mcbs.snapshot import SnapshotAdapter, SnapshotEnvWrapper, SnapshotUnsupportedError
from sb3_mcbs.snapshot.generators import global_states, isolated_globals, states_in
from sb3_mcbs.snapshot.registry import find_adapter
from sb3_mcbs.snapshot.spaces import random_action, values_of

logger = logging.getLogger("sb3_mcbs")

_STARTS, _STEPS = 3, 12


class Randomness(NamedTuple):
    """Which random numbers the steps of an environment use.

    :param any: whether they use any.
    :param shared: whether they draw from the process's global generators.
    """

    any: bool
    shared: bool


def probe_randomness(wrapper: SnapshotEnvWrapper) -> Randomness | None:
    """Step a copy of the environment, to see whether generators move and whether steps can be repeated.

    A probe is no proof: an environment that draws random numbers only in rare states can pass.

    :param wrapper: the environment, left as it is.
    :return: ``None`` if the environment cannot be reset yet, for example without ``options``.
    :raises SnapshotUnsupportedError: if steps cannot be repeated although nothing was drawn: then part of the
        state is not captured.
    """
    if not wrapper.verify():
        return None
    copied = wrapper.clone()
    differs = own = shared = False
    try:
        present = copied.snapshot()
        for start in range(_STARTS):
            try:
                copied.reset(seed=start, options=wrapper.reset_arguments["options"])
            except Exception:
                if wrapper.last_observation is None:
                    return None
                copied.restore(present)  # some allow no reset in the middle of an episode
            runs = []
            snapshot = copied.snapshot()
            for seed in (1, 2):
                with isolated_globals(seed):
                    copied.restore(snapshot, rng=np.random.default_rng(seed))
                    own_before, shared_before = _own_generators(copied), _shared_generators()
                    runs.append(_run(copied, start))
                    shared = shared or _shared_generators() != shared_before
                    own = own or _own_generators(copied) != own_before
            differs = differs or runs[0] != runs[1]
        drawn = own or shared
        if differs and not drawn and not _draws_elsewhere(copied):
            _refuse(wrapper)
    finally:
        copied.close()
    return Randomness(drawn or differs, shared)


def _run(env: SnapshotEnvWrapper, seed: int) -> list[Any]:
    """The outcome of random actions, which depend on the seed alone."""
    rng = np.random.default_rng(seed)
    seen: list[Any] = []
    for _ in range(_STEPS):
        try:
            observation, reward, terminated, truncated, _ = env.step(random_action(env.action_space, rng))
        except Exception as error:
            return [*seen, f"{type(error).__name__}: {error}"]
        values = [
            repr(value.tolist()) if value.dtype.hasobject else value.tobytes()
            for value in values_of(observation)
        ]
        seen.append((values, repr(reward), bool(terminated)))
        if terminated or truncated:
            break
    return seen


def _comparable(state: Any) -> str:
    with np.printoptions(threshold=sys.maxsize):
        return repr(state)


def _shared_generators() -> list[str]:
    python_state, numpy_state, torch_state = global_states()
    return [_comparable(state) for state in (python_state, numpy_state, torch_state.tolist())]


def _own_generators(env: SnapshotEnvWrapper) -> list[str]:
    """The states of all generators that are captured with an environment."""
    return [_comparable(state) for state in states_in(env.snapshot(monitor=False).nodes)]


def _draws_elsewhere(env: SnapshotEnvWrapper) -> bool:
    """Whether an adapter has a generator of its own, which only the adapter can see."""
    adapters = [find_adapter(obj) for obj in env.simulators]
    return any(type(adapter).reseed is not SnapshotAdapter.reseed for adapter in adapters if adapter)


def _refuse(wrapper: SnapshotEnvWrapper) -> None:
    name = type(wrapper.unwrapped).__name__
    reason = (
        f"The steps of {name} do not repeat themselves after a restore, although no random generator moved: "
        "part of its state is not captured, or it draws from one that is not known."
    )
    if wrapper.verifies:
        raise SnapshotUnsupportedError(
            f"{reason} Say how it is captured with sb3_mcbs.snapshot.register_adapter(...), or learn a model "
            "with forward_model='ensemble'. With SnapshotEnvWrapper(env, verify=False) it counts as random."
        )
    logger.warning("%s It is taken for random dynamics, as verify=False asks for.", reason)
