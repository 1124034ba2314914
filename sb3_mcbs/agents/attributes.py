"""The settings of the search as attributes of an agent, which are checked and can change during training."""

from copy import deepcopy
from typing import Any

from sb3_mcbs.agents.hyperparameters import (
    GROUPS,
    MOVED,
    REMOVED,
    SETTINGS,
    RefusesOldNames,
    refuse_old_names,
    settings_of_preset,
    tidied,
)
from sb3_mcbs.agents.schedule import ScheduleSettings
from sb3_mcbs.search import SearchSettings, with_preset


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
    #: Contents of the dictionaries at the last check.
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
