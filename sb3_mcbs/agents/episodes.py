"""Plays episodes with given reset seeds, and counts what they cost."""

import time
from typing import Any, NamedTuple

from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv


class Episode(NamedTuple):
    """One episode of a policy.

    :param seed: that the environment was reset with.
    :param total: the return, not normalised.
    :param length: environment steps.
    :param simulated_steps: of the search; 0 if the policy does not search.
    :param seconds: wall-clock time.
    """

    seed: int
    total: float
    length: int
    simulated_steps: int
    seconds: float


def play(policy: Any, env: VecEnv, seed: int, deterministic: bool = True) -> Episode:
    """Play one episode.

    :param policy: what acts: an agent or a :class:`~sb3_mcbs.SearchPolicy`.
    :param env: a single environment with a ``Monitor``.
    :param seed: that it is reset with.
    :param deterministic: whether actions are.
    """
    simulated_steps = 0

    def count(*_: Any) -> None:
        nonlocal simulated_steps
        result = getattr(policy, "last_result", None)
        simulated_steps += 0 if result is None else int(result.simulated_steps)

    env.seed(seed)
    start = time.perf_counter()
    returns, lengths = evaluate_policy(
        policy, env, 1, deterministic, callback=count, return_episode_rewards=True, warn=False
    )
    assert isinstance(returns, list) and isinstance(lengths, list)
    seconds = time.perf_counter() - start
    return Episode(seed, float(returns[0]), int(lengths[0]), simulated_steps, seconds)
