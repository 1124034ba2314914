"""The settings of the search, the schedule and value expansion as constructor parameters."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Self

from sb3_mcbs.agents.learned_model import EnsembleSettings
from sb3_mcbs.agents.schedule import ScheduleSettings
from sb3_mcbs.agents.value_expansion import ValueExpansionSettings
from sb3_mcbs.search import BeamSettings, make_settings, with_preset
from sb3_mcbs.search.checks import as_dict
from sb3_mcbs.search.settings import OF_THE_MACHINE, STRATEGIES, present_name

#: An agent's constructor parameters besides SB3's, and their defaults without a preset. The agent has them as
#: attributes. ``None`` is a dictionary without keys.
SETTINGS: dict[str, Any] = {
    "beam_width": 6,
    "rollout_depth": 3,
    "n_simulations": 5,
    "beam_noise": 0.1,
    "strategy": "beam",
    "search_kwargs": None,
    "preset": None,
    "search_schedule": "constant",
    "search_share": 1.0,
    "search_unit": "step",
    "schedule_kwargs": None,
    "forward_model": "auto",
    "model_kwargs": None,
    "value_expansion": 0,
    "expanded_share": 0.5,
    "action_noise_after_search": False,
    "matmul_precision": None,
}
GROUPS = ("search_kwargs", "schedule_kwargs", "model_kwargs")
#: Settings of presets: their default in the constructors is ``None``, which means not given.
_OF_PRESETS = ("beam_width", "rollout_depth", "n_simulations", "beam_noise", "strategy")

#: Removed settings: their former default, and the reason or replacement.
REMOVED: dict[str, tuple[Any, str]] = {
    "rollout_replay": (0.0, "learning from the search's rollouts brought nothing; value_expansion may"),
    "entropy_bonus": (False, "the search adds no entropy to values; it cost returns"),
    "tqc_value": ("mean", "TQC's value is always the mean over all quantiles"),
    "common_noise": (False, "the later actions of every rollout have their own noise; see antithetic"),
    "one_node_per_root": (False, "a tree keeps its best nodes, whichever root action they grew from"),
}
#: Settings that were keywords, and the dictionary that contains them now.
MOVED: dict[str, str] = {
    **dict.fromkeys(("rollout_noise", "noise_clip", "include_policy_action", "n_proposals"), "search_kwargs"),
    **dict.fromkeys(("antithetic", "noise_hold", "proposal_dims", "time_budget"), "search_kwargs"),
    **dict.fromkeys(("max_beam_width", "branching", "n_rounds", "n_elites", "min_noise"), "search_kwargs"),
    **dict.fromkeys(("final_search_share", "final_beam_width", "final_rollout_depth"), "schedule_kwargs"),
    **dict.fromkeys(("saturation_window", "saturation_tolerance", "recovery_tolerance"), "schedule_kwargs"),
    **dict.fromkeys(("n_threads", "ensemble_size", "ensemble_train_freq"), "model_kwargs"),
    **dict.fromkeys(("ensemble_gradient_steps", "ensemble_max_error", "ensemble_pessimism"), "model_kwargs"),
}


class RefusesOldNames:
    """Refuses removed and moved settings in the constructor, and names the replacement."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        refuse_old_names(kwargs)
        return super().__new__(cls)


def complete_settings(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Complete the settings of an agent.

    :param arguments: of its constructor, including SB3's.
    :return: the value of each of :data:`SETTINGS`.
    :raises TypeError: if a dictionary of settings is not a dictionary.
    :raises ValueError: if there is no such preset.
    """
    given = {name: value for name, value in arguments.items() if name in SETTINGS}
    for name in _OF_PRESETS:
        if given.get(name) is None:
            given.pop(name, None)
    return tidied({**SETTINGS, **with_preset(given.get("preset"), given)})


def tidied(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Bring settings into the form in which an agent keeps them.

    :param settings: by name.
    :return: the same with copies of dictionaries, and the strategy's current name.
    :raises TypeError: if a dictionary of settings is not a dictionary.
    """
    kept = dict(settings)
    for group in GROUPS:
        if kept.get(group) is not None:
            kept[group] = as_dict(group, kept[group]) or None
    if "strategy" in kept:
        kept["strategy"] = present_name(kept["strategy"])
    return kept


def refuse_old_names(names: Mapping[str, Any]) -> None:
    """Refuse settings that were removed or moved into a dictionary.

    :param names: settings by name.
    :raises TypeError: names them and their replacement.
    """
    removed = [f"{name} was removed: {REMOVED[name][1]}" for name in names if name in REMOVED]
    if removed:
        raise TypeError("; ".join(removed) + ". Leave it out.")
    for group in GROUPS:
        moved = {name: value for name, value in names.items() if MOVED.get(name) == group}
        if moved:
            verb = "is" if len(moved) == 1 else "are"
            raise TypeError(f"{', '.join(moved)} {verb} now part of {group}: write {group}={moved!r}.")


def convert_older(agent: Any) -> None:
    """Convert an agent from an older file to the current settings.

    :param agent: whose attributes have just been loaded. Removed settings at their defaults, which had no
        effect, are deleted.
    :raises TypeError: if a removed setting is not at its default.
    """
    attributes = vars(agent)
    for name, (default, reason) in REMOVED.items():
        if attributes.get(name, default) != default:
            raise TypeError(
                f"The agent was saved with {name}={attributes[name]!r}, which was removed: {reason}. To go "
                f"on without it: load(..., custom_objects={{{name!r}: {default!r}}})."
            )
        attributes.pop(name, None)
    group_flat(attributes)
    for name, default in SETTINGS.items():
        # An agent that was saved before a setting existed has its default.
        if not hasattr(agent, name):
            attributes[name] = default


def group_flat(attributes: dict[str, Any]) -> None:
    """Move settings into the dictionaries that contain them now.

    :param attributes: of an agent from an older file; changed in place. Settings of other strategies or
        forward models had no effect, and are dropped.
    """
    strategy = attributes.get("strategy")
    if isinstance(strategy, str) and strategy == "refine":
        attributes["strategy"] = strategy = "cem"
    cls = STRATEGIES.get(strategy, BeamSettings) if isinstance(strategy, str) else BeamSettings
    defaults = {f.name: f.default for each in (cls, ScheduleSettings, EnsembleSettings) for f in fields(each)}
    if attributes.get("forward_model") != "ensemble":
        defaults = {name: value for name, value in defaults.items() if not name.startswith("ensemble_")}
    found: dict[str, dict[str, Any]] = {}
    for name in MOVED.keys() & attributes.keys():
        value = attributes.pop(name)
        if name in defaults and value != defaults[name]:
            found.setdefault(MOVED[name], {})[name] = value
    for group, values in found.items():
        if attributes.get(group) is None:  # otherwise it was given when loading
            attributes[group] = values


def settings_of_preset(name: str) -> dict[str, Any]:
    """The settings that a preset replaces in an existing agent or a hyperparameter file.

    :param name: one of :data:`~sb3_mcbs.search.PRESETS`.
    :return: all settings of the search; for ``"paper"``, Algorithm 1 at every step, also the schedule, value
        expansion and ``action_noise_after_search``.
    :raises ValueError: if there is no such preset.
    """
    settings = make_settings(**with_preset(name, {})).grouped()
    for setting in OF_THE_MACHINE:
        del settings[setting]
    if name == "paper":
        for defaults in (ScheduleSettings(), ValueExpansionSettings()):
            settings |= defaults.grouped()
        settings["action_noise_after_search"] = False
    return settings
