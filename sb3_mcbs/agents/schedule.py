"""When to search during training, and how wide and deep."""

import functools
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from sb3_mcbs.agents.saturation import Episode, Saturation
from sb3_mcbs.search.checks import CheckedSettings
from sb3_mcbs.search.random_streams import spawn_rng
from sb3_mcbs.search.settings import MAX_DEPTH, MAX_ROLLOUTS, SearchSettings
from sb3_mcbs.search.strategy_settings import BeamSettings, CEMSettings, TreeSettings
from sb3_mcbs.types import ScheduleName, SearchUnit

SCHEDULES: tuple[ScheduleName, ...] = get_args(ScheduleName)
UNITS: tuple[SearchUnit, ...] = get_args(SearchUnit)
#: Fraction of ``search_share`` while returns are saturated, without ``final_search_share``.
_LEFT_WHEN_SATURATED = 0.2


@dataclass(frozen=True)
class ScheduleSettings(CheckedSettings):
    """Which decisions of a training are searched, and how wide and deep.

    The first three are keywords of an agent's constructor, the others are keys of ``schedule_kwargs``.

    :param search_schedule: ``"constant"``; ``"saturation"`` (``search_share`` until the return stops
        improving, then ``final_search_share``, and back when returns fall); ``"anneal"`` (from
        ``search_share``, ``beam_width`` and ``rollout_depth`` to ``final_search_share``,
        ``final_beam_width`` and ``final_rollout_depth``, linearly over the training).
    :param search_share: the share of decisions that are searched. At the others the agent acts without
        search, with its own exploration noise.
    :param search_unit: whether search is drawn for every ``"step"`` or every ``"episode"``.
    :param final_search_share: see ``search_schedule``. ``None``: a fifth of ``search_share`` with
        ``"saturation"``, no change with ``"anneal"``.
    :param final_beam_width: final width of ``"anneal"``. ``None``: no change.
    :param final_rollout_depth: final depth of ``"anneal"``. ``None``: no change.
    :param saturation_window: environment steps over which ``"saturation"`` averages returns. The share does
        not change again within two windows.
    :param saturation_tolerance: the return has stopped improving if it differs from that of the previous
        window by at most this fraction of the gain since the training began.
    :param recovery_tolerance: returns have fallen if they are below the best mean since the last change by
        more than this fraction of the gain, and for too long to be chance.
    :raises TypeError: if a value has the wrong type.
    :raises ValueError: if a value is out of range, or has no meaning with the schedule.
    """

    group = "schedule_kwargs"
    flat = ("search_schedule", "search_share", "search_unit")

    search_schedule: ScheduleName = "constant"
    search_share: float = 1.0
    search_unit: SearchUnit = "step"
    final_search_share: float | None = None
    final_beam_width: int | None = None
    final_rollout_depth: int | None = None
    saturation_window: int = 10_000
    saturation_tolerance: float = 0.05
    recovery_tolerance: float = 0.15

    def __post_init__(self) -> None:
        self._check_name("search_schedule", SCHEDULES)
        self._check_name("search_unit", UNITS)
        self._set_number("search_share", 1.0)
        if self.final_search_share is not None:
            self._set_number("final_search_share", 1.0)
        if self.final_beam_width is not None:
            self._set_integer("final_beam_width", 1, MAX_ROLLOUTS)
        if self.final_rollout_depth is not None:
            self._set_integer("final_rollout_depth", 0, MAX_DEPTH)
        self._set_integer("saturation_window", 1, 10**12)
        self._set_number("saturation_tolerance", 1.0)
        self._set_number("recovery_tolerance", 1.0)
        self._check_schedule()

    def _check_schedule(self) -> None:
        chosen = f"search_schedule={self.search_schedule!r}"
        for name, schedules in (
            ("final_search_share", ("saturation", "anneal")),
            ("final_beam_width", ("anneal",)),
            ("final_rollout_depth", ("anneal",)),
        ):
            if getattr(self, name) is not None and self.search_schedule not in schedules:
                raise ValueError(
                    f"{name} has no meaning with {chosen}: leave it out, or use {schedules[0]!r}."
                )
        ends = (self.final_search_share, self.final_beam_width, self.final_rollout_depth)
        if self.search_schedule == "anneal" and ends == (None, None, None):
            raise ValueError(
                f"{chosen} needs something to end at: final_search_share, final_beam_width or "
                "final_rollout_depth."
            )
        if self.search_schedule == "saturation":
            if self.search_share <= self.share_at_end:
                raise ValueError(
                    f"{chosen} needs a final_search_share below search_share; got {self.share_at_end} and "
                    f"{self.search_share}."
                )
            if self.recovery_tolerance <= self.saturation_tolerance:
                raise ValueError(
                    "recovery_tolerance must be above saturation_tolerance, or the schedule would "
                    f"oscillate; got {self.recovery_tolerance} and {self.saturation_tolerance}."
                )

    @property
    def share_at_end(self) -> float:
        """``final_search_share``, or its default."""
        if self.final_search_share is not None:
            return self.final_search_share
        return self.search_share * (_LEFT_WHEN_SATURATED if self.search_schedule == "saturation" else 1.0)

    @property
    def searches_always(self) -> bool:
        """Whether every decision is searched."""
        return self.search_share == 1 and self.share_at_end == 1

    def check_search(self, settings: SearchSettings) -> None:
        """Refuse final values of ``"anneal"`` that are not valid for the search.

        :param settings: settings at the beginning of the training.
        :raises ValueError: names the setting and the reason.
        """
        if self.final_beam_width is not None and isinstance(settings, TreeSettings) and settings.n_proposals:
            raise ValueError(
                "final_beam_width does not go with n_proposals of a tree, which must be a multiple of every "
                "beam_width in between: leave one of the two out."
            )
        if self.final_rollout_depth is not None:
            if isinstance(settings, CEMSettings):
                raise ValueError(
                    "final_rollout_depth does not go with strategy='cem', whose plans keep their length "
                    "from one decision to the next: leave it out, or use another strategy."
                )
            if (self.final_rollout_depth == 0) != (settings.rollout_depth == 0):
                raise ValueError(
                    "rollout_depth and final_rollout_depth must both be 0 or both be 1 or more; got "
                    f"{settings.rollout_depth} and {self.final_rollout_depth}."
                )
        most = settings.max_beam_width if isinstance(settings, BeamSettings) else None
        if self.final_beam_width is not None and most is not None:
            raise ValueError(
                "final_beam_width has no meaning with max_beam_width, which already limits the number of "
                "candidates: leave one of the two out."
            )
        end = self.annealed(settings, progress=1.0)
        largest = {name: max(getattr(settings, name), value) for name, value in end.items()}
        for when, changes in (("At the end of", end), ("With the widest and deepest search of", largest)):
            try:
                _with(settings, **changes)
            except ValueError as reason:
                raise ValueError(f"{when} the anneal: {reason}") from reason

    def annealed(self, settings: SearchSettings, progress: float) -> dict[str, int]:
        """The annealed settings at some point of the training.

        :param settings: settings at the beginning of the training.
        :param progress: of the training, from 0 to 1.
        :return: values by the names of the search's settings.
        """
        ends = {"beam_width": self.final_beam_width, "rollout_depth": self.final_rollout_depth}
        begins = {name: getattr(settings, name) for name in ends}
        return {
            name: round(begins[name] + (end - begins[name]) * progress)
            for name, end in ends.items()
            if end is not None
        }


