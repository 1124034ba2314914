"""Pictures of environments, with the rollouts of a decision where MuJoCo simulates them."""

import copy
import ctypes.util
import importlib
import math
import os
import sys
from typing import Any

import mujoco
import numpy as np
from PIL import Image, ImageOps

from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.video.bodies import body_positions, find_bodies, mujoco_data
from sb3_mcbs.video.canvas import BACKGROUND, BLACK, WHITE, Canvas, Color, rank_color
from sb3_mcbs.video.looks import Look

#: How far most candidates are drawn from the policy's own action, as a share of the picture's height.
_SPREAD = 0.15
#: How far the camera stands back to show the rollouts' ends, as a share of its distance.
_STAND_BACK = 0.3
#: How fast the camera follows the rollouts' ends.
_PAN = 0.15
_INSTALL = (
    "apt-get install libegl1 libgl1 (then MUJOCO_GL=egl works), or apt-get install libosmesa6 "
    "(MUJOCO_GL=osmesa)"
)


class RenderingError(RuntimeError):
    """No picture can be made here; the message says what is missing."""


class EnvironmentPicture:
    """
    The picture that an environment itself draws.

    :param env: with the render mode ``rgb_array``
    :param size: width and height in pixels
    """

    magnified = 1.0

    def __init__(self, env: SnapshotEnvWrapper, size: tuple[int, int]) -> None:
        self._env, self._size = env, size

    def draw(self, look: Look | None) -> Image.Image:
        """Draw the present state.

        :param look: not shown.
        :raises RenderingError: if the environment draws nothing.
        """
        picture = self._env.render() if self._env.render_mode == "rgb_array" else None
        if not isinstance(picture, np.ndarray):
            raise RenderingError(
                "The environment draws no picture: make it with render_mode='rgb_array'. Its render mode is "
                f"{self._env.render_mode!r}."
            )
        return ImageOps.pad(Image.fromarray(picture), self._size, color=BACKGROUND)

    def note(self, look: Look) -> None:
        """:param look: not shown."""

    def close(self) -> None:
        """Nothing is held."""


class Magnifier:
    """
    Magnifies the distances of rollouts from the policy's own action, which are often millimetres.

    :param fixed: the factor; None: so that they can be seen
    """

    def __init__(self, fixed: float | None) -> None:
        self._fixed = fixed
        self._distances: list[float] = []

    def note(self, look: Look) -> None:
        """Remember how far candidates go from the way of the policy's own action, drawn or not.

        :param look: a decision.
        """
        if look.own is not None and look.traces:
            apart = [_apart(way, look.own).max() for _, way in look.traces]
            self._distances.append(float(np.quantile(apart, 0.8)))

    def factor(self, visible_height: float) -> float:
        """The present factor.

        :param visible_height: of what is seen.
        """
        if self._fixed is not None:
            return self._fixed
        distance = float(np.median(self._distances)) if self._distances else 0.0
        wanted = _SPREAD * visible_height
        return _round_number(wanted / distance) if 0 < distance < wanted else 1.0


