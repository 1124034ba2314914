"""Search over a forward model: proposing candidates, rolling them out, scoring, selecting."""

from sb3_mcbs.search.beam import beam_search
from sb3_mcbs.search.deadline import LatencyForecast, deadline_search
from sb3_mcbs.search.directions import RecentActions
from sb3_mcbs.search.interface import FirstStep, PolicyFunctions, Rollouts, Roots, SearchResult, policy_alone
from sb3_mcbs.search.proposals import Noise, draw_noise
from sb3_mcbs.search.settings import PRESETS, SearchSettings, with_preset
from sb3_mcbs.search.strategies import check_dynamics, search
from sb3_mcbs.search.warm_start import EpisodeClock, WarmStart

__all__ = [
    "PRESETS",
    "EpisodeClock",
    "FirstStep",
    "LatencyForecast",
    "Noise",
    "PolicyFunctions",
    "RecentActions",
    "Rollouts",
    "Roots",
    "SearchResult",
    "SearchSettings",
    "WarmStart",
    "beam_search",
    "check_dynamics",
    "deadline_search",
    "draw_noise",
    "policy_alone",
    "search",
    "with_preset",
]
