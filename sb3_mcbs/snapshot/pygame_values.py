"""What games keep in pygame's own classes: rectangles, vectors, colours, masks, events, and surfaces."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from sb3_mcbs.snapshot.object_graph import MISSING, Capture, Restore, class_name
from sb3_mcbs.snapshot.objects import capture_content, restore_content

_SURFACE = "pygame.surface.Surface"


class _Class(NamedTuple):
    """How the objects of a class are read and written.

    :param read: returns the content, plain and not changed by what happens to the object later.
    :param arguments: of the constructor, given the content.
    :param write: gives an object, made by the constructor or one that is there, the content.
    """

    read: Callable[[Any], Any]
    arguments: Callable[[Any], Any]
    write: Callable[[Any, Any], Any]


def _of_numbers() -> _Class:
    return _Class(tuple, lambda content: content, lambda obj, content: obj.update(*content))


def _set_vector(obj: Any, content: Any) -> None:
    obj.update(*content[0])
    obj.epsilon = content[1]


def _mask_bits(mask: Any) -> Any:
    return np.asarray(memoryview(mask))


_CLASSES: dict[str, _Class] = {
    "pygame.rect.Rect": _of_numbers(),
    "pygame.rect.FRect": _of_numbers(),
    "pygame.color.Color": _of_numbers(),
    "pygame.event.Event": _Class(lambda obj: obj.type, lambda content: (content,), lambda obj, content: None),
    "pygame.mask.Mask": _Class(
        lambda obj: (obj.get_size(), _mask_bits(obj).copy()),
        lambda content: content[:1],
        lambda obj, content: np.copyto(_mask_bits(obj), content[1]),
    ),
    **dict.fromkeys(
        ("pygame.math.Vector2", "pygame.math.Vector3"),
        _Class(lambda obj: (tuple(obj), obj.epsilon), lambda content: content[0], _set_vector),
    ),
}


def value_class(cls: type) -> type | None:
    """Return the class of pygame that another one is, or derives from, whose objects are captured by value.

    :param cls: any class.
    """
    return next((base for base in cls.__mro__ if class_name(base) in (*_CLASSES, _SURFACE)), None)


def _make(cls: type, *arguments: Any) -> Any:
    """Make an object without calling the constructor of a class that derives from pygame's."""
    known: Any = value_class(cls)
    if cls is known:
        return cls(*arguments)
    made = known.__new__(cls)
    known.__init__(made, *arguments)
    return made


class PygameHandler:
    """Objects that consist of few numbers or bits, besides the attributes of those of derived classes."""

    name = "pygame"

    def capture(self, capture: Capture, obj: Any) -> Any:
        return capture(type(obj)), _class_of(type(obj)).read(obj), capture_content(capture, obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        cls, content, attributes = payload
        cls = restore(cls, MISSING if current is MISSING else type(current))
        its = _class_of(cls)
        stays = restore.is_original(index, current)
        made = restore.memo[index] = current if stays else _make(cls, *its.arguments(content))
        if stays:
            restore.do_then(its.write, made, content)
        else:
            its.write(made, content)
        restore_content(restore, attributes, made)
        return made


def _class_of(cls: type) -> _Class:
    known = value_class(cls)
    assert known is not None
    return _CLASSES[class_name(known)]


class SurfaceHandler:
    """Surfaces: their pixels, or their place in a larger one. What is shown on the display is no state.

    One that has the captured pixels already stays: most are pictures that nobody draws on.
    """

    name = "surface"

    def capture(self, capture: Capture, obj: Any) -> Any:
        if is_display(obj):
            return None
        parent = obj.get_parent()
        pixels = _pixels(obj) if parent is None else None
        cls, form = capture(type(obj)), _format(obj)
        return cls, form, pixels, capture(parent), capture_content(capture, obj)

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        if payload is None:
            return current
        cls, form, pixels, parent, attributes = payload
        cls = restore(cls, MISSING if current is MISSING else type(current))
        there = current if type(current) is cls and not is_display(current) else None
        parent = restore(parent, MISSING if there is None else there.get_parent())
        stays = restore.is_original(index, current)
        same = there is not None and _is_same(there, form, pixels, parent) and restore.claim(there)
        made = restore.memo[index] = current if stays or same else _blank_surface(cls, form, parent)
        if not same:
            restore.do_then(_draw, made, form, pixels)
        restore_content(restore, attributes, made)
        return made


class _Format(NamedTuple):
    """What a surface is besides its pixels, as plain values."""

    size: tuple[int, int]
    flags: int
    depth: int
    masks: tuple[int, ...]
    palette: tuple[tuple[int, ...], ...] | None
    colorkey: tuple[int, ...] | None
    alpha: int | None
    clip: tuple[int, ...]
    offset: tuple[int, int]


def _format(surface: Any) -> tuple[Any, ...]:
    depth, colorkey = surface.get_bitsize(), surface.get_colorkey()
    return tuple(
        _Format(
            surface.get_size(),
            surface.get_flags(),
            depth,
            surface.get_masks(),
            tuple(map(tuple, surface.get_palette())) if depth <= 8 else None,
            None if colorkey is None else tuple(colorkey),
            surface.get_alpha(),
            tuple(surface.get_clip()),
            surface.get_offset(),
        )
    )


def _rows(surface: Any) -> np.ndarray:
    """The bytes of the pixels, without those between rows: ``[height, bytes of a row]``, a view."""
    memory = np.frombuffer(surface.get_buffer(), dtype=np.uint8)
    rows = memory[: surface.get_height() * surface.get_pitch()].reshape(surface.get_height(), -1)
    return rows[:, : surface.get_width() * surface.get_bytesize()]


def _pixels(surface: Any) -> bytes:
    return _rows(surface).tobytes()


def _is_same(surface: Any, form: Any, pixels: bytes | None, parent: Any) -> bool:
    if surface.get_parent() is not parent or _format(surface) != form:
        return False
    return pixels is None or _pixels(surface) == pixels


def _blank_surface(cls: type, form: Any, parent: Any) -> Any:
    size, flags, depth, masks, *_, offset = form
    if parent is not None:
        return parent.subsurface((offset, size))
    return _make(cls, size, flags, depth, masks if depth > 8 else (0, 0, 0, 0))


def _draw(surface: Any, form: Any, pixels: bytes | None) -> None:
    form = _Format(*form)
    if pixels is not None:
        if form.palette is not None:
            surface.set_palette(form.palette)
        # Rows of surfaces of the same size may lie differently far apart in memory.
        rows = _rows(surface)
        rows[:] = np.frombuffer(pixels, dtype=np.uint8).reshape(rows.shape)
    accelerated = form.flags & sys.modules["pygame"].RLEACCEL
    surface.set_colorkey(form.colorkey, accelerated)
    surface.set_alpha(form.alpha, accelerated)
    surface.set_clip(form.clip)


def is_display(surface: Any) -> bool:
    """Return whether a surface is what the display shows, or a part of that.

    :param surface: the surface.
    """
    pygame: Any = sys.modules["pygame"]
    try:
        return surface.get_abs_parent() is pygame.display.get_surface()
    except pygame.error:  # the display was closed
        return True


@contextmanager
def display_kept() -> Iterator[None]:
    """Keep pygame running: a copy that is closed has no window, and its original may go on drawing."""
    pygame: Any = sys.modules.get("pygame")
    if pygame is None:
        yield
        return
    kept = pygame.quit, pygame.display.quit
    try:
        pygame.quit = pygame.display.quit = lambda: None
        yield
    finally:
        pygame.quit, pygame.display.quit = kept
