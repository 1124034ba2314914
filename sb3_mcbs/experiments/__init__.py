"""Experiments: many runs from one file, at once, and on again after whatever stopped them."""

from sb3_mcbs.experiments.plan import Run, expand
from sb3_mcbs.experiments.spec import Spec, SpecError, read_spec

__all__ = ["Run", "Spec", "SpecError", "expand", "read_spec"]
