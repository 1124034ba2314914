"""Forward models: many simulated states of real environments, side by side."""

from sb3_mcbs.models import gymnasium_families as _families
from sb3_mcbs.models import gymnasium_humanoids as _humanoids
from sb3_mcbs.models import gymnasium_small_families as _small_families
from sb3_mcbs.models.ensemble import Ensemble, EnsembleModel, Prediction, Transitions
from sb3_mcbs.models.environments import Environments, LocalEnvironments, WorkerEnvironments
from sb3_mcbs.models.factory import make_forward_model
from sb3_mcbs.models.families import Family, register_family
from sb3_mcbs.models.mujoco_batch import MujocoBatchModel
from sb3_mcbs.models.pool import EnvPoolModel
from sb3_mcbs.models.workers import WorkerError
from sb3_mcbs.types import ForwardModel, ForwardModelError, Observations, Transition

del _families, _humanoids, _small_families

__all__ = [
    "Ensemble",
    "EnsembleModel",
    "EnvPoolModel",
    "Environments",
    "Family",
    "ForwardModel",
    "ForwardModelError",
    "LocalEnvironments",
    "MujocoBatchModel",
    "Observations",
    "Prediction",
    "Transition",
    "Transitions",
    "WorkerEnvironments",
    "WorkerError",
    "make_forward_model",
    "register_family",
]
