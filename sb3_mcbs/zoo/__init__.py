"""Integration with RL Zoo: registration, evaluation of both policies, tuning, repeating runs."""

import importlib
from types import ModuleType

from sb3_mcbs.zoo.paths import hyperparams_path

__all__ = ["MissingZooError", "hyperparams_path", "register"]

#: Packages of the extra ``zoo`` that this package imports itself.
_OF_ZOO = ("jinja2", "optuna", "rich", "rl_zoo3")


class MissingZooError(ImportError):
    """RL Zoo, or a package that its commands need, is not installed; the message says what to do."""


def import_with_zoo(name: str) -> ModuleType:
    """
    :param name: of a module that may need RL Zoo
    :return: the module
    :raises MissingZooError: if RL Zoo or one of its packages is not installed
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in _OF_ZOO:
            raise
        raise MissingZooError(
            f"{missing} is not installed. It belongs to RL Zoo's commands: pip install 'sb3-mcbs[zoo]'"
        ) from error


def register() -> None:
    """
    Add ``mcbs_td3`` and the other algorithms of this package to RL Zoo's commands.

    An installed package does this by itself when ``rl_zoo3`` is imported. Call it if the import hook is
    switched off. Calling it again changes nothing.

    :raises MissingZooError: if RL Zoo is not installed
    """
    import_with_zoo("rl_zoo3")
    import_with_zoo("sb3_mcbs.zoo.registration").register_all()
