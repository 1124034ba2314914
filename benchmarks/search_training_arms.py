"""The arms of ``benchmarks.search_training``: what is tried so that searching while training pays."""

from typing import Any

from stable_baselines3 import TD3

from sb3_mcbs import MCBSTD3
from sb3_mcbs.algorithms.td3_update import FastUpdate


class PlainTD3(FastUpdate):
    """SB3's TD3 with this package's gradient step, which is the same but for rounding."""

    fast_update = True


ALGORITHM_1: dict[str, Any] = {
    "beam_width": 6,
    "rollout_depth": 3,
    "n_simulations": 5,
    "beam_noise": 0.1,
    "n_threads": 1,
}

ARMS: dict[str, tuple[type[TD3], dict[str, Any]]] = {
    "td3": (PlainTD3, {}),
    "algorithm1": (MCBSTD3, ALGORITHM_1),
}
