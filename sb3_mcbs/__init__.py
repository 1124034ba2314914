"""Look-ahead for Stable-Baselines3 agents: Monte Carlo Beam Search in exact copies of the simulator."""

from importlib.metadata import PackageNotFoundError, version

from sb3_mcbs.agents import MCBS, MCBSDDPG, MCBSSAC, MCBSTD3, MCBSTQC, MCBSCrossQ, SearchPolicy
from sb3_mcbs.agents.faults import NonFiniteError
from sb3_mcbs.checkpoints import CheckpointError, ExactCheckpointCallback, resume
from sb3_mcbs.loading import AgentFileError, load_agent, load_statistics, save_statistics
from sb3_mcbs.models import WorkerError
from sb3_mcbs.search import BeamSettings, CEMSettings, SearchSettings, TreeSettings
from sb3_mcbs.sharing import export_onnx, load_from_hub, push_to_hub
from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.snapshot.mujoco_warnings import show_warnings_once

try:
    __version__ = version("sb3-mcbs")
except PackageNotFoundError:  # a checkout that was not installed
    __version__ = "0+unknown"

show_warnings_once()
del show_warnings_once

__all__ = [
    "MCBS",
    "MCBSDDPG",
    "MCBSSAC",
    "MCBSTD3",
    "MCBSTQC",
    "AgentFileError",
    "BeamSettings",
    "CEMSettings",
    "CheckpointError",
    "ExactCheckpointCallback",
    "MCBSCrossQ",
    "NonFiniteError",
    "SearchPolicy",
    "SearchSettings",
    "SnapshotEnvWrapper",
    "TreeSettings",
    "WorkerError",
    "__version__",
    "export_onnx",
    "load_agent",
    "load_from_hub",
    "load_statistics",
    "push_to_hub",
    "resume",
    "save_statistics",
]
