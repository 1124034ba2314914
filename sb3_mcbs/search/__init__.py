"""Search over a forward model: proposing candidates, rolling them out, scoring, selecting."""

from sb3_mcbs.search.beam import Agent, FirstStep, Noise, SearchResult, beam_search, draw_noise
from sb3_mcbs.search.deadline import Pace, deadline_search
from sb3_mcbs.search.settings import SearchSettings

__all__ = [
    "Agent",
    "FirstStep",
    "Noise",
    "Pace",
    "SearchResult",
    "SearchSettings",
    "beam_search",
    "deadline_search",
    "draw_noise",
]
