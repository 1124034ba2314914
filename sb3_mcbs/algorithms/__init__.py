"""SB3 algorithms that search before they act."""

from sb3_mcbs.algorithms.mcbs_td3 import MCBSTD3
from sb3_mcbs.algorithms.search_policy import SearchPolicy

__all__ = ["MCBSTD3", "SearchPolicy"]