class MujocoScene:
    """
    MuJoCo's scene with the bodies' ways along the candidates' rollouts.

    :param env: the environment
    :param size: width and height in pixels
    :param magnify: see :class:`Magnifier`
    :raises RenderingError: if MuJoCo cannot draw here
    """

    def __init__(self, env: SnapshotEnvWrapper, size: tuple[int, int], magnify: float | None = None) -> None:
        self._env, self._size = env, size
        self._magnifier = Magnifier(magnify)
        self._visible_height = 1.0
        self._pan = np.zeros(3)
        self._data: Any = None
        self._gl: Any = None
        self._context: Any = None
        self._follow_environment()

    @property
    def magnified(self) -> float:
        """The factor by which differences between rollouts are magnified."""
        return self._magnifier.factor(self._visible_height)

    def note(self, look: Look) -> None:
        """Remember how far candidates go from the way of the policy's own action, drawn or not.

        :param look: a decision.
        """
        self._magnifier.note(look)

    def draw(self, look: Look | None) -> Image.Image:
        """Draw the present state.

        :param look: the decision in this state.
        """
        if mujoco_data(self._env) is not self._data:  # some environments make a new simulator in each episode
            self._follow_environment()
        self._gl.make_current()
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, self._camera, everything, self._scene
        )
        view = self._move_camera(None if look is None else look.own)
        picture = self._read()
        if look is None or look.own is None:
            return picture
        self._visible_height = view.visible_height(look.own[-1].mean(axis=0))
        overlay = Canvas(*self._size, background=None)
        _draw_traces(overlay, look, view, self.magnified)
        top = overlay.image()
        picture.paste(top, mask=top)
        return picture

    def close(self) -> None:
        """Release OpenGL's context."""
        if self._context is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._context = None

    def _follow_environment(self) -> None:
        self.close()
        self._data = mujoco_data(self._env)
        self._model = drawn_model(self._data)
        width, height = self._size
        self._model.vis.global_.offwidth, self._model.vis.global_.offheight = width, height
        self._gl, self._context = _open_gl(self._model, self._size)
        self._option = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(self._model, maxgeom=10_000)
        self._camera = _camera(self._env, self._model)
        self._rectangle = mujoco.MjrRect(0, 0, width, height)

    def _read(self) -> Image.Image:
        width, height = self._size
        pixels = np.zeros((height, width, 3), dtype=np.uint8)
        mujoco.mjr_render(self._rectangle, self._scene, self._context)
        mujoco.mjr_readPixels(pixels, None, self._rectangle, self._context)
        return Image.fromarray(pixels[::-1])

    def _move_camera(self, own: np.ndarray | None) -> "View":
        """Turn from what the model's camera looks at towards the rollouts' ends, and stand back."""
        view = View(self._scene, self._size)
        if own is not None:
            wanted = np.array([*(view.axes[:2] @ (own[-1] - own[0]).mean(axis=0) / 2), 0.0])
            self._pan += (1.0 if not self._pan.any() else _PAN) * (wanted - self._pan)
        distance = view.distance(body_positions(self._env, find_bodies(self._model, [])).mean(axis=0))
        move = view.axes.T @ (self._pan - np.array([0.0, 0.0, _STAND_BACK * distance]))
        for camera in self._scene.camera:
            camera.pos = camera.pos + move
        return View(self._scene, self._size)


class View:
    """
    Where the scene's camera stands, and what it sees.

    :param scene: the updated scene
    :param size: width and height of the picture in pixels
    """

    def __init__(self, scene: Any, size: tuple[int, int]) -> None:
        left, right = scene.camera
        self._size = size
        self._position = (np.array(left.pos) + np.array(right.pos)) / 2
        forward, up = np.array(left.forward), np.array(left.up)
        #: ``[3, 3]``, unit vectors to the right, up and forward.
        self.axes = np.stack([np.cross(forward, up), up, forward])
        self._slope = (left.frustum_top - left.frustum_bottom) / left.frustum_near
        self._middle = (left.frustum_top + left.frustum_bottom) / 2 / left.frustum_near

    def distance(self, point: np.ndarray) -> float:
        """How far in front of the camera a point is."""
        return float(self.axes[2] @ (point - self._position))

    def visible_height(self, point: np.ndarray) -> float:
        """The height of what the picture shows at the distance of a point."""
        return max(self.distance(point), 1e-6) * self._slope

    def project(self, points: np.ndarray) -> np.ndarray:
        """Find points in the picture.

        :param points: ``[n, 3]``.
        :return: ``[m, 2]``, in pixels from the top left, without those behind the camera.
        """
        across, up, forward = self.axes @ (points - self._position).T
        seen = forward > 1e-3
        across, up = across[seen] / forward[seen], up[seen] / forward[seen] - self._middle
        width, height = self._size
        scale = height / self._slope
        return np.stack([width / 2 + across * scale, height / 2 - up * scale], axis=1)


def ways_of(look: Look, magnified: float) -> list[tuple[np.ndarray, Color, float]]:
    """The lines of a decision: low values first, then what was chosen, and the policy's own action on top.

    :param look: the decision, where bodies are known.
    :param magnified: factor of the distances from the policy's own action.
    :return: positions ``[steps, bodies, 3]``, colour, and width in pixels.
    """
    assert look.own is not None
    ranks = look.ranks
    valid = [trace for trace in look.traces if np.isfinite(look.values[trace[0]])]
    others = [trace for trace in valid if trace[0] != look.chosen]
    ways = [(way, rank_color(ranks[index]), 2.5) for index, way in sorted(others, key=lambda t: ranks[t[0]])]
    ways += [(way, rank_color(ranks[index]), 6.0) for index, way in valid if index == look.chosen]
    ways.append((look.own, WHITE, 2.0))
    found = []
    for way, color, width in ways:
        apart = _apart(way, look.own)
        found.append((look.own[: len(apart)] + magnified * apart, color, width))
    return found


