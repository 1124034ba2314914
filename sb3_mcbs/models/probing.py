"""Random numbers in a look-ahead: whether there are any, and keeping global ones out of it."""

import sys
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.snapshot.generators import get_state, is_generator
from sb3_mcbs.snapshot.global_generators import global_states, isolated_globals
from sb3_mcbs.snapshot.spaces import random_action

_STARTS, _STEPS = 3, 12


class Randomness(NamedTuple):
    """What random numbers the steps of an environment use.

    :param any: whether there are any.
    :param shared: whether the process's global generators are among them.
    """

    any: bool
    shared: bool


def _comparable(state: Any) -> str:
    with np.printoptions(threshold=sys.maxsize):
        return repr(state)


def _shared_generators() -> list[str]:
    python_state, numpy_state, torch_state = global_states()
    torch_numbers = None if torch_state is None else torch_state.tolist()
    return [_comparable(state) for state in (python_state, numpy_state, torch_numbers)]


def _own_generators(env: gym.Env) -> list[str]:
    """The states of the generators that an environment and its wrappers hold."""
    states: list[str] = []
    layer: Any = env
    while layer is not None:
        states += [_comparable(get_state(value)) for value in vars(layer).values() if is_generator(value)]
        layer = layer.env if isinstance(layer, gym.Wrapper) else None
    return states


def _run(env: SnapshotEnvWrapper, seed: int) -> list[Any]:
    """What random actions give; the actions depend on the seed alone."""
    rng = np.random.default_rng(seed)
    seen: list[Any] = []
    for _ in range(_STEPS):
        observation, reward, terminated, _, _ = env.step(random_action(env.action_space, rng))
        values = observation.values() if isinstance(observation, dict) else (observation,)
        seen.append(([np.asarray(value).tobytes() for value in values], float(reward), bool(terminated)))
        if terminated:
            break
    return seen


def probe_randomness(wrapper: SnapshotEnvWrapper) -> Randomness:
    """Step a copy of the environment: do steps leave all generators alone, and can they be repeated?

    A probe is no proof: an environment that draws random numbers only in rare states can pass.

    :param wrapper: the environment, left as it is.
    :return: what was found. Steps that fail count as random.
    """
    found = shared = False
    copied = wrapper.clone()
    try:
        for start in range(_STARTS):
            copied.reset(seed=start)
            snapshot = copied.snapshot()
            runs = []
            for seed in (1, 2):
                with isolated_globals(seed):
                    copied.restore(snapshot, rng=np.random.default_rng(seed))
                    own, common = _own_generators(copied), _shared_generators()
                    runs.append(_run(copied, start))
                    shared = shared or _shared_generators() != common
                    found = found or _own_generators(copied) != own
            # NaN is not equal to itself, so that a simulation that fails counts as random.
            found = found or runs[0] != runs[1]
    except Exception:
        found = True
    finally:
        copied.close()
    return Randomness(found or shared, shared)
