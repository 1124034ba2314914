"""The paper's reward saturation: whether the return has stopped improving, from comparable episodes.

Searched episodes return more than others, so searching less lowers the return immediately. Only comparable
episodes are therefore compared: those that began after the last change of the share, and searched ones with
searched ones only.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

#: Windows with fewer episodes are ignored.
_LEAST = 2
#: Logarithm of the odds that the accumulated shortfall is not chance (Page's test).
_ODDS = 9.0
#: Standard errors that are subtracted from the mean of the episodes since a change.
_CAUTION = 2.0
_START, _END, _TOTAL, _SEARCHED = range(4)


class Episode(NamedTuple):
    """A finished episode.

    :param start: environment steps when it began.
    :param end: environment steps when it ended.
    :param total: its return, without normalisation.
    :param searched: whether it was searched, if whole episodes are; otherwise True.
    """

    start: int
    end: int
    total: float
    searched: bool


class Saturation:
    """Decides between the full and the reduced share of searched decisions.

    Windows end at the current step. At the full share it compares the last window with the one before. At the
    reduced share it compares the last window with the highest mean so far of all episodes since the change
    (the best window would be best by luck), and accumulates the shortfall of the episodes, since some windows
    are low by chance. Differences are fractions of the gain since the training began, whatever the scale of
    rewards.

    :ivar is_reduced: whether the share is reduced.
    :ivar changes: number of changes of the share.
    """

    def __init__(self) -> None:
        self.is_reduced = False
        self.changes = 0
        self._since: int | None = None
        #: ``[n, 4]``, fields of :class:`Episode`, of the last two windows.
        self._episodes = np.zeros((0, 4))
        self._baseline: float | None = None
        self._gain = 0.0
        #: Of the episodes since the change, by kind: count and mean, and the highest mean so far.
        self._since_change: dict[bool, tuple[int, float]] = {}
        self._best: dict[bool, float] = {}
        self._lacking = 0.0

    def begin(self, step: int) -> None:
        """Note the step from which on the share applies to new episodes.

        :param step: environment steps so far; only the first call counts.
        """
        if self._since is None:
            self._since = step

    def update(
        self, finished: Sequence[Episode], window: int, tolerance: float, recovery: float, step: int
    ) -> None:
        """Record finished episodes, and change the share if the return is saturated or has fallen.

        :param finished: episodes that ended at this step.
        :param window: length of a window in environment steps.
        :param tolerance: fraction of the gain by which windows of a saturated return may differ.
        :param recovery: fraction of the gain below the best at which the return has fallen.
        :param step: environment steps so far.
        """
        kept = self._episodes[self._episodes[:, _END] > step - 2 * window]
        self._episodes = np.concatenate([kept, np.array(finished, dtype=float).reshape(-1, 4)])
        since_change = [e for e in finished if self._since is not None and e.start >= self._since]
        self._note_since_change(since_change)
        if self._baseline is None and step >= window and len(self._episodes) >= _LEAST:
            self._baseline = float(self._episodes[:, _TOTAL].mean())
        if self._since is None or self._baseline is None or step - self._since < window:
            return
        comparable = self._episodes[self._episodes[:, _START] >= self._since]
        is_last = comparable[:, _END] > step - window
        last, before = comparable[is_last], comparable[~is_last]
        if len(last) < _LEAST:
            return
        rise = float(last[:, _TOTAL].mean()) - self._baseline
        self._gain = max(self._gain, rise)
        settled = step - self._since >= 2 * window
        if self.is_reduced:
            if settled and self._has_fallen(since_change, comparable, last, recovery * self._gain):
                self._change(step)
        elif settled:
            change = _difference(last, _means(before))
            # A return that has not risen above its own noise yet is not saturated.
            has_risen = rise > float(last[:, _TOTAL].std())
            if has_risen and change is not None and abs(change) <= tolerance * self._gain:
                self._change(step)

    def _note_since_change(self, finished: Sequence[Episode]) -> None:
        for episode in finished:
            count, mean = self._since_change.get(episode.searched, (0, 0.0))
            mean += (episode.total - mean) / (count + 1)
            self._since_change[episode.searched] = count + 1, mean

    def _has_fallen(
        self, finished: Sequence[Episode], comparable: np.ndarray, last: np.ndarray, least: float
    ) -> bool:
        """Whether returns have been below the best for too long to be chance.

        :param finished: episodes that began after the last change and ended at this step.
        :param comparable: ``[n, 4]``, episodes of the last two windows.
        :param last: ``[n, 4]``, episodes of the last window.
        :param least: the smallest difference that counts.
        """
        variance = _variance(comparable)
        for kind, (count, mean) in self._since_change.items():
            mean -= _CAUTION * (variance / count) ** 0.5
            self._best[kind] = max(mean, self._best.get(kind, mean))
        for episode in finished:
            if episode.searched in self._best:
                lacks = self._best[episode.searched] - episode.total - least
                self._lacking = max(0.0, self._lacking + lacks)
        change = _difference(last, self._best)
        return change is not None and -change > least and self._lacking > 0.5 * _ODDS * variance / least

    def _change(self, step: int) -> None:
        self.is_reduced = not self.is_reduced
        self.changes += 1
        self._since = step
        self._since_change, self._best, self._lacking = {}, {}, 0.0


def _means(episodes: np.ndarray) -> dict[bool, float]:
    """The mean return of each kind of episode with enough episodes.

    :param episodes: ``[n, 4]``, fields of :class:`Episode`.
    """
    return {kind: float(totals.mean()) for kind, totals in _returns(episodes).items()}


def _returns(episodes: np.ndarray) -> dict[bool, np.ndarray]:
    """The returns of each kind of episode with enough episodes."""
    by_kind = {kind: episodes[episodes[:, _SEARCHED] == kind, _TOTAL] for kind in (False, True)}
    return {kind: totals for kind, totals in by_kind.items() if len(totals) >= _LEAST}


def _variance(episodes: np.ndarray) -> float:
    """The variance of returns around the mean of their kind.

    :param episodes: ``[n, 4]``, fields of :class:`Episode`, two or more.
    """
    returns = _returns(episodes)
    squares = sum(float(np.square(totals - totals.mean()).sum()) for totals in returns.values())
    return squares / max(len(episodes) - len(returns), 1)


def _difference(episodes: np.ndarray, reference: dict[bool, float]) -> float | None:
    """How much more the episodes return than a reference, averaged over kinds.

    :param episodes: ``[n, 4]``, fields of :class:`Episode`.
    :param reference: mean returns by kind.
    :return: ``None`` without a common kind.
    """
    differences = {
        kind: mean - reference[kind] for kind, mean in _means(episodes).items() if kind in reference
    }
    if not differences:
        return None
    weights = [np.count_nonzero(episodes[:, _SEARCHED] == kind) for kind in differences]
    return float(np.average(list(differences.values()), weights=weights))