class SearchSchedule:
    """Decides at every step which environments are searched, and how wide and deep.

    It has its own generator and always draws the same number of values, so the schedule does not affect the
    random numbers of the environments, the agent or the search.

    :param settings: settings of the schedule; may be replaced later.
    :param seed: seed of the generator.

    :ivar saturation: whether returns have stopped improving.
    """

    def __init__(self, settings: ScheduleSettings, seed: int | None) -> None:
        self.settings = settings
        self.rng = spawn_rng(seed, "schedule")
        self.saturation = Saturation()
        self._last_step = 0
        self.begin_episodes(0, 0)

    def begin_episodes(self, n_envs: int, step: int) -> None:
        """Begin new episodes in all environments.

        :param n_envs: number of environments.
        :param step: environment steps so far; fewer than before if a new training starts.
        """
        if step < self._last_step:
            self.saturation = Saturation()
        self._last_step = step
        self._starts = np.full(n_envs, step)
        self._returns = np.zeros(n_envs)
        #: Whether the episode is searched; -1 if not drawn yet.
        self._flags = np.full(n_envs, -1)

    def share(self, progress: float) -> float:
        """The current share of decisions that are searched.

        :param progress: of the training, from 0 to 1.
        """
        settings = self.settings
        if settings.search_schedule == "saturation":
            return settings.share_at_end if self.saturation.is_reduced else settings.search_share
        return settings.search_share + (settings.share_at_end - settings.search_share) * progress

    def settings_at(self, settings: SearchSettings, progress: float) -> SearchSettings:
        """The current settings of the search.

        :param settings: settings at the beginning of the training.
        :param progress: of the training, from 0 to 1.
        :return: the same, with another width and depth if they are annealed.
        """
        changes = self.settings.annealed(settings, progress)
        return _with(settings, **changes) if changes else settings

    def draw(self, progress: float, step: int) -> np.ndarray:
        """Draw which environments are searched at this step.

        :param progress: of the training, from 0 to 1.
        :param step: environment steps so far.
        :return: ``[n_envs]`` bool.
        """
        self.saturation.begin(step)
        drawn = self.rng.random(len(self._flags)) < self.share(progress)
        if self.settings.search_unit == "step":
            return drawn
        self._flags = np.where(self._flags < 0, drawn, self._flags)
        return self._flags == 1

    def record_rewards(self, rewards: np.ndarray, dones: np.ndarray, step: int) -> None:
        """Record the environments' rewards.

        :param rewards: ``[n_envs]``, not normalised.
        :param dones: ``[n_envs]``, whether an episode ended, for whatever reason.
        :param step: environment steps so far.
        """
        settings = self.settings
        self._last_step = step
        self._returns += rewards
        if not dones.any():
            return
        ended = np.flatnonzero(dones)
        searched = self._flags == 1 if settings.search_unit == "episode" else np.ones(len(dones), dtype=bool)
        finished = [
            Episode(int(self._starts[env]), step, float(self._returns[env]), bool(searched[env]))
            for env in ended
        ]
        self._starts[ended], self._returns[ended], self._flags[ended] = step, 0, -1
        if settings.search_schedule == "saturation":
            self.saturation.update(
                finished,
                settings.saturation_window,
                settings.saturation_tolerance,
                settings.recovery_tolerance,
                step,
            )


#: Cached, so that settings are checked once, not at every decision.
_with = functools.lru_cache(maxsize=16)(replace)
