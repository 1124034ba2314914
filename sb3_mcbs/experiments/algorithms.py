"""What RL Zoo can train here: algorithms, environments, hyperparameters and their types."""

import functools
import inspect
from typing import Any

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_mcbs.agents.hyperparameters import SETTINGS
from sb3_mcbs.agents.registry import SEARCHING
from sb3_mcbs.experiments.document import Document, Place
from sb3_mcbs.zoo import register
from sb3_mcbs.zoo.manager import NAMES, SEARCHABLE, checked_search_evaluation

#: Hyperparameters that are RL Zoo's own, and no parameters of an algorithm's constructor.
_OF_RL_ZOO = (
    "n_envs", "normalize", "env_wrapper", "vec_env_wrapper", "frame_stack", "noise_type", "noise_std",
    "callback", "policy_kwargs", "monitor_kwargs", "env_kwargs",
)  # fmt: skip
#: What the spec, or the command, says for all runs.
_ELSEWHERE = {
    "seed": "seeds of the spec says it",
    "env": "environments of the spec says it",
    "n_timesteps": "steps of the spec says it",
    "verbose": "every run keeps its own log",
    "tensorboard_log": "every run keeps its own log",
    "device": "it is RL Zoo's choice",
    "_init_setup_model": "RL Zoo needs it",
}
_TYPES: dict[str, tuple[type, ...]] = {"int": (int,), "float": (int, float), "bool": (bool,), "str": (str,)}


@functools.cache
def known_algorithms() -> dict[str, type[BaseAlgorithm]]:
    """
    :return: the algorithms of RL Zoo and of this package, by their names on RL Zoo's command line
    """
    register()
    from rl_zoo3.utils import ALGOS

    return dict(ALGOS)


@functools.cache
def known_environments() -> frozenset[str]:
    """
    :return: the ids that RL Zoo's training knows
    """
    import rl_zoo3.import_envs  # noqa: F401

    return frozenset(gym.registry)


@functools.cache
def _parameters(algorithm: str) -> dict[str, inspect.Parameter]:
    signature = inspect.signature(known_algorithms()[algorithm].__init__)
    return {name: each for name, each in signature.parameters.items() if name not in ("self", *_ELSEWHERE)}


def check_params(
    document: Document, place: Place, algorithm: str, params: dict[str, Any], index: Place = ()
) -> None:
    """
    :param document: the spec
    :param place: where the hyperparameters stand in it
    :param algorithm: whose hyperparameters they are
    :param params: hyperparameters by name
    :param index: where the value stands below its name
    :raises SpecError: if there is no such hyperparameter, or its value is of a wrong type
    """
    parameters = _parameters(algorithm)
    known = {*parameters, *_OF_RL_ZOO}
    if algorithm in SEARCHABLE:
        known.add("search_evaluation")
    for name, value in params.items():
        where = (*place, name, *index)
        if name in _ELSEWHERE:
            raise document.error(where, f"is no hyperparameter here: {_ELSEWHERE[name]}.")
        document.choice(where, name, known, f"hyperparameter of {algorithm}:")
        if name in parameters:
            _check_type(document, where, parameters[name], value)
        if algorithm in SEARCHING and name in NAMES and value is not None:
            document.choice(where, value, NAMES[name], name)


def check_search(document: Document, place: Place, params: dict[str, Any], index: Place = ()) -> None:
    """
    :param document: the spec
    :param place: where the settings stand in it
    :param params: settings of a search around a trained agent
    :param index: where the value stands below its name
    :raises SpecError: if there is no such setting, or its value is of a wrong type
    """
    known = _parameters("mcbs_td3").keys() - _parameters("td3").keys()
    for name, value in params.items():
        document.choice((*place, name, *index), name, known, "setting of a search:")
        check_params(document, place, "mcbs_td3", {name: value}, index)


def check_together(algorithm: str, hyperparameters: dict[str, Any]) -> None:
    """
    Check settings of the search that are right each for itself.

    :param algorithm: its name on RL Zoo's command line; ``search`` around a trained agent
    :param hyperparameters: all of them
    :raises TypeError: if a value has the wrong type
    :raises ValueError: if a value is out of range or does not fit the others
    """
    if algorithm in SEARCHING:
        settings = {name: value for name, value in hyperparameters.items() if name in {*SETTINGS, "preset"}}
        SEARCHING[algorithm]("MlpPolicy", None, _init_setup_model=False, **settings).checked_settings()
    elif algorithm == "search":
        checked_search_evaluation(hyperparameters, "td3")
    elif hyperparameters.get("search_evaluation") is not None:
        checked_search_evaluation(hyperparameters["search_evaluation"], algorithm)


def _check_type(document: Document, place: Place, parameter: inspect.Parameter, value: Any) -> None:
    """Check what is annotated as one of a few plain types; RL Zoo reads more for the others."""
    annotation = parameter.annotation
    words = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    names = [word.strip() for word in words.split("|")]
    if parameter.name == "policy" or not set(names) <= {*_TYPES, "None"}:
        return
    if value is None and "None" in names:
        return
    allowed = tuple(cls for name in names for cls in _TYPES.get(name, ()))
    if not isinstance(value, allowed) or (isinstance(value, bool) and bool not in allowed):
        raise document.error(place, f"must be of type {' or '.join(names)}, got {value!r}.")
