"""Pictures that are legible in light and dark: SVG whose colours the page chooses, and PNG."""

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import matplotlib
import numpy as np

from sb3_mcbs.experiments.report.statistics import Estimate

#: Colours of Okabe and Ito, which colour-blind people can tell apart. The page has lighter ones.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
MARKERS = ("o", "s", "^", "D", "v", "P")
INK = "#1b1f24"
MUTED = "#6a737d"
#: Of the background, where something has to stand out from what lies below it.
GROUND = "#fdfdfe"
WIDTH = 5.2
#: Of a curve: more would hide it.
MAX_MARKERS = 25
_STYLE: Any = {
    "font.size": 10.5, "svg.fonttype": "none", "svg.hashsalt": "sb3-mcbs", "figure.facecolor": GROUND,
    "axes.facecolor": "none", "axes.edgecolor": MUTED, "axes.labelcolor": INK, "text.color": INK,
    "xtick.color": MUTED, "ytick.color": MUTED, "xtick.labelcolor": INK, "ytick.labelcolor": INK,
    "axes.spines.top": False, "axes.spines.right": False, "grid.color": MUTED, "grid.alpha": 0.25,
    "text.parse_math": False, "legend.frameon": False, "figure.constrained_layout.use": True,
}  # fmt: skip
#: What the page replaces by its own colours.
_VARIABLES = {
    INK: "currentColor",
    MUTED: "var(--muted)",
    GROUND: "var(--ground)",
    **{colour: f"var(--series-{index})" for index, colour in enumerate(COLOURS)},
}


class Look(NamedTuple):
    """
    How a competitor is drawn.

    :param colour: of its arm
    :param marker: of its arm
    :param filled: with search; the actor alone has open markers and broken lines
    """

    colour: str
    marker: str
    filled: bool

    @property
    def line(self) -> dict[str, Any]:
        """Of a curve, as Matplotlib's arguments."""
        face = self.colour if self.filled else GROUND
        return {"color": self.colour, "marker": self.marker, "markerfacecolor": face, "markersize": 5,
                "linestyle": "-" if self.filled else (0, (4, 2))}  # fmt: skip


@dataclass(frozen=True)
class Drawing:
    """
    A picture as files.

    :param svg: on a light background
    :param png: the same
    """

    svg: str
    png: bytes

    def inline(self, name: str, alt: str) -> str:
        """
        :param name: what no other picture of the page is called
        :param alt: what it shows, in words; quotes and angle brackets are escaped already
        :return: the SVG as a part of a page, in the page's colours
        """
        text = self.svg[self.svg.index("<svg") :]
        text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
        text = re.sub(r'\b(id="|href="#|url\(#)', rf"\g<1>{name}-", text)
        for colour, variable in _VARIABLES.items():
            text = text.replace(colour, variable)
        view = re.search(r'viewBox="[^"]*"', text)
        assert view is not None, "Matplotlib writes a viewBox"
        start = (
            f'<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" {view[0]} '
            f'role="img" aria-label="{alt}">'
        )
        return start + text[text.index(">") + 1 :].strip()


class Row(NamedTuple):
    """
    A line of a picture of dots.

    :param label: its name
    :param look: how it is drawn; None: a published figure
    :param dots: every seed
    :param estimate: over the seeds
    """

    label: str
    look: Look | None
    dots: Sequence[float]
    estimate: Estimate


class Line(NamedTuple):
    """
    A curve.

    :param look: how it is drawn
    :param x: of all runs together
    :param centre: of all runs together
    :param low: of its interval; None: there is none
    :param high: of its interval
    :param runs: ``(x, y)`` of every run
    """

    look: Look
    x: np.ndarray
    centre: np.ndarray
    low: np.ndarray | None
    high: np.ndarray | None
    runs: list[tuple[np.ndarray, np.ndarray]]


def _figure(height: float) -> Any:
    # Without pyplot, which would choose a backend for the whole process, perhaps one with windows.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, height))
    FigureCanvasAgg(figure)
    return figure


def _finish(figure: Any) -> Drawing:
    png, svg = io.BytesIO(), io.StringIO()
    figure.savefig(png, format="png", dpi=150)
    figure.set_layout_engine("none")  # it stays as it is, and is not worked out again
    figure.patch.set_alpha(0)
    figure.savefig(svg, format="svg", metadata={"Date": None})
    return Drawing(svg.getvalue(), png.getvalue())


