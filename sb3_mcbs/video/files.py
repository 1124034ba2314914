"""Writes frames as a video, an animation or a strip of pictures."""

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sb3_mcbs.video.canvas import CURVES, rank_color

#: A GIF has no more pictures per second, and is no wider.
GIF_FPS, GIF_WIDTH = 12.5, 640
#: How many moments a strip shows.
STRIP = 4


class _Writer(ABC):
    """
    A file of pictures.

    :param path: the file
    :param fps: pictures per second
    """

    #: Whether the pictures follow one another in time.
    plays = True

    def __init__(self, path: Path, fps: float) -> None:
        self.path, self.fps = path, fps

    @abstractmethod
    def add(self, draw: Callable[[], Image.Image]) -> None:
        """:param draw: draws the next picture; called only if the file needs it."""

    @abstractmethod
    def finish(self) -> None:
        """Complete the file."""


def _import_ffmpeg() -> Any:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise ImportError(
            'Writing .mp4 needs imageio-ffmpeg: pip install "sb3-mcbs[video]". A .gif or .png does not.'
        ) from error
    return imageio_ffmpeg


class _Video(_Writer):
    def __init__(self, path: Path, fps: float) -> None:
        super().__init__(path, fps)
        self._ffmpeg = _import_ffmpeg()
        self._stream: Any = None

    def add(self, draw: Callable[[], Image.Image]) -> None:
        frame = draw()
        if self._stream is None:
            self._stream = self._ffmpeg.write_frames(
                str(self.path), frame.size, fps=self.fps, codec="libx264", quality=7, macro_block_size=2
            )
            self._stream.send(None)
        self._stream.send(frame.convert("RGB").tobytes())

    def finish(self) -> None:
        if self._stream is not None:
            self._stream.close()


class _Animation(_Writer):
    def __init__(self, path: Path, fps: float) -> None:
        super().__init__(path, fps)
        self._every = max(int(np.ceil(fps / GIF_FPS)), 1)
        self._count = 0
        self._frames: list[Image.Image] = []
        self._palette: Image.Image | None = None

    def add(self, draw: Callable[[], Image.Image]) -> None:
        if self._count % self._every == 0:
            frame = draw()
            size = (GIF_WIDTH, round(frame.height * GIF_WIDTH / frame.width))
            small = frame.convert("RGB").resize(size, Image.Resampling.LANCZOS)
            self._palette = self._palette or _palette(small)
            self._frames.append(small.quantize(palette=self._palette, dither=Image.Dither.NONE))
        self._count += 1

    def finish(self) -> None:
        if self._frames:
            first, *others = self._frames
            duration = 1000 * self._every / self.fps
            first.save(
                self.path, save_all=True, append_images=others, duration=duration, loop=0, optimize=True
            )


def _palette(frame: Image.Image) -> Image.Image:
    """Colours for all pictures of a GIF: those of one picture, and those of values and curves."""
    of_values = [*(rank_color(number / 45) for number in range(46)), *CURVES]
    colors = frame.quantize(256 - len(of_values)).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([*colors[: 3 * (256 - len(of_values))], *itertools.chain(*of_values)])
    return palette


class _Strip(_Writer):
    """Keeps a few pictures at equal distances, however many there will be."""

    plays = False

    def __init__(self, path: Path, fps: float) -> None:
        super().__init__(path, fps)
        self._kept: list[Image.Image] = []
        self._count, self._every = 0, 1

    def add(self, draw: Callable[[], Image.Image]) -> None:
        if self._count % self._every == 0:
            self._kept.append(draw())
            if len(self._kept) == 8 * STRIP:
                self._kept, self._every = self._kept[::2], 2 * self._every
        self._count += 1

    def finish(self) -> None:
        if not self._kept:
            return
        places = np.unique(np.linspace(0, len(self._kept) - 1, STRIP).round().astype(int))
        shown = [self._kept[place] for place in places]
        strip = Image.new("RGB", (shown[0].width, sum(frame.height for frame in shown)))
        for row, frame in enumerate(shown):
            strip.paste(frame, (0, row * frame.height))
        strip.save(self.path, optimize=True)


_WRITERS: dict[str, type[_Writer]] = {".mp4": _Video, ".gif": _Animation, ".png": _Strip}


def check_path(path: str | Path) -> Path:
    """Check early that a file can be written.

    :param path: of the video.
    :return: the same path.
    :raises ValueError: if its ending is unknown, or there is no such folder.
    :raises ImportError: if a package is missing that the format needs.
    """
    path = Path(path)
    if path.suffix.lower() not in _WRITERS:
        raise ValueError(f"{path} must end with one of {', '.join(_WRITERS)}: the ending chooses the format.")
    if not path.absolute().parent.is_dir():
        raise ValueError(f"There is no folder {path.absolute().parent}.")
    if path.suffix.lower() == ".mp4":
        _import_ffmpeg()
    return path


@contextmanager
def open_video(path: str | Path, fps: float) -> Iterator[_Writer]:
    """Write frames to a file. It is complete after the block.

    :param path: ends with ``.mp4``, ``.gif`` or ``.png``; a PNG shows four moments, one above the other.
    :param fps: pictures per second.
    :raises ValueError: if the ending is unknown, or there is no such folder.
    :raises ImportError: if a package is missing that the format needs.
    """
    path = check_path(path)
    writer = _WRITERS[path.suffix.lower()](path, fps)
    try:
        yield writer
    finally:
        writer.finish()
