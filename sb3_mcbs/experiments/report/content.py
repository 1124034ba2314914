"""What stands in the sections of a report: tables and pictures, and how numbers and names are written."""

import html
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sb3_mcbs.experiments.report.drawing import COLOURS, MARKERS, MUTED, Drawing, Look
from sb3_mcbs.experiments.report.runs import Competitor, Results, short
from sb3_mcbs.experiments.report.statistics import Estimate
from sb3_mcbs.zoo.evaluations import SEARCH


@dataclass(frozen=True)
class Table:
    """
    Numbers.

    :param caption: what they are
    :param head: names of the columns
    :param rows: text, the first of each row is its name
    """

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Picture:
    """
    A picture and what belongs to it.

    :param name: of its files
    :param title: what it shows
    :param drawing: the picture
    :param alt: its finding in words, with numbers
    :param table: its numbers
    :param note: what else one has to know
    """

    name: str
    title: str
    drawing: Drawing
    alt: str
    table: Table
    note: str = ""

    @property
    def inline(self) -> str:
        """The picture as a part of the page."""
        return self.drawing.inline(self.name, html.escape(f"{self.title}. {self.alt}", quote=True))


def number(value: float | None) -> str:
    """
    :param value: any number
    :return: three or more digits of it
    """
    if value is None or not np.isfinite(value):
        return "–"
    if abs(value) < 1 and value:
        return f"{value:.3g}".replace("-", "−")
    digits = 0 if abs(value) >= 100 or float(value).is_integer() else 1 if abs(value) >= 10 else 2
    return f"{value:,.{digits}f}".replace("-", "−")


def estimate_text(estimate: Estimate | None) -> str:
    """
    :param estimate: a number over seeds
    :return: it and its interval
    """
    if estimate is None:
        return "–"
    if estimate.low is None or estimate.high is None:
        return number(estimate.value)
    return f"{number(estimate.value)} ({number(estimate.low)} to {number(estimate.high)})"


def name_of(results: Results, competitor: Competitor) -> str:
    """
    :param results: of a folder
    :param competitor: arm and policy
    :return: what it is called; an arm around a trained agent has one policy, which need not be said
    """
    return short(competitor.arm) if results.frozen else competitor.label


def looks(results: Results) -> dict[Competitor, Look]:
    """
    :param results: of a folder
    :return: how each competitor is drawn, everywhere
    """
    arms = list(dict.fromkeys(each.arm for each in results.competitors))
    found = {}
    for each in results.competitors:
        place = arms.index(each.arm)
        # The second round of colours has other markers.
        marker = MARKERS[(place + place // len(COLOURS)) % len(MARKERS)]
        found[each] = Look(COLOURS[place % len(COLOURS)], marker, each.policy == SEARCH)
    return found


def row_label(name: str) -> str:
    """
    :param name: of a competitor, or of a published figure
    :return: the same in lines that leave room for what is drawn
    """
    return "\n".join(textwrap.fill(part, 24) for part in name.split(": "))


def legend(shown: Sequence[Competitor], results: Results) -> list[tuple[str, Look]]:
    """
    :param shown: what is in a picture
    :param results: of a folder
    :return: an entry for each arm, and what lines of its policies look like
    """
    look = looks(results)
    arms = {each.arm: look[each] for each in shown}
    entries = [(textwrap.fill(short(arm), 44), each._replace(filled=True)) for arm, each in arms.items()]
    policies = {each.policy: Look(MUTED, "", each.policy == SEARCH) for each in shown}
    return [*entries, *policies.items()]


def slug(text: str) -> str:
    """
    :param text: any
    :return: the same as part of a file's name
    """
    return re.sub(r"\W+", "-", text)
