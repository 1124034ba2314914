"""Reading strangers' model files without running code from them."""

from sb3_mcbs.loading.archive import AgentFileError
from sb3_mcbs.loading.load_agent import load_agent
from sb3_mcbs.loading.normalization import load_statistics, save_statistics

__all__ = ["AgentFileError", "load_agent", "load_statistics", "save_statistics"]
