"""Plays episodes with given reset seeds, and counts what they cost."""

import logging
import time
from typing import Any, NamedTuple

from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

logger = logging.getLogger("sb3_mcbs")

#: Steps of an episode after which a warning says that it may have no end.
LONG = 100_000


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
    length = simulated_steps = 0

    def count(*_: Any) -> None:
        nonlocal length, simulated_steps
        length += 1
        if length == LONG:
            logger.warning(
                "The episode with reset seed %d has had no end for %d steps. If the environment never ends "
                "one, wrap it in gymnasium.wrappers.TimeLimit, or register it with max_episode_steps.",
                seed,
                LONG,
            )
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