def draw_curves(
    lines: list[Line],
    legend: list[tuple[str, Look]],
    xlabel: str,
    log: bool = False,
    published: Sequence[tuple[str, np.ndarray, np.ndarray]] = (),
) -> Drawing:
    """
    :param lines: learning curves
    :param legend: names and looks
    :param xlabel: what the horizontal axis is
    :param log: whether that is logarithmic
    :param published: names, steps and returns of others' curves
    :return: returns over the axis
    """
    with matplotlib.rc_context(_STYLE):
        columns = 1 if max(len(label) for label, _ in legend) > 24 else 2
        figure = _figure(3.5 + 0.24 * -(-len(legend) // columns))
        axes = figure.add_subplot()
        for line in lines:
            for x, y in line.runs:
                axes.plot(x, y, color=line.look.colour, linewidth=0.7, alpha=0.45,
                          linestyle=line.look.line["linestyle"])  # fmt: skip
            if line.low is not None:
                axes.fill_between(
                    line.x, line.low, line.high, color=line.look.colour, alpha=0.15, linewidth=0
                )
            every = -(-len(line.x) // MAX_MARKERS)
            axes.plot(line.x, line.centre, linewidth=2, markevery=every, **line.look.line)
        if log:
            axes.set_xscale("log")
        for _, x, y in published:
            axes.plot(x, y, color=MUTED, linewidth=1.2, linestyle=":", marker=".", zorder=1)
        _name_ends(axes, published)
        axes.set(xlabel=xlabel, ylabel="return")
        if log:
            low, high = axes.get_xlim()
            places = (1.0,) if high / low > 100 else (1.0, 2.0, 5.0)
            axes.xaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=places))
            axes.xaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())
        else:
            axes.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(6))
        axes.xaxis.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda value, _: tick(value)))
        axes.yaxis.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda value, _: tick(value)))
        axes.grid()
        handles = [
            matplotlib.lines.Line2D([], [], label=label, linewidth=2, **look.line) for label, look in legend
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=9.5)
        return _finish(figure)


def tick(value: float) -> str:
    """
    :param value: of an axis
    :return: it, with k for thousands and M for millions
    """
    return (
        f"{value / 1e6:g}M"
        if abs(value) >= 1e6
        else f"{value / 1e3:g}k"
        if abs(value) >= 1e3
        else f"{value:g}"
    )


def _name_ends(axes: Any, published: Sequence[tuple[str, np.ndarray, np.ndarray]]) -> None:
    """Write the names of published curves at their ends, one below the other."""
    if not published:
        return
    low, high = axes.get_ylim()
    gap = (high - low) / 18
    names = sorted(published, key=lambda each: each[2][-1])
    places: list[float] = []
    for _, _, y in names:
        places.append(max([y[-1], low + gap, *(place + gap for place in places[-1:])]))
    below = high + gap
    for (name, x, y), place in zip(reversed(names), reversed(places), strict=True):
        below = min(place, below - gap)
        axes.annotate(
            name, (x[-1], y[-1]), (1.02, below), textcoords=axes.get_yaxis_transform(), va="center",
            fontsize=8, color=MUTED, arrowprops={"arrowstyle": "-", "color": MUTED, "linewidth": 0.4},
        )  # fmt: skip


def draw_dots(rows: Sequence[Row], xlabel: str, at: float | None = None, unit: bool = False) -> Drawing:
    """
    :param rows: from top to bottom
    :param xlabel: what is drawn
    :param at: where a line tells better from worse
    :param unit: whether the axis is that of a probability
    :return: estimates with their intervals, and every seed
    """
    with matplotlib.rc_context(_STYLE):
        lines = sum(1 + row.label.count("\n") for row in rows)
        figure = _figure(0.8 + 0.16 * len(rows) + 0.19 * lines)
        axes = figure.add_subplot()
        for place, row in enumerate(rows):
            colour, marker, filled = row.look or Look(MUTED, "d", True)
            axes.plot(row.dots, [place] * len(row.dots), "|", color=colour, markersize=9, alpha=0.7)
            value, low, high, _ = row.estimate
            if low is not None and high is not None:
                axes.plot([low, high], [place, place], color=colour, linewidth=2.5, alpha=0.6)
            face = colour if filled else GROUND
            axes.plot(value, place, marker, color=colour, markersize=7.5, markerfacecolor=face,
                      markeredgewidth=1.5)  # fmt: skip
        if at is not None:
            axes.axvline(at, color=MUTED, linewidth=1, linestyle="--", zorder=0)
        if unit:
            axes.set_xlim(-0.03, 1.03)
        else:
            axes.margins(x=0.08)
            axes.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(5))
            axes.xaxis.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda value, _: tick(value)))
        axes.set_yticks(range(len(rows)), [row.label for row in rows], fontsize=9.5)
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xlabel(xlabel)
        axes.grid(axis="x")
        return _finish(figure)


def draw_heat(
    values: np.ndarray, widths: Sequence[int], depths: Sequence[int], text: Sequence[Sequence[str]]
) -> Drawing:
    """
    :param values: ``[widths, depths]``, nan: nothing is known
    :param widths: of the beam
    :param depths: of the rollouts
    :param text: what is written into the cells
    :return: a coloured table
    """
    with matplotlib.rc_context(_STYLE):
        figure = _figure(0.9 + 0.6 * len(widths))
        axes = figure.add_subplot()
        known = values[np.isfinite(values)]
        span = matplotlib.colors.Normalize(known.min(), known.max())
        colours = matplotlib.colormaps["cividis"]
        axes.pcolormesh(np.ma.masked_invalid(values), cmap=colours, norm=span, edgecolors=GROUND, linewidth=2)
        for (row, column), value in np.ndenumerate(values):
            colour = MUTED if np.isnan(value) else "#ffffff" if span(value) < 0.5 else "#000000"
            axes.text(
                column + 0.5,
                row + 0.5,
                text[row][column],
                ha="center",
                va="center",
                color=colour,
                fontsize=10,
            )
        axes.set_xticks(np.arange(len(depths)) + 0.5, [str(depth) for depth in depths])
        axes.set_yticks(np.arange(len(widths)) + 0.5, [str(width) for width in widths])
        axes.set(xlabel="rollout depth D", ylabel="beam width B")
        axes.tick_params(length=0)
        for spine in axes.spines.values():
            spine.set_visible(False)
        return _finish(figure)
