"""Integration with RL Zoo: registration, evaluation of both policies, tuning, repeating runs."""

from sb3_mcbs.zoo.paths import hyperparams_path
from sb3_mcbs.zoo.registration import register

__all__ = ["hyperparams_path", "register"]
