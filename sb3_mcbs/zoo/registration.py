"""
Adds this package's algorithms and its ExperimentManager to RL Zoo.

Called by the import hook for each module while RL Zoo is imported, or for all by :func:`register_all`.
This module must not import RL Zoo at the top level: the hook calls it during RL Zoo's own import.
"""

import importlib
import re
import sys
from collections.abc import Callable
from functools import partial
from types import ModuleType, SimpleNamespace
from typing import Any

from sb3_mcbs.agents.hyperparameters import MOVED, REMOVED, SETTINGS
from sb3_mcbs.agents.registry import SEARCHING
from sb3_mcbs.zoo.sampler import convert_mcbs_params, sample_mcbs_params
from sb3_mcbs.zoo.tuning import TotalTrialsCallback, TrainParser

#: Hyperparameters whose values may be names without quotes on the command line.
NAMED = frozenset(
    (*SETTINGS, *MOVED, *REMOVED, "policy", "noise_type", "env_wrapper", "vec_env_wrapper", "callback")
)


def register_all() -> None:
    """Import and patch all of RL Zoo's modules, see :func:`sb3_mcbs.zoo.register`."""
    for name in _PATCHES:
        after_import(importlib.import_module(name))


def after_import(module: ModuleType) -> None:
    """
    Patch one of RL Zoo's modules.

    :param module: a module that has just been imported; other modules are not changed
    """
    if module.__name__ in _PATCHES:
        _PATCHES[module.__name__](module)
    elif module.__name__ == "sb3_mcbs.zoo.manager" and "rl_zoo3.exp_manager" in sys.modules:
        _add_manager(sys.modules["rl_zoo3.exp_manager"])


def _add_algorithms(utils: Any) -> None:
    utils.ALGOS.update(SEARCHING)
    _accept_names(utils)


def _accept_names(utils: Any) -> None:
    """Read ``-params preset:strong`` as the text ``"strong"``: RL Zoo evaluates every value as Python."""
    store = utils.StoreDict
    evaluate = store.__call__
    if evaluate.__module__ == __name__:
        return

    def call(self: Any, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        if self.dest == "hyperparams":
            values = [_quoted(word, vars(utils)) for word in values]
        evaluate(self, parser, namespace, values, option_string)

    store.__call__ = call


def _quoted(word: str, scope: dict[str, Any]) -> str:
    """Quote a hyperparameter's value if it is an undefined name.

    :param word: an argument ``NAME:VALUE`` of the command line.
    :param scope: the namespace in which RL Zoo evaluates values.
    """
    name, _, value = word.partition(":")
    if name in NAMED and re.fullmatch(r"[A-Za-z_][\w.-]*", value):
        try:
            eval(value, scope)
        except NameError:
            return f"{name}:{value!r}"
    return word


def _add_samplers(hyperparams_opt: Any) -> None:
    for name in SEARCHING:
        base = name.removeprefix("mcbs_")
        hyperparams_opt.HYPERPARAMS_SAMPLER[name] = partial(sample_mcbs_params, base)
        hyperparams_opt.HYPERPARAMS_CONVERTER[name] = convert_mcbs_params


def _add_manager(exp_manager: Any) -> None:
    manager = importlib.import_module("sb3_mcbs.zoo.manager")
    subclass = getattr(manager, "MCBSExperimentManager", None)
    if subclass is None:
        return  # manager.py is importing rl_zoo3.exp_manager; the hook calls again when it is done
    callbacks = importlib.import_module("sb3_mcbs.zoo.callbacks")
    original = subclass.__base__
    exp_manager.EvalCallback = callbacks.SearchEvalCallback
    exp_manager.TrialEvalCallback = callbacks.SearchTrialEvalCallback
    exp_manager.MaxTrialsCallback = TotalTrialsCallback
    # The commands import the class by name.
    for name in ("rl_zoo3.exp_manager", "rl_zoo3.train", "rl_zoo3.enjoy", "rl_zoo3.record_video"):
        module = sys.modules.get(name)
        if getattr(module, "ExperimentManager", None) is original:
            module.ExperimentManager = subclass  # type: ignore[union-attr]
    for module in (sys.modules["__main__"], sys.modules.get("rl_zoo3.train")):
        # Run with -m, the command is still importing: it makes its parser later.
        if getattr(getattr(module, "__spec__", None), "name", None) == "rl_zoo3.train":
            module.argparse = SimpleNamespace(ArgumentParser=TrainParser)  # type: ignore[union-attr]


_PATCHES: dict[str, Callable[[Any], None]] = {
    "rl_zoo3.utils": _add_algorithms,
    "rl_zoo3.hyperparams_opt": _add_samplers,
    "rl_zoo3.exp_manager": _add_manager,
}
