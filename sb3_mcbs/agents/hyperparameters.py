"""The settings of the search, and of what is learned from it: parameters of constructors, then attributes."""

import importlib
import inspect
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import fields
from typing import Any, Self

from sb3_mcbs.agents.learned_model import EnsembleSettings
from sb3_mcbs.agents.presets import OF_PRESETS, TRAINING, decide_expansion, settings_of_preset
from sb3_mcbs.agents.schedule import ScheduleSettings
from sb3_mcbs.agents.value_expansion import EXPANSION
from sb3_mcbs.search import BeamSettings, SearchSettings, with_preset
from sb3_mcbs.search.checks import as_dict
from sb3_mcbs.search.settings import STRATEGIES, merged, present_name
from sb3_mcbs.types import Backend, MatmulPrecision, Preset, ScheduleName, SearchUnit, Strategy

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
    "branch_length": 0,
    "action_noise_after_search": False,
    "matmul_precision": None,
}
GROUPS = ("search_kwargs", "schedule_kwargs", "model_kwargs")

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
OLD_NAMES = frozenset({*REMOVED, *MOVED})
#: Modules whose objects are part of saved agents: where they once were, and where they are.
_MOVED_MODULES = {
    "sb3_mcbs.algorithms": "sb3_mcbs.agents",
    "sb3_mcbs.algorithms.learned_model": "sb3_mcbs.agents.learned_model",
    "sb3_mcbs.search.schedule": "sb3_mcbs.agents.schedule",
    "sb3_mcbs.search.saturation": "sb3_mcbs.agents.saturation",
    "sb3_mcbs.search.directions": "sb3_mcbs.search.proposals",
}


class RefusesOldNames:
    """Refuses removed and moved settings in the constructor, and names the replacement."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        refuse_old_names(kwargs, cls)
        return super().__new__(cls)


def _old_names(names: Iterable[str], cls: type | None = None) -> set[str]:
    """Find the names of settings that were removed or moved.

    :param names: any names.
    :param cls: a class whose constructor may have parameters of such names itself.
    """
    found = OLD_NAMES.intersection(names)
    if found and cls is not None:
        found = found.difference(inspect.signature(cls.__init__).parameters)  # type: ignore[misc]
    return set(found)


def sb3_arguments(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """What the constructor of an agent passes on to SB3's.

    :param arguments: of the constructor, ``locals()``.
    """
    ours = {*SETTINGS, "fast_update", "cuda_graphs", "self", "__class__"}
    passed_on = {name: value for name, value in arguments.items() if name not in ours}
    return {**passed_on, "_init_setup_model": False}


def complete_settings(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Complete the settings of an agent.

    :param arguments: of its constructor, including SB3's.
    :return: the value of each of :data:`SETTINGS`, and what :func:`decide_expansion` adds.
    :raises TypeError: if a dictionary of settings is not a dictionary.
    :raises ValueError: if there is no such preset.
    """
    given = {name: value for name, value in arguments.items() if name in SETTINGS}
    for name in OF_PRESETS:
        if given.get(name) is None:
            given.pop(name, None)
    combined = with_preset(given.get("preset"), given)
    of_training = TRAINING.get(given.get("preset", ""), {})
    return tidied({**SETTINGS, **of_training, **combined, **decide_expansion(given)})


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


def refuse_old_names(names: Mapping[str, Any], cls: type | None = None) -> None:
    """Refuse settings that were removed or moved into a dictionary.

    :param names: settings by name.
    :param cls: a class whose constructor may have parameters of such names itself.
    :raises TypeError: names them and their replacement.
    """
    old = _old_names(names, cls)
    removed = [f"{name} was removed: {REMOVED[name][1]}" for name in names if name in old & REMOVED.keys()]
    if removed:
        raise TypeError("; ".join(removed) + ". Leave it out.")
    for group in GROUPS:
        moved = {key: value for key, value in names.items() if key in old and MOVED.get(key) == group}
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
    of_its_class = attributes.keys() & MOVED.keys() - _old_names(MOVED, type(agent))
    own = {name: attributes.pop(name) for name in of_its_class}
    group_flat(attributes)
    attributes.update(own)
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


def settings_to_load(given: Mapping[str, Any]) -> dict[str, Any]:
    """The keywords of ``load``, with all settings that they replace in the file.

    :param given: keywords; a ``preset`` replaces all settings of the search that are not among them.
    :return: keywords for SB3's ``load``.
    :raises TypeError: if one has a name of older versions.
    """
    kwargs = {name: value for name, value in given.items() if value is not None or name not in OF_PRESETS}
    objects = kwargs.get("custom_objects") or {}
    refuse_old_names({**{name: objects[name] for name in MOVED.keys() & objects.keys()}, **kwargs})
    explicit = {**{name: objects[name] for name in SETTINGS.keys() & objects.keys()}, **kwargs}
    if explicit.get("preset") is not None:
        kwargs = merged(settings_of_preset(explicit["preset"]), explicit)
        kwargs |= decide_expansion(kwargs)
    elif not explicit.keys().isdisjoint(EXPANSION):
        kwargs["expansion_where_possible"] = None
    # Older files have the keys of these as attributes, which None would leave in place.
    return {name: {} if name in GROUPS and value is None else value for name, value in kwargs.items()}


