"""The settings of the search as attributes of an agent: checked, and changed while it learns."""

from typing import Any

from sb3_mcbs.agents.hyperparameters import REMOVED, SETTING_NAMES, refuse_removed, settings_of_preset
from sb3_mcbs.agents.schedule import ScheduleSettings
from sb3_mcbs.search import SearchSettings
from sb3_mcbs.search.checks import CheckedSettings

_CHECKED = SETTING_NAMES | {"preset", "action_noise_after_search"}


class SearchAttributes:
    """The fields of :data:`~sb3_mcbs.agents.hyperparameters.SETTINGS` as attributes of an agent.

    Once the agent is set up, they are checked when they are set, together with all others, and hold from the
    next decision on::

        agent.beam_width = 20
        agent.search_settings = replace(agent.search_settings, strategy="tree", branching=3)
        agent.preset = "balanced"
    """

    preset: str | None
    action_noise_after_search: bool
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

    def __setattr__(self, name: str, value: Any) -> None:
        if name in REMOVED:
            refuse_removed([name])
        if name not in _CHECKED or not self._is_set_up:
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
        self._replace_settings(SearchSettings, settings)

    @property
    def schedule_settings(self) -> ScheduleSettings:
        """The settings of the search's schedule, checked. Another object changes them all at once."""
        return ScheduleSettings.of(self)

    @schedule_settings.setter
    def schedule_settings(self, settings: ScheduleSettings) -> None:
        self._replace_settings(ScheduleSettings, settings)

    def _replace_settings(self, cls: type[CheckedSettings], settings: Any) -> None:
        if type(settings) is not cls:
            raise TypeError(f"Expected {cls.__name__}, got {settings!r}.")
        self._change_settings({name: getattr(settings, name) for name in settings.names()})

    def _change_settings(self, changes: dict[str, Any]) -> None:
        """Change settings and have everything follow, or leave all as it was.

        :param changes: new values by name.
        :raises TypeError: if a value has the wrong type.
        :raises ValueError: if a value is out of range or does not go with the others.
        """
        attributes = vars(self)
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
