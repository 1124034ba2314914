"""What the doctor asks of an environment: each function answers one question with plain values."""

import pickle
import statistics
import time
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import TD3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_mcbs.agents import SearchPolicy
from sb3_mcbs.models import LocalEnvironments, make_forward_model
from sb3_mcbs.snapshot import ReplayAdapter, SnapshotAdapter, SnapshotEnvWrapper
from sb3_mcbs.snapshot.registry import find_adapter
from sb3_mcbs.snapshot.spaces import random_action

#: From how many states steps are compared, each time eight after six others.
STATES = 10
#: Seconds that a measurement takes, and the most decisions in it.
MEASURED, MOST_DECISIONS = 1.5, 200
#: Layers of the untrained networks that decide if there is no agent.
LAYERS = [400, 300]


class UnsuitableError(ValueError):
    """Look-ahead cannot work with an environment; the message says why and what to do."""


def describe(env: gym.Env) -> dict[str, Any]:
    """What is it?

    :param env: the environment.
    :return: its class, its spaces, SB3's policy for its observations, and the time that a step takes.
    """
    return {
        "class": type(env.unwrapped).__name__,
        "observations": _in_words(env.observation_space),
        "actions": _in_words(env.action_space),
        "policy": policy_name(env.observation_space),
        "control_period": control_period(env),
    }


def _in_words(space: gym.Space) -> str:
    if isinstance(space, gym.spaces.Dict):
        return f"Dict of {', '.join(space.spaces)}"
    if isinstance(space, gym.spaces.Box):
        return f"Box of {' x '.join(map(str, space.shape)) or 'one number'}"
    return str(space)


def control_period(env: gym.Env) -> float | None:
    """How many seconds does the controlled system take for a step?

    :param env: the environment.
    :return: its attribute ``dt``, or one over the frames per second of its metadata; None: it does not say.
    """
    period = getattr(env.unwrapped, "dt", None)
    if not isinstance(period, float | int) or period <= 0:
        rate = env.metadata.get("render_fps")
        period = 1 / rate if isinstance(rate, float | int) and rate > 0 else None
    return None if period is None else float(period)


def check_actions(space: gym.Space) -> None:
    """Can the actions be searched?

    :param space: of the actions.
    :raises UnsuitableError: if not.
    """
    if not isinstance(space, gym.spaces.Box):
        raise UnsuitableError(
            f"The actions are {space}, and look-ahead is for continuous actions (a Box): use an algorithm "
            "for such actions, for example SB3's PPO."
        )
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        raise UnsuitableError(
            "The actions have no finite bounds, and SB3's off-policy agents scale actions to [-1, 1]: give "
            "the Box finite bounds, or wrap the environment in gymnasium.wrappers.RescaleAction."
        )


def steps_per_second(env: gym.Env) -> float:
    """How fast is the environment by itself?

    :param env: the environment, reset.
    :return: steps per second with random actions, resets included.
    """
    rng = np.random.default_rng(0)
    n_steps, start = 0, time.perf_counter()
    while (seconds := time.perf_counter() - start) < MEASURED / 3 or not n_steps:
        _, _, terminated, truncated, _ = env.step(random_action(env.action_space, rng))
        n_steps += 1
        if terminated or truncated:
            env.reset()
    return n_steps / seconds


def check_snapshots(wrapper: SnapshotEnvWrapper) -> dict[str, Any]:
    """Are snapshots exact, what captures them, and what do they cost?

    :param wrapper: the environment.
    :return: steps that were compared, adapters in words, bytes and milliseconds of a snapshot and a restore.
    :raises SnapshotError: if they are not exact.
    """
    n_steps = wrapper.check(STATES)
    wrapper.reset(seed=0)
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        snapshot = wrapper.snapshot()
        wrapper.restore(snapshot)
        seconds.append(time.perf_counter() - start)
    found = adapters(wrapper)
    return {
        "steps_compared": n_steps,
        "captured_by": [type(each).__name__ + (f" ({each.what})" if each.what else "") for each in found],
        "replays": any(each.what == ReplayAdapter.what for each in found),
        "bytes": len(pickle.dumps(snapshot)),
        "milliseconds": 1000 * statistics.median(seconds),
    }


def adapters(wrapper: SnapshotEnvWrapper) -> list[SnapshotAdapter]:
    """Which adapters capture its simulators?

    :param wrapper: the environment.
    :return: one of each class; none if all state is in Python's attributes.
    """
    found = {type(adapter): adapter for adapter in map(find_adapter, wrapper.simulators) if adapter}
    return list(found.values())


def forward_model(wrapper: SnapshotEnvWrapper) -> dict[str, Any]:
    """Which forward model simulates it, why not a faster one, and is it deterministic?

    :param wrapper: the environment.
    """
    model = make_forward_model(LocalEnvironments([wrapper]))
    try:
        return {
            "kind": model.kind,
            "description": model.description.partition(", because")[0],
            "why_not_faster": model.why_not_faster.removeprefix("environment 0: "),
            "deterministic": model.deterministic,
        }
    finally:
        model.close()


def policy_name(space: gym.Space) -> str:
    """Which of SB3's policies is for such observations?

    :param space: of the observations.
    """
    if isinstance(space, gym.spaces.Dict):
        return "MultiInputPolicy"
    return "CnnPolicy" if is_image_space(space) else "MlpPolicy"


def untrained_agent(env: VecEnv) -> OffPolicyAlgorithm:
    """A TD3 agent to measure with, where none is given.

    :param env: the environment.
    """
    policy, layers = policy_name(env.observation_space), {"net_arch": LAYERS}
    return TD3(policy, env, buffer_size=1, policy_kwargs=layers, seed=0, device="cpu")


def time_decisions(policy: SearchPolicy, env: VecEnv) -> dict[str, Any]:
    """What does a decision cost?

    :param policy: with the settings to measure.
    :param env: the environment that it acts in.
    :return: milliseconds and simulated steps of a decision, and environment steps per second with search.
    """
    env.seed(0)
    observations: Any = env.reset()
    policy.predict(observations)  # the first decision makes the copies that later ones use again
    times: list[float] = []
    simulated = n_steps = 0
    start = time.perf_counter()
    while time.perf_counter() - start < MEASURED and len(times) < MOST_DECISIONS:
        before = time.perf_counter()
        actions, _ = policy.predict(observations)
        times.append(time.perf_counter() - before)
        assert policy.last_result is not None
        simulated += policy.last_result.simulated_steps
        n_steps += 1
        observations, *_ = env.step(actions)
    seconds = time.perf_counter() - start
    return {
        "milliseconds": 1000 * statistics.median(times),
        "simulated_steps": simulated / n_steps,
        "steps_per_second": n_steps / seconds,
    }