@contextmanager
def moved_modules() -> Iterator[None]:
    """Let agents be unpickled that were saved before their modules were moved."""
    added = {
        old: importlib.import_module(new) for old, new in _MOVED_MODULES.items() if old not in sys.modules
    }
    sys.modules.update(added)
    try:
        yield
    finally:
        for old in added:
            del sys.modules[old]


class SearchAttributes(RefusesOldNames):
    """:data:`~sb3_mcbs.agents.hyperparameters.SETTINGS` as attributes of an agent.

    Once the agent is set up, setting one checks it together with all others. It applies from the next
    decision on::

        agent.beam_width = 20
        agent.search_kwargs = {"antithetic": True}
        agent.search_settings = TreeSettings(beam_width=4, branching=3)
        agent.preset = "balanced"

    ``agent.search_kwargs["antithetic"] = True`` is detected and checked at the next decision.
    """

    beam_width: int
    rollout_depth: int
    n_simulations: int
    beam_noise: float
    strategy: Strategy
    search_kwargs: dict[str, Any] | None
    preset: Preset | None
    search_schedule: ScheduleName
    search_share: float
    search_unit: SearchUnit
    schedule_kwargs: dict[str, Any] | None
    forward_model: Backend
    model_kwargs: dict[str, Any] | None
    value_expansion: int
    expanded_share: float
    branch_length: int
    action_noise_after_search: bool
    matmul_precision: MatmulPrecision | None
    #: Contents of the dictionaries at the last check.
    _followed: list[dict[str, Any] | None]

    def __setattr__(self, name: str, value: Any) -> None:
        if name in OLD_NAMES:
            refuse_old_names({name: value}, type(self))
        if name not in SETTINGS or not self._is_set_up:
            super().__setattr__(name, value)
        elif isinstance(getattr(type(self), name, None), property):  # a property of a class of the user's
            super().__setattr__(name, value)
            self._follow_settings()
        elif name == "preset" and value is not None:
            changes = {**settings_of_preset(value), name: value}
            self._change_settings({**changes, **decide_expansion(changes)})
        elif name in EXPANSION:
            self._change_settings({name: value, "expansion_where_possible": None})
        else:
            self._change_settings({name: value})

    @property
    def search_settings(self) -> SearchSettings:
        """The checked settings of the search. Assign an object to change them together."""
        return SearchSettings.of(self)

    @search_settings.setter
    def search_settings(self, settings: SearchSettings) -> None:
        if not isinstance(settings, SearchSettings):
            raise TypeError(f"Expected BeamSettings, TreeSettings or CEMSettings, got {settings!r}.")
        changes = settings.grouped()
        learned = {key: value for key, value in (self.model_kwargs or {}).items() if key != "n_threads"}
        changes["model_kwargs"] = {**learned, **(changes["model_kwargs"] or {})} or None
        self._change_settings(changes)

    @property
    def schedule_settings(self) -> ScheduleSettings:
        """The checked settings of the schedule. Assign an object to change them together."""
        return ScheduleSettings.of(self)

    @schedule_settings.setter
    def schedule_settings(self, settings: ScheduleSettings) -> None:
        if not isinstance(settings, ScheduleSettings):
            raise TypeError(f"Expected ScheduleSettings, got {settings!r}.")
        self._change_settings(settings.grouped())

    def _change_settings(self, changes: dict[str, Any]) -> None:
        """Change settings and apply them, or restore all of them after an error.

        :param changes: new values by name.
        :raises TypeError: if a value has the wrong type.
        :raises ValueError: if a value is out of range or does not fit the others.
        """
        attributes = vars(self)
        changes = tidied(changes)
        before = {name: attributes[name] for name in changes if name in attributes}
        attributes.update(changes)
        try:
            self._follow_settings()
        except Exception:
            for name in changes:
                del attributes[name]
            attributes.update(before)
            self._follow_settings()
            raise

    def _note_dictionaries(self) -> None:
        """Remember the checked contents of the dictionaries."""
        vars(self)["_followed"] = deepcopy([getattr(self, group) for group in GROUPS])
        own = {"strategy": self.strategy, "search_kwargs": self.search_kwargs}
        if with_preset(self.preset, own)["search_kwargs"] != self.search_kwargs:
            # With the preset, an agent made with the same arguments would have keys that were removed here.
            vars(self)["preset"] = None

    def _follow_dictionaries(self) -> None:
        """Apply changes inside the dictionaries since the last check."""
        if [getattr(self, group) for group in GROUPS] != self._followed:
            self._follow_settings()

    @property
    def _is_set_up(self) -> bool:
        """Whether changed settings must be applied."""
        raise NotImplementedError

    def _follow_settings(self) -> None:
        """Apply the current settings from the next decision on.

        :raises TypeError: if a value has the wrong type.
        :raises ValueError: if a value is out of range or does not fit the others.
        """
        raise NotImplementedError
