"""Stable-Baselines3 agents that search before they act, and search around trained agents."""

from sb3_mcbs.agents.learned_model import EnsembleSettings
from sb3_mcbs.agents.mcbs import MCBS
from sb3_mcbs.agents.mcbs_crossq import MCBSCrossQ
from sb3_mcbs.agents.mcbs_ddpg import MCBSDDPG
from sb3_mcbs.agents.mcbs_sac import MCBSSAC
from sb3_mcbs.agents.mcbs_td3 import MCBSTD3
from sb3_mcbs.agents.mcbs_tqc import MCBSTQC
from sb3_mcbs.agents.schedule import ScheduleSettings
from sb3_mcbs.agents.search_policy import SearchPolicy

__all__ = [
    "MCBS",
    "MCBSDDPG",
    "MCBSSAC",
    "MCBSTD3",
    "MCBSTQC",
    "EnsembleSettings",
    "MCBSCrossQ",
    "ScheduleSettings",
    "SearchPolicy",
]
