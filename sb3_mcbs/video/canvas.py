"""Smooth lines, boxes and text on a picture."""

import functools
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

Color = tuple[int, int, int]

WHITE, BLACK = (255, 255, 255), (0, 0, 0)
GREY: Color = (165, 172, 184)
BACKGROUND: Color = (24, 27, 33)
#: Of two curves; they differ in lightness too.
CURVES: tuple[Color, Color] = ((230, 159, 0), (86, 180, 233))
#: Everything is drawn larger and then reduced, which smooths it.
_SCALE = 3
#: The darkest colours of the colour map are hard to see before dark backgrounds.
_DARKEST = 0.15


def rank_color(rank: float) -> Color:
    """The colour of a candidate: from blue for the lowest value over green to yellow for the highest.

    The map (viridis) grows lighter with the rank, so it can be read without telling colours apart.

    :param rank: from 0 to 1.
    """
    red, green, blue, _ = matplotlib.colormaps["viridis"](_DARKEST + (1 - _DARKEST) * rank)
    return round(255 * red), round(255 * green), round(255 * blue)


@functools.cache
def _font(size: float, bold: bool) -> ImageFont.FreeTypeFont:
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size * _SCALE)


class Canvas:
    """
    A picture to draw on. Positions and sizes are in pixels, from the top left.

    :param width: of the picture
    :param height: of the picture
    :param background: None: transparent
    """

    def __init__(self, width: int, height: int, background: Color | None = BACKGROUND) -> None:
        self.width, self.height = width, height
        fill = (0, 0, 0, 0) if background is None else (*background, 255)
        self._image = Image.new("RGBA", (width * _SCALE, height * _SCALE), fill)
        self._draw = ImageDraw.Draw(self._image)

    def text(
        self,
        position: tuple[float, float],
        text: str,
        size: float = 14,
        color: Color = WHITE,
        bold: bool = False,
        anchor: str = "la",
        outline: bool = False,
        fit: float | None = None,
    ) -> None:
        """Write a line of text.

        :param position: of its anchor.
        :param text: the text.
        :param size: height of the font.
        :param color: of the letters.
        :param bold: whether they are bold.
        :param anchor: Pillow's: ``"la"`` is the left end of the upper edge, ``"ra"`` the right end.
        :param outline: whether they have a black outline.
        :param fit: the width that is there: a longer text is smaller.
        """
        x, y = (_SCALE * value for value in position)
        font = _font(size, bold)
        if fit is not None and font.getlength(text) > fit * _SCALE:
            font = _font(size * fit * _SCALE / font.getlength(text), bold)
        self._draw.text(
            (x, y),
            text,
            fill=color,
            font=font,
            anchor=anchor,
            stroke_width=2 * _SCALE if outline else 0,
            stroke_fill=BLACK,
        )

    def line(self, points: np.ndarray | Sequence[tuple[float, float]], color: Color, width: float) -> None:
        """Draw a line with round corners and ends.

        :param points: ``[n, 2]``.
        :param color: of the line.
        :param width: of the line.
        """
        scaled = [(float(x) * _SCALE, float(y) * _SCALE) for x, y in points]
        self._draw.line(scaled, fill=color, width=max(round(width * _SCALE), 1))
        radius = width * _SCALE / 2
        for x, y in scaled:
            self._draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=color)

    def box(self, left: float, top: float, right: float, bottom: float, color: Color) -> None:
        """Fill a rectangle.

        :param left: its edges.
        :param top:
        :param right:
        :param bottom:
        :param color: of the rectangle.
        """
        edges = (left * _SCALE, top * _SCALE, right * _SCALE - 1, bottom * _SCALE - 1)
        if edges[2] >= edges[0] and edges[3] >= edges[1]:
            self._draw.rectangle(edges, fill=color)

    def image(self) -> Image.Image:
        """The finished picture."""
        return self._image.reduce(_SCALE)
