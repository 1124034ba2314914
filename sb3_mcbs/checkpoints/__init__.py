"""Exact checkpoints: a run that is killed and resumed ends bit-identical to one that was never stopped."""

from sb3_mcbs.checkpoints.callback import ExactCheckpointCallback
from sb3_mcbs.checkpoints.encoding import register_state
from sb3_mcbs.checkpoints.errors import CheckpointError
from sb3_mcbs.checkpoints.interrupts import TrainingInterrupted
from sb3_mcbs.checkpoints.resume import resume

__all__ = [
    "CheckpointError",
    "ExactCheckpointCallback",
    "TrainingInterrupted",
    "register_state",
    "resume",
]
