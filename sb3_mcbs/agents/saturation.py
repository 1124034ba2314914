"""The paper's reward saturation: whether the return has stopped improving, from comparable episodes.

Searched episodes return more than others, so that searching less lowers the return at once. What is compared
is therefore alike: episodes that began after the last change of the share, and searched ones with searched
ones only.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

#: A window with fewer episodes says nothing.
_LEAST = 2
#: Odds, as a logarithm, against what returns lack adding up by chance (Page's test).
_ODDS = 9.0
#: The mean of the episodes since a change counts so many standard errors lower than it is.
_CAUTION = 2.0
_START, _END, _TOTAL, _SEARCHED = range(4)


class Episode(NamedTuple):
    """A finished episode.

    :param start: environment steps when it began.
    :param end: environment steps when it ended.
    :param total: its return, of the environment's own rewards.
    :param searched: which kind it is: searched or not, if whole episodes are; otherwise True.
    """

    start: int
    end: int
    total: float
    searched: bool


class Saturation:
    """Decides between the full and the reduced share of searched decisions.

    Windows end at the present step. With the full share it compares the last one with the one before; with
    the reduced share it compares the last one with the best that the mean of all episodes since the change
    has been (the best window would be best by luck), and adds up over the episodes what they lack, since one
    window in many is low by chance. Differences are measured in parts of all that was gained since the
    training began, whatever the scale of rewards is.

    :ivar is_reduced: whether the share is the reduced one.
    :ivar changes: how often that has changed.
    """

    def __init__(self) -> None:
        self.is_reduced = False
        self.changes = 0
        self._since: int | None = None
        #: ``[n, 4]``, as :class:`Episode`: those of the last two windows.
        self._episodes = np.zeros((0, 4))
        self._baseline: float | None = None
        self._gain = 0.0
        #: Of the episodes since the change, by kind: count and mean, and the best that the mean has been.
        self._since_change: dict[bool, tuple[int, float]] = {}
        self._best: dict[bool, float] = {}
        self._lacking = 0.0

    def begin(self, step: int) -> None:
        """Episodes that begin from now on are searched as the share says.

        :param step: environment steps so far; only the first call counts.
        """
        if self._since is None:
            self._since = step

    def update(
        self, finished: Sequence[Episode], window: int, tolerance: float, recovery: float, step: int
    ) -> None:
        """Learn from finished episodes, and change the share if it is time to.

        :param finished: episodes that ended at this step.
        :param window: environment steps.
        :param tolerance: part of the gain by which windows of a saturated return may differ.
        :param recovery: part of the gain below the best at which the return has fallen.
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
            # A return that has never risen above its own noise is not saturated: it has yet to improve.
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
        """Whether returns have been lower than the best for so long that it is not chance.

        :param finished: episodes that began after the last change and ended at this step.
        :param comparable: ``[n, 4]``, of the last two windows.
        :param last: ``[n, 4]``, of the last one.
        :param least: how much lower, at least.
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
    """The mean return of each kind of episode, if there are enough of it.

    :param episodes: ``[n, 4]``, as :class:`Episode`.
    """
    return {kind: float(totals.mean()) for kind, totals in _returns(episodes).items()}


def _returns(episodes: np.ndarray) -> dict[bool, np.ndarray]:
    """The returns of each kind of episode, if there are enough of it."""
    by_kind = {kind: episodes[episodes[:, _SEARCHED] == kind, _TOTAL] for kind in (False, True)}
    return {kind: totals for kind, totals in by_kind.items() if len(totals) >= _LEAST}


def _variance(episodes: np.ndarray) -> float:
    """The variance of returns around the mean of their kind.

    :param episodes: ``[n, 4]``, as :class:`Episode`, two or more.
    """
    returns = _returns(episodes)
    squares = sum(float(np.square(totals - totals.mean()).sum()) for totals in returns.values())
    return squares / max(len(episodes) - len(returns), 1)


def _difference(episodes: np.ndarray, reference: dict[bool, float]) -> float | None:
    """How much more the episodes return than those of a reference, kind by kind.

    :param episodes: ``[n, 4]``, as :class:`Episode`.
    :param reference: mean returns by kind.
    :return: ``None`` if they have no kind in common.
    """
    differences = {
        kind: mean - reference[kind] for kind, mean in _means(episodes).items() if kind in reference
    }
    if not differences:
        return None
    weights = [np.count_nonzero(episodes[:, _SEARCHED] == kind) for kind in differences]
    return float(np.average(list(differences.values()), weights=weights))
