"""The arms of ``benchmarks.search_training``: what is tried so that searching while training pays."""

from typing import Any

from stable_baselines3 import TD3

from benchmarks.search_training_agents import PlainTD3, PlanningTD3
from sb3_mcbs import MCBSTD3

ALGORITHM_1: dict[str, Any] = {
    "beam_width": 6,
    "rollout_depth": 3,
    "n_simulations": 5,
    "beam_noise": 0.1,
    "model_kwargs": {"n_threads": 1},
}

#: The search of the preset "efficient": 18 simulated steps per decision, no noise after the first action.
EFFICIENT: dict[str, Any] = {
    **ALGORITHM_1,
    "n_simulations": 1,
    "search_kwargs": {"rollout_noise": 0.0, "include_policy_action": True},
}
HALF: dict[str, Any] = {"search_share": 0.5, "search_unit": "episode"}
#: From all episodes to none.
FADING: dict[str, Any] = {
    "search_schedule": "anneal",
    "schedule_kwargs": {"final_search_share": 0.0},
    "search_unit": "episode",
}
#: Targets of 3 steps, of which two are simulated, for half of every batch.
EXPANSION: dict[str, Any] = {"value_expansion": 2}
ON_TOP: dict[str, Any] = {"action_noise_after_search": True}
#: Three times as many candidates at first.
WIDE_EARLY: dict[str, Any] = {
    "beam_width": 18,
    "search_schedule": "anneal",
    "schedule_kwargs": {"final_beam_width": 6},
}

ARMS: dict[str, tuple[type[TD3], dict[str, Any]]] = {
    "td3": (PlainTD3, {}),
    "td3_sb3": (TD3, {}),
    "td3_n3": (PlainTD3, {"n_steps": 3}),
    "algorithm1": (MCBSTD3, ALGORITHM_1),
    "efficient": (MCBSTD3, EFFICIENT),
    "half": (MCBSTD3, EFFICIENT | HALF),
    "half_steps": (MCBSTD3, EFFICIENT | {"search_share": 0.5}),
    "anneal": (
        MCBSTD3,
        EFFICIENT | {"search_schedule": "anneal", "schedule_kwargs": {"final_search_share": 0.0}},
    ),
    "anneal_episodes": (MCBSTD3, EFFICIENT | FADING),
    "half_noise": (MCBSTD3, EFFICIENT | HALF | ON_TOP),
    "half_n3": (MCBSTD3, EFFICIENT | HALF | {"n_steps": 3}),
    "half_imitation": (PlanningTD3, EFFICIENT | HALF | {"imitation": 0.1, "replan": True}),
    "half_expansion": (MCBSTD3, EFFICIENT | HALF | EXPANSION),
    "expansion": (MCBSTD3, EFFICIENT | EXPANSION | {"search_share": 0.0}),
    "half_expansion_imitation": (
        PlanningTD3,
        EFFICIENT | HALF | EXPANSION | {"imitation": 0.1, "replan": True},
    ),
    "efficient_expansion": (MCBSTD3, EFFICIENT | EXPANSION),
    "anneal_expansion": (MCBSTD3, EFFICIENT | EXPANSION | FADING),
    "half_noise_expansion": (MCBSTD3, EFFICIENT | HALF | EXPANSION | ON_TOP),
    "half_wide_expansion": (MCBSTD3, EFFICIENT | HALF | EXPANSION | WIDE_EARLY),
}
