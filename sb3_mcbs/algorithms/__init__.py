"""SB3 algorithms that search before they act."""

from sb3_mcbs.algorithms.archive import AgentFileError
from sb3_mcbs.algorithms.load_agent import load_agent
from sb3_mcbs.algorithms.mcbs import MCBS
from sb3_mcbs.algorithms.mcbs_ddpg import MCBSDDPG
from sb3_mcbs.algorithms.mcbs_sac import MCBSSAC
from sb3_mcbs.algorithms.mcbs_td3 import MCBSTD3
from sb3_mcbs.algorithms.mcbs_tqc import MCBSTQC
from sb3_mcbs.algorithms.normalization import load_statistics, save_statistics
from sb3_mcbs.algorithms.search_policy import SearchPolicy

__all__ = [
    "MCBS",
    "MCBSDDPG",
    "MCBSSAC",
    "MCBSTD3",
    "MCBSTQC",
    "AgentFileError",
    "SearchPolicy",
    "load_agent",
    "load_statistics",
    "save_statistics",
]
