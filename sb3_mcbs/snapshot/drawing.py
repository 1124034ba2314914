"""Packages that draw: windows and what belongs to them are no state, values are."""

from typing import Any

from sb3_mcbs.snapshot.errors import SnapshotUnsupportedError
from sb3_mcbs.snapshot.object_graph import Capture, Restore, class_name
from sb3_mcbs.snapshot.pygame_values import value_class

#: Windows, render contexts and what lies in their memory: whatever is there stays, a copy has none.
_WINDOWS = (
    "pygame.window.",
    "pygame._sdl2.",
    "pygame._render.",
    "glfw._GLFW",
    "OpenGL.",
    *(f"pyglet.{part}." for part in ("window", "gl", "graphics", "image", "canvas", "display", "app", "gui")),
    "mujoco.renderer.",
    "mujoco.viewer.",
    "mujoco.rendering.",
    "gymnasium.envs.mujoco.mujoco_rendering.",
    "gymnasium.envs.classic_control.rendering.",
    "tkinter.",
    "matplotlib.backend",
    "matplotlib.animation.",
    "matplotlib.container.",
)
#: Clocks, fonts and sounds: whatever is there stays, a copy has the same.
_SHARED = (
    "pygame.time.",
    "pygame.font.",
    "pygame.ftfont.",
    "pygame.freetype.",
    "pygame._freetype.",
    "pygame.mixer.",
    "pyglet.clock.",
    "pyglet.font.",
    "pyglet.media.",
)
#: Ordinary values in such packages.
_VALUES = ("OpenGL.constant.", "pyglet.image.ImageData", "tkinter.Variable")
#: Their places are state, and lie in the memory of a window besides.
_DRAWN = ("pyglet.shapes.", "pyglet.sprite.", "pyglet.text.", "pyglet.model.")
_ARTIST = "matplotlib.artist.Artist"


def kind_name(cls: type, name: str) -> str | None:
    """Name the kind of the objects of a class of a package that draws; None for all others.

    :param cls: the class.
    :param name: its name, or that of what it points to.
    """
    known = value_class(cls)
    if known is not None:
        return "surface" if class_name(known).startswith("pygame.surface.") else "pygame"
    if name.startswith(_DRAWN):
        return "drawn"
    if name.startswith(_VALUES):
        return None
    if name.startswith(_SHARED):
        return "constant"
    is_artist = name.startswith(("matplotlib.", "mpl_toolkits.")) and _ARTIST in map(class_name, cls.__mro__)
    return "window" if is_artist or name.startswith(_WINDOWS) else None


class DrawnHandler:
    """What is drawn in a window and keeps its place there: refused."""

    name = "drawn"

    def capture(self, capture: Capture, obj: Any) -> Any:
        raise SnapshotUnsupportedError(
            f"a {class_name(type(obj))} keeps its place in the memory of a window. Keep the numbers in "
            "attributes of the environment, and make it in render()"
        )

    def restore(self, restore: Restore, index: int, payload: Any, current: Any) -> Any:
        raise AssertionError("nothing of this kind is captured")
