"""Arranges pictures and numbers in a frame of 854 x 480 pixels."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from PIL import Image

from sb3_mcbs.video.canvas import BACKGROUND, BLACK, CURVES, GREY, WHITE, Canvas, rank_color
from sb3_mcbs.video.looks import Look

SIZE = (854, 480)
#: Of the picture beside the panel, and of each of two pictures above it.
ALONE, COMPARED = (560, 480), (427, 312)
#: Where the policy's own action is in the chart of values; most candidates are worse.
_ZERO = 0.68


@dataclass
class Shown:
    """
    What a frame says about one environment.

    :param label: who acts
    :param returns: the return so far after each step
    :param look: the last decision, if a search made it
    :param ended: how the episode ended; "": it goes on
    :param gains: of all decisions so far
    """

    label: str
    returns: list[float] = field(default_factory=list)
    look: Look | None = None
    ended: str = ""
    gains: list[float] = field(default_factory=list)


class Panel:
    """
    Draws frames.

    :param title: written above the numbers
    :param subtitle: written below it
    """

    def __init__(self, title: str, subtitle: str) -> None:
        self.title, self.subtitle = title, subtitle
        self._reach = 0.0

    def alone(self, shown: Shown, picture: Image.Image, magnified: float) -> Image.Image:
        """One environment: its picture on the left, the panel on the right.

        :param shown: what there is to say.
        :param picture: of the size ``ALONE``.
        :param magnified: by how much differences between rollouts are.
        """
        frame = Image.new("RGB", SIZE, BACKGROUND)
        frame.paste(picture)
        canvas = Canvas(SIZE[0] - ALONE[0], SIZE[1])
        left, right = 14, canvas.width - 14
        canvas.text((left, 10), self.title, 17, bold=True, fit=right - left)
        canvas.text((left, 33), self.subtitle, 13, GREY, fit=right - left)
        canvas.text((left, 60), "return so far", 14, GREY)
        canvas.text((left, 77), _number(_last(shown.returns)), 28, bold=True)
        canvas.text((right, 60), "step", 14, GREY, anchor="ra")
        canvas.text((right, 77), str(len(shown.returns)), 28, anchor="ra")
        if shown.look is not None:
            canvas.text((left, 122), "gain over the policy's action", 14, GREY)
            canvas.text((left, 140), _signed(shown.look.gain), 20, bold=True)
            canvas.text((right, 144), f"mean {_signed(_mean(shown.gains))}", 15, anchor="ra")
            count = len(shown.look.values)
            canvas.text((left, 176), f"values of {count} candidates", 14, GREY)
            self._values(canvas, shown.look, (left, 196, right, 378))
            self._legend(canvas, (left, 396, right), shown.look, magnified)
        frame.paste(canvas.image(), (ALONE[0], 0))
        _write_end(frame, shown, (ALONE[0] // 2, 20))
        return frame

    def compared(
        self, both: Sequence[Shown], pictures: Sequence[Image.Image], magnified: float
    ) -> Image.Image:
        """Two environments side by side, the panel below.

        :param both: what there is to say: first the one without search.
        :param pictures: of the size ``COMPARED``.
        :param magnified: by how much differences between rollouts are.
        """
        frame = Image.new("RGB", SIZE, BACKGROUND)
        for number, (shown, picture) in enumerate(zip(both, pictures, strict=True)):
            corner = (number * COMPARED[0], 0)
            frame.paste(picture, corner)
            label = Canvas(*COMPARED, background=None)
            label.text((10, 8), shown.label, 16, bold=True, outline=True, fit=COMPARED[0] - 120)
            label.text(
                (COMPARED[0] - 10, 8),
                _number(_last(shown.returns)),
                20,
                CURVES[number],
                True,
                "ra",
                outline=True,
            )
            top = label.image()
            frame.paste(top, corner, mask=top)
            _write_end(frame, shown, (corner[0] + COMPARED[0] // 2, 44))
        canvas = Canvas(SIZE[0], SIZE[1] - COMPARED[1])
        self._curves(canvas, both, (14, 10, COMPARED[0] - 14, canvas.height - 10))
        look = next((shown.look for shown in reversed(both) if shown.look is not None), None)
        if look is not None:
            left, right = COMPARED[0] + 14, SIZE[0] - 14
            gains = next(shown.gains for shown in reversed(both) if shown.look is look)
            canvas.text((left, 8), "gain over the policy's action", 14, GREY)
            canvas.text((right, 8), f"{_signed(look.gain)}, mean {_signed(_mean(gains))}", 14, anchor="ra")
            self._values(canvas, look, (left, 28, right, 110))
            self._legend(canvas, (left, 120, right), look, magnified)
        frame.paste(canvas.image(), (0, COMPARED[1]))
        return frame

    def _values(self, canvas: Canvas, look: Look, box: tuple[float, float, float, float]) -> None:
        """A bar for each candidate, the best on top, from the value of the policy's own action."""
        left, top, right, bottom = box
        values = look.values[np.isfinite(look.values)]
        if not len(values):
            canvas.text((left, top), "nothing to compare", 14)
            return
        order = [
            index for index in np.argsort(-look.values, kind="stable") if np.isfinite(look.values[index])
        ]
        reach = max(np.quantile(-values, 0.8) / _ZERO, values.max() / (1 - _ZERO), 1e-9)
        # The scale changes slowly, so that frames can be compared.
        self._reach = reach if not self._reach else self._reach + 0.1 * (reach - self._reach)
        reach = max(self._reach, values.max() / (1 - _ZERO))
        zero, unit = left + _ZERO * (right - left), (right - left) / reach
        low, height = bottom - 18, (bottom - 18 - top) / len(order)
        gap = min(0.2 * height, 3.0)
        for place, index in enumerate(order):
            end = min(max(zero + look.values[index] * unit, left), right)
            upper, lower = top + place * height + gap / 2, top + (place + 1) * height - gap / 2
            if index == look.chosen:  # at least a mark, where the gain is small
                canvas.box(min(zero, end) - 3, upper - 1, max(zero, end) + 3, lower + 1, WHITE)
            start, stop = sorted((zero, end))
            canvas.box(start - 0.5, upper, stop + 0.5, lower, rank_color(look.ranks[index]))
        canvas.line([(zero, top - 2), (zero, low + 2)], WHITE, 1.5)
        for value, x, anchor in (
            (-_ZERO * reach, left, "la"),
            (0.0, zero, "ma"),
            ((1 - _ZERO) * reach, right, "ra"),
        ):
            canvas.text((x, low + 4), _signed(value), 13, GREY, anchor=anchor)

    def _legend(self, canvas: Canvas, box: tuple[float, float, float], look: Look, magnified: float) -> None:
        """What colours and lines mean: two lines of text."""
        left, top, right = box
        for pixel in range(60):
            canvas.box(left + pixel, top + 3, left + pixel + 1, top + 13, rank_color(pixel / 59))
        canvas.text((left + 68, top), "worst to best", 13)
        if look.own is None:
            return
        middle = left + 172
        canvas.line([(middle, top + 8), (middle + 24, top + 8)], BLACK, 8)
        canvas.line([(middle, top + 8), (middle + 24, top + 8)], rank_color(1.0), 6)
        canvas.text((middle + 34, top), "chosen", 13)
        below = top + 20
        canvas.line([(left, below + 8), (left + 24, below + 8)], WHITE, 2.5)
        canvas.text((left + 34, below), "the policy's own action", 13)
        if magnified != 1:
            text = f"differences drawn x {magnified:g}"
            place = (left, below + 20) if right - left < 300 else (right, below)
            canvas.text(place, text, 13, GREY, anchor="la" if right - left < 300 else "ra")

    def _curves(self, canvas: Canvas, both: Sequence[Shown], box: tuple[float, float, float, float]) -> None:
        """The returns so far, over steps."""
        left, top, right, bottom = box
        steps = max(max(len(shown.returns) for shown in both), 2)
        everything = [value for shown in both for value in shown.returns] or [0.0]
        low, high = min(0.0, *everything), max(0.0, *everything)
        high = high if high > low else low + 1
        canvas.text((left, 8), "return so far", 14, GREY)
        canvas.text((right, 8), f"step {steps if everything != [0.0] else 0}", 14, GREY, anchor="ra")
        upper = top + 24
        for shown, color in zip(both, CURVES, strict=True):
            # No more points than pixels.
            every = max(len(shown.returns) // 400, 1)
            numbers = range(0, len(shown.returns), every)
            x = [left + (right - left) * number / (steps - 1) for number in numbers]
            y = [bottom - (bottom - upper) * (shown.returns[n] - low) / (high - low) for n in numbers]
            if x:
                canvas.line(list(zip(x, y, strict=True)), color, 2.5)
        at_zero = bottom - (bottom - upper) * (0 - low) / (high - low)
        canvas.line([(left, at_zero), (right, at_zero)], GREY, 1)


def _write_end(frame: Image.Image, shown: Shown, centre: tuple[int, int]) -> None:
    if shown.ended:
        note = Canvas(320, 28, background=None)
        note.text((160, 14), shown.ended, 16, bold=True, anchor="mm", outline=True)
        top = note.image()
        frame.paste(top, (centre[0] - 160, centre[1] - 14), mask=top)


def _last(values: Sequence[float]) -> float:
    return values[-1] if values else 0.0


def _mean(values: Sequence[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return float(np.mean(finite)) if finite else math.nan


def _number(value: float) -> str:
    return f"{value:.1f}".replace("-", "\u2212")


def _signed(value: float) -> str:
    """Three digits with a sign."""
    if not math.isfinite(value):
        return "unknown"
    return f"{value:+.3g}".replace("-", "\u2212") if value else "0"
