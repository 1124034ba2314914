"""
Puts this package's algorithms and its ExperimentManager into RL Zoo's tables.

Called by the import hook, module by module while RL Zoo is being imported, or at once by :func:`register`.
Nothing here may import RL Zoo at the top: the hook calls from the middle of RL Zoo's own import.
"""

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_mcbs.algorithms import MCBSTD3
from sb3_mcbs.zoo.sampler import convert_mcbs_td3_params, sample_mcbs_td3_params

#: Our algorithms under their names on RL Zoo's command line.
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"mcbs_td3": MCBSTD3}


def register() -> None:
    """
    Add this package to RL Zoo: ``mcbs_td3`` becomes an algorithm of its commands.

    An installed package does this by itself as soon as ``rl_zoo3`` is imported; call it where the import hook
    is switched off. Calling it again changes nothing.

    :raises ImportError: if RL Zoo is not installed
    """
    for name in _PATCHES:
        after_import(importlib.import_module(name))


def after_import(module: ModuleType) -> None:
    """
    Add what belongs into one of RL Zoo's modules.

    :param module: a module that has just been imported; others than RL Zoo's tables are left alone
    """
    if module.__name__ in _PATCHES:
        _PATCHES[module.__name__](module)
    elif module.__name__ == "sb3_mcbs.zoo.manager" and "rl_zoo3.exp_manager" in sys.modules:
        _add_manager(sys.modules["rl_zoo3.exp_manager"])


def _add_algorithms(utils: Any) -> None:
    utils.ALGOS.update(ALGORITHMS)


def _add_samplers(hyperparams_opt: Any) -> None:
    hyperparams_opt.HYPERPARAMS_SAMPLER["mcbs_td3"] = sample_mcbs_td3_params
    hyperparams_opt.HYPERPARAMS_CONVERTER["mcbs_td3"] = convert_mcbs_td3_params


def _add_manager(exp_manager: Any) -> None:
    manager = importlib.import_module("sb3_mcbs.zoo.manager")
    subclass = getattr(manager, "MCBSExperimentManager", None)
    if subclass is None:
        return  # manager.py is importing rl_zoo3.exp_manager at this moment; it is announced again at its end
    callbacks = importlib.import_module("sb3_mcbs.zoo.callbacks")
    original = subclass.__base__
    exp_manager.EvalCallback = callbacks.SearchEvalCallback
    exp_manager.TrialEvalCallback = callbacks.SearchTrialEvalCallback
    # The commands bind the class under their own name when they are imported.
    for name in ("rl_zoo3.exp_manager", "rl_zoo3.train", "rl_zoo3.enjoy", "rl_zoo3.record_video"):
        module = sys.modules.get(name)
        if getattr(module, "ExperimentManager", None) is original:
            module.ExperimentManager = subclass  # type: ignore[union-attr]


_PATCHES: dict[str, Callable[[Any], None]] = {
    "rl_zoo3.utils": _add_algorithms,
    "rl_zoo3.hyperparams_opt": _add_samplers,
    "rl_zoo3.exp_manager": _add_manager,
}
