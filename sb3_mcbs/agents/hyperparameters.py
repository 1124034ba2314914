"""The settings of the search, and of what is learned from it: parameters of constructors, then attributes."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import fields
from typing import Any, Self

from sb3_mcbs.agents.learned_model import EnsembleSettings
from sb3_mcbs.agents.schedule import ScheduleSettings
from sb3_mcbs.agents.value_expansion import ValueExpansionSettings
from sb3_mcbs.search import BeamSettings, SearchSettings, make_settings, with_preset
from sb3_mcbs.search.checks import as_dict
from sb3_mcbs.search.settings import OF_THE_MACHINE, STRATEGIES, present_name

#: What an agent's constructor takes besides SB3's parameters, as attributes of the same names: the defaults
#: without a preset. ``None`` is a dictionary without keys.
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
#: What a preset may say: ``None`` in the signature of a constructor, since any number may have been given.
_OF_PRESETS = ("beam_width", "rollout_depth", "n_simulations", "beam_noise", "strategy")

#: Settings that there once were: what their default was, and what there is instead.
REMOVED: dict[str, tuple[Any, str]] = {
    "rollout_replay": (0.0, "learning from the search's rollouts brought nothing; value_expansion may"),
    "entropy_bonus": (False, "the search adds no entropy to values; it cost returns"),
    "tqc_value": ("mean", "TQC's value is always the mean over all quantiles"),
    "common_noise": (False, "the later actions of every rollout have noise of their own; see antithetic"),
    "one_node_per_root": (False, "a tree keeps its best nodes, whichever root action they grew from"),
}
#: Settings that once were keywords themselves, and what they are part of now.
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
    """Says where a setting went that is given to the constructor as it once was."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        refuse_old_names(kwargs)
        return super().__new__(cls)


def sb3_arguments(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """What the constructor of an agent passes on to SB3's.

    :param arguments: of the constructor, ``locals()``.
    """
    ours = {*SETTINGS, "fast_update", "self", "__class__"}
    passed_on = {name: value for name, value in arguments.items() if name not in ours}
    return {**passed_on, "_init_setup_model": False}


def complete_settings(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """All settings of an agent.

    :param arguments: of its constructor, SB3's among them.
    :return: the value of each of :data:`SETTINGS`.
    :raises TypeError: if settings that should be a dictionary are none.
    :raises ValueError: if there is no such preset.
    """
    given = {name: value for name, value in arguments.items() if name in SETTINGS}
    for name in _OF_PRESETS:
        if given.get(name) is None:
            given.pop(name, None)
    return tidied({**SETTINGS, **with_preset(given.get("preset"), given)})


def tidied(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as an agent keeps them.

    :param settings: by name.
    :return: the same with copies of dictionaries, and a strategy's present name.
    :raises TypeError: if settings that should be a dictionary are none.
    """
    kept = dict(settings)
    for group in GROUPS:
        if kept.get(group) is not None:
            kept[group] = as_dict(group, kept[group]) or None
    if "strategy" in kept:
        kept["strategy"] = present_name(kept["strategy"])
    return kept


def refuse_old_names(names: Mapping[str, Any]) -> None:
    """Refuse settings that were removed, or are part of others now.

    :param names: settings by name.
    :raises TypeError: names them, and says what there is instead.
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
    """Give an agent of an older file the settings that there are now.

    :param agent: whose attributes have just been loaded. Removed ones with their defaults, which changed
        nothing, are taken off.
    :raises TypeError: if a removed one has another value than its default.
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
        # An agent that was saved before a setting existed searches as if it had its default.
        if not hasattr(agent, name):
            attributes[name] = default


def group_flat(attributes: dict[str, Any]) -> None:
    """Put settings that are part of others now where they belong.

    :param attributes: of an agent of an older file; changed. What was another strategy's or forward model's
        changed nothing, and is left out.
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
        if attributes.get(group) is None:  # else it was given when loading
            attributes[group] = values


def settings_of_preset(name: str) -> dict[str, Any]:
    """What an agent that was made with other settings, or a hyperparameter file, takes over from a preset.

    :param name: one of :data:`~sb3_mcbs.search.PRESETS`.
    :return: every setting of how is searched; for ``"paper"``, which is Algorithm 1 at every step, also those
        of when is searched, what is learned from simulations and whether searched actions get noise.
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


class SearchAttributes(RefusesOldNames):
    """:data:`~sb3_mcbs.agents.hyperparameters.SETTINGS` as attributes of an agent.

    Once the agent is set up, they are checked when they are set, together with all others, and hold from the
    next decision on::

        agent.beam_width = 20
        agent.search_kwargs = {"antithetic": True}
        agent.search_settings = TreeSettings(beam_width=4, branching=3)
        agent.preset = "balanced"

    ``agent.search_kwargs["antithetic"] = True`` is noticed, and checked, at the next decision.
    """

    beam_width: int
    rollout_depth: int
    n_simulations: int
    beam_noise: float
    strategy: str
    search_kwargs: dict[str, Any] | None
    preset: str | None
    search_schedule: str
    search_share: float
    search_unit: str
    schedule_kwargs: dict[str, Any] | None
    forward_model: str
    model_kwargs: dict[str, Any] | None
    value_expansion: int
    expanded_share: float
    action_noise_after_search: bool
    matmul_precision: str | None
    #: What the dictionaries contained when they were last checked.
    _followed: list[dict[str, Any] | None]

    def __setattr__(self, name: str, value: Any) -> None:
        if name in REMOVED or name in MOVED:
            refuse_old_names({name: value})
        if name not in SETTINGS or not self._is_set_up:
            super().__setattr__(name, value)
        elif hasattr(type(self), name):  # a property of a class of the user's
            super().__setattr__(name, value)
            self._follow_settings()
        elif name == "preset" and value is not None:
            self._change_settings({**settings_of_preset(value), name: value})
        else:
            self._change_settings({name: value})

    @property
    def search_settings(self) -> SearchSettings:
        """The settings of the search, checked. Another object changes them all at once."""
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
        """The settings of the search's schedule, checked. Another object changes them all at once."""
        return ScheduleSettings.of(self)

    @schedule_settings.setter
    def schedule_settings(self, settings: ScheduleSettings) -> None:
        if not isinstance(settings, ScheduleSettings):
            raise TypeError(f"Expected ScheduleSettings, got {settings!r}.")
        self._change_settings(settings.grouped())

    def _change_settings(self, changes: dict[str, Any]) -> None:
        """Change settings and have everything follow, or leave all as it was.

        :param changes: new values by name.
        :raises TypeError: if a value has the wrong type.
        :raises ValueError: if a value is out of range or does not go with the others.
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
        """Remember what the dictionaries contain, which was checked."""
        vars(self)["_followed"] = deepcopy([getattr(self, group) for group in GROUPS])
        own = {"strategy": self.strategy, "search_kwargs": self.search_kwargs}
        if with_preset(self.preset, own)["search_kwargs"] != self.search_kwargs:
            # An agent that is made with the same arguments would have what was taken from the preset.
            vars(self)["preset"] = None

    def _follow_dictionaries(self) -> None:
        """Follow what was changed within the dictionaries since they were last checked."""
        if [getattr(self, group) for group in GROUPS] != self._followed:
            self._follow_settings()

    @property
    def _is_set_up(self) -> bool:
        """Whether settings that change have to be followed."""
        raise NotImplementedError

    def _follow_settings(self) -> None:
        """Search with the present settings from the next decision on.

        :raises TypeError: if a value has the wrong type.
        :raises ValueError: if a value is out of range or does not go with the others.
        """
        raise NotImplementedError
