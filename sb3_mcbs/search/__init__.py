"""Search with a forward model: propose candidates, roll them out, score and select."""

from sb3_mcbs.search.beam import beam_search
from sb3_mcbs.search.cem import EpisodeClock, WarmStart
from sb3_mcbs.search.deadline import LatencyForecast, deadline_search
from sb3_mcbs.search.interface import FirstStep, PolicyFunctions, Rollouts, Roots, SearchResult, policy_alone
from sb3_mcbs.search.proposals import Noise, RecentActions, draw_noise
from sb3_mcbs.search.settings import PRESETS, SearchSettings, make_settings, with_preset
from sb3_mcbs.search.strategies import check_dynamics, search
from sb3_mcbs.search.strategy_settings import BeamSettings, CEMSettings, TreeSettings

__all__ = [
    "PRESETS",
    "BeamSettings",
    "CEMSettings",
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
    "TreeSettings",
    "WarmStart",
    "beam_search",
    "check_dynamics",
    "deadline_search",
    "draw_noise",
    "make_settings",
    "policy_alone",
    "search",
    "with_preset",
]