def _draw_traces(canvas: Canvas, look: Look, view: View, magnified: float) -> None:
    for way, color, width in ways_of(look, magnified):
        for body in range(way.shape[1]):
            points = view.project(way[:, body])
            canvas.line(points, BLACK, width + 2)
            canvas.line(points, color, width)


def _apart(way: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Where a way is, seen from another, as long as both go on."""
    steps = min(len(way), len(own))
    return way[:steps] - own[:steps]


def _round_number(value: float) -> float:
    """The next lower one of 1, 2, 5, 10, 20, 50, ..."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(digit for digit in (1, 2, 5) if digit * power <= value * (1 + 1e-9))


def drawn_model(data: Any) -> Any:
    """A copy of a simulator's model, to be changed for drawing: snapshots compare the environment's own one.

    :param data: the simulator's ``MjData``.
    """
    model = copy.deepcopy(data.model)
    _extend_floors(model)
    return model


def _extend_floors(model: Any) -> None:
    """Draw large floors without end: agents run beyond them, since they have none in the simulation."""
    floors = (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (model.geom_size[:, :2].min(axis=1) >= 10)
    for floor in np.flatnonzero(floors):
        material = model.geom_matid[floor]
        if material >= 0 and not model.mat_texuniform[material]:
            # Repetitions of the texture in the whole floor; without an end they are per unit of length.
            model.mat_texrepeat[material] /= 2 * model.geom_size[floor, :2]
        model.geom_size[floor, :2] = 0


def _camera(env: SnapshotEnvWrapper, model: Any) -> Any:
    """A camera that follows: the model's own, or one on the first body that moves."""
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    modes = mujoco.mjtCamLight
    following = (modes.mjCAMLIGHT_TRACK.value, modes.mjCAMLIGHT_TRACKCOM.value)
    of_model = [number for number in range(model.ncam) if model.cam_mode[number] in following]
    if of_model:
        camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, of_model[0]
        return camera
    # Many of Gymnasium's environments say where to look from.
    settings = getattr(getattr(env.unwrapped, "mujoco_renderer", None), "default_cam_config", None)
    if not settings:
        body = find_bodies(model, [])[0]
        settings = {"trackbodyid": body, "distance": 0.8 * model.stat.extent, "elevation": -20.0}
    for name, value in settings.items():
        if name == "lookat":
            camera.lookat[:] = value
        else:
            setattr(camera, name, value)
    if camera.trackbodyid > 0:
        camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
    return camera


def _backend() -> str:
    """Which of MuJoCo's OpenGL backends to use: ``MUJOCO_GL``, or one that works without a screen."""
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if chosen in ("egl", "osmesa", "glfw"):
        return chosen
    if chosen in ("disable", "disabled", "off", "false", "0"):
        raise RenderingError(
            f"MUJOCO_GL={chosen} turns MuJoCo's pictures off: unset it. They need {_INSTALL}."
        )
    if not sys.platform.startswith("linux") or os.environ.get("DISPLAY"):
        return "glfw"
    for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        if ctypes.util.find_library(library):
            return backend
    raise RenderingError(
        f"There is neither a screen nor a library that draws without one. Install one: {_INSTALL}."
    )


def _open_gl(model: Any, size: tuple[int, int]) -> tuple[Any, Any]:
    """Open OpenGL's context and MuJoCo's in it.

    ``mujoco.Renderer`` takes its backend from what ``MUJOCO_GL`` was when MuJoCo was imported.
    """
    backend = _backend()
    try:
        gl = importlib.import_module(f"mujoco.{backend}").GLContext(*size)
        gl.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:  # every backend has errors of its own
        raise RenderingError(
            f"MuJoCo cannot draw with {backend} here ({type(error).__name__}: {error}). Without a screen it "
            f"needs EGL or OSMesa: {_INSTALL}."
        ) from error
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    return gl, context
