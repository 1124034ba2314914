"""The settings of the search, and of what is learned from it, as parameters of constructors."""

import inspect
from collections.abc import Iterable, Mapping
from dataclasses import Field, asdict, fields
from typing import Any, TypedDict

from sb3_mcbs.agents.learned_model import EnsembleSettings
from sb3_mcbs.agents.schedule import ScheduleSettings
from sb3_mcbs.agents.value_expansion import ValueExpansionSettings
from sb3_mcbs.search import SearchSettings, with_preset
from sb3_mcbs.search.checks import CheckedSettings
from sb3_mcbs.search.settings import OF_THE_MACHINE

#: What an agent's constructor takes besides SB3's parameters, as attributes of the same names.
SETTINGS: tuple[type[CheckedSettings], ...] = (
    SearchSettings,
    ScheduleSettings,
    ValueExpansionSettings,
    EnsembleSettings,
)
SETTING_NAMES = frozenset(name for settings in SETTINGS for name in settings.names())

#: Settings that there once were: what their default was, and what there is instead.
REMOVED: dict[str, tuple[Any, str]] = {
    "rollout_replay": (0.0, "learning from the search's rollouts brought nothing; value_expansion may"),
    "entropy_bonus": (False, "the search adds no entropy to values; it cost returns"),
    "tqc_value": ("mean", "TQC's value is always the mean over all quantiles"),
    "common_noise": (False, "the later actions of every rollout have noise of their own; see antithetic"),
    "one_node_per_root": (False, "a tree keeps its best nodes, whichever root action they grew from"),
}

_SEARCH_SETTINGS = "search_settings"


class SearchKeywords(TypedDict, total=False):
    """The fields of :data:`SETTINGS` as keyword arguments, for type checkers."""

    beam_width: int
    rollout_depth: int
    n_simulations: int
    beam_noise: float
    rollout_noise: float | None
    noise_clip: float | None
    include_policy_action: bool
    n_threads: int
    forward_model: str
    matmul_precision: str | None
    time_budget: float | None
    max_beam_width: int | None
    strategy: str
    n_proposals: int | None
    antithetic: bool
    branching: int
    n_rounds: int
    n_elites: int | None
    min_noise: float
    noise_hold: int
    proposal_dims: int | None
    search_schedule: str
    search_share: float
    search_unit: str
    final_search_share: float | None
    final_beam_width: int | None
    final_rollout_depth: int | None
    saturation_window: int
    saturation_tolerance: float
    recovery_tolerance: float
    value_expansion: int
    expanded_share: float
    ensemble_size: int
    ensemble_train_freq: int
    ensemble_gradient_steps: int
    ensemble_max_error: float
    ensemble_pessimism: float


def list_search_settings(cls: type) -> None:
    """Put the search settings one by one where the constructor has them as ``**search_settings``.

    ``help``, :mod:`inspect` and exact checkpoints then see them like SB3's own parameters.

    :param cls: changed in place; nothing is done for a class without that parameter.
    """
    init: Any = cls.__dict__.get("__init__")
    signature = None if init is None else inspect.signature(init)
    if signature is None or _SEARCH_SETTINGS not in signature.parameters:
        return
    listed = [
        inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=field.type
        )
        for field in setting_fields()
    ]
    *others, _ = signature.parameters.values()
    init.__signature__ = signature.replace(parameters=[*others, *listed])
    if cls.__doc__:  # there is none under ``python -OO``
        before, _, _ = inspect.cleandoc(cls.__doc__).partition(f":param {_SEARCH_SETTINGS}:")
        cls.__doc__ = before + "".join(_parameters_documented(settings) for settings in SETTINGS)


def complete_settings(
    cls_name: str, given: Mapping[str, object], preset: str | None = None
) -> dict[str, object]:
    """All settings of an agent.

    :param cls_name: of the agent, for errors.
    :param given: those that its constructor was given.
    :param preset: where the others start from, see :func:`~sb3_mcbs.search.with_preset`.
    :return: the value of every field of :data:`SETTINGS`.
    :raises TypeError: if there is no such setting.
    :raises ValueError: if there is no such preset.
    """
    refuse_removed(given)
    known = {field.name: field.default for field in setting_fields()}
    unknown = sorted(given.keys() - known.keys())
    if unknown:
        raise TypeError(
            f"{cls_name} got unexpected keyword arguments {unknown}; the settings of the search are "
            f"{list(known)}."
        )
    return {**known, **with_preset(preset, given)}


def refuse_removed(names: Iterable[str]) -> None:
    """Refuse settings that there once were.

    :param names: of settings.
    :raises TypeError: names them, and says what there is instead.
    """
    found = [f"{name} was removed: {REMOVED[name][1]}" for name in names if name in REMOVED]
    if found:
        raise TypeError("; ".join(found) + ". Leave it out.")


def drop_removed(attributes: dict[str, Any]) -> None:
    """Take removed settings with their defaults, which changed nothing, off an agent of an older file.

    :param attributes: of the agent; changed.
    :raises TypeError: if one has another value.
    """
    for name, (default, reason) in REMOVED.items():
        if attributes.get(name, default) != default:
            raise TypeError(
                f"The agent was saved with {name}={attributes[name]!r}, which was removed: {reason}. To go "
                f"on without it: load(..., custom_objects={{{name!r}: {default!r}}})."
            )
        attributes.pop(name, None)


def settings_of_preset(name: str) -> dict[str, Any]:
    """What an agent that was made with other settings, or a hyperparameter file, takes over from a preset.

    :param name: one of :data:`~sb3_mcbs.search.PRESETS`.
    :return: every setting of how is searched; for ``"paper"``, which is Algorithm 1 at every step, also those
        of when is searched, what is learned from simulations and whether searched actions get noise.
    :raises ValueError: if there is no such preset.
    """
    settings = asdict(SearchSettings.preset(name))
    for setting in OF_THE_MACHINE:
        del settings[setting]
    if name == "paper":
        for defaults in (ScheduleSettings(), ValueExpansionSettings()):
            settings |= asdict(defaults)
        settings["action_noise_after_search"] = False
    return settings


def setting_fields() -> list[Field]:
    """The fields of :data:`SETTINGS`."""
    return [field for settings in SETTINGS for field in fields(settings)]


def _parameters_documented(cls: type) -> str:
    """The lines of a class's docstring that are about its parameters."""
    _, first, after = inspect.cleandoc(cls.__doc__ or "").partition(":param ")
    return first + after.partition(":raises ")[0]
