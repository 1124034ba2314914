"""A live view in the browser: MuJoCo's Studio, with the rollouts of every decision."""

import copy
import importlib
import socket
import threading
from typing import Any

import mujoco
import numpy as np

from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.video.bodies import find_bodies, mujoco_data
from sb3_mcbs.video.looks import Look
from sb3_mcbs.video.scene import Magnifier, RenderingError, extend_floors, ways_of

#: Not reachable from other machines: the Studio asks nobody who they are.
HOST = "127.0.0.1"
#: The most geoms that the Studio draws besides the model's.
MOST_GEOMS = 1024
#: A decision's lines have this radius per pixel of width in a video, the camera this distance, and at first
#: this height is seen: as multiples of the robot's size.
_RADIUS, _DISTANCE, _VISIBLE = 4e-3, 6.0, 4.0
#: Seconds in which the Studio must have begun.
_PATIENCE = 60.0


class LiveScene:
    """
    The environment in MuJoCo's Studio, in a browser on this machine, with the candidates' rollouts.

    The Studio gets a copy of the state, so what is clicked there does not change the environment.

    :param env: the environment, simulated with MuJoCo
    :param title: of the page
    :param port: of this machine; 0: the first free one from 8080 on
    :param magnify: see :class:`~sb3_mcbs.video.scene.Magnifier`
    :raises RenderingError: if MuJoCo does not simulate the environment, or its version has no such Studio
    """

    def __init__(
        self, env: SnapshotEnvWrapper, title: str = "", port: int = 0, magnify: float | None = None
    ) -> None:
        self._env, self._magnifier = env, Magnifier(magnify)
        self._source: Any = None
        if mujoco_data(env) is None:
            raise RenderingError("A live view needs an environment that MuJoCo simulates.")
        self._follow_environment()
        self._began = threading.Event()
        self._viewer: Any = None
        self._handle = self._launch(title, port)

    @property
    def url(self) -> str:
        """Where the browser finds it."""
        return f"http://{HOST}:{self._viewer._http_sock.getsockname()[1]}/"

    @property
    def is_open(self) -> bool:
        """Whether it was not closed in the browser."""
        return bool(self._handle.is_running())

    @property
    def magnified(self) -> float:
        """The factor by which differences between rollouts are magnified."""
        return self._magnifier.factor(_VISIBLE * self._size)

    def note(self, look: Look) -> None:
        """Remember how far candidates go from the way of the policy's own action.

        :param look: a decision.
        """
        self._magnifier.note(look)

    def draw(self, look: Look | None) -> None:
        """Show the present state.

        :param look: the decision in this state.
        """
        data: Any = mujoco_data(self._env)
        if data is not self._source:  # some environments make a new simulator in each episode
            self._follow_environment()
        everything = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(data.model, everything))
        mujoco.mj_getState(data.model, data, state, everything)
        mujoco.mj_setState(self._model, self._data, state, everything)
        mujoco.mj_forward(self._model, self._data)
        self._handle.sync(self._model, self._data)
        self._viewer.extra_geoms[:] = self._geoms(look)

    def close(self) -> None:
        """End the Studio."""
        self._handle.close()

    def _geoms(self, look: Look | None) -> list[Any]:
        if look is None or look.own is None:
            return []
        found: list[Any] = []
        for way, color, width in reversed(ways_of(look, self.magnified)):  # what matters comes first
            radius = _RADIUS * width * self._size
            for body in range(way.shape[1]):
                steps = zip(way[:-1, body], way[1:, body], strict=True)
                found += [_line(start, end, radius, color) for start, end in steps]
        return found[:MOST_GEOMS]

    def _follow_environment(self) -> None:
        self._source = mujoco_data(self._env)
        self._model = copy.deepcopy(self._source.model)
        extend_floors(self._model)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        # Not the model's extent, which includes the floor.
        apart = self._data.xpos[1:] - self._data.xpos[self._body]
        self._size = max(float(np.linalg.norm(apart, axis=1).max()), 0.1)

    @property
    def _body(self) -> int:
        return int(find_bodies(self._model, [])[0])

    def _camera(self) -> Any:
        """One that follows the first body that moves."""
        camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(self._model, camera)
        camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, self._body
        camera.distance, camera.elevation = _DISTANCE * self._size, -20.0
        return camera

    def _launch(self, title: str, port: int) -> Any:
        try:
            threads, protocol, web = (
                importlib.import_module(f"mujoco.studio.{name}")
                for name in ("launch_thread", "viewer_protocol", "web_viewer")
            )
        except ImportError as error:
            raise RenderingError(
                f"A live view needs the Studio of MuJoCo 4 ({error}); this is {mujoco.__version__}."
            ) from error

        class OnThisMachine(web.WebViewer):  # type: ignore[name-defined]
            # The Studio has no setting for it.
            _host = property(lambda self: HOST, lambda self, everywhere: None)

        def run(endpoint: Any) -> None:
            try:
                config = protocol.ViewerConfig(title=title, gfx="web", http_port=port)
                self._viewer = OnThisMachine(config, endpoint, camera=self._camera())
            finally:
                self._began.set()
            protocol.run_viewer_loop(self._viewer)

        handle = threads.launch_thread(run)
        if not self._began.wait(_PATIENCE) or self._viewer is None:
            handle.close()  # raises what happened there
            raise RenderingError("MuJoCo's Studio did not begin.")
        bound: socket.socket | None = getattr(self._viewer, "_http_sock", None)
        if bound is None or bound.getsockname()[0] != HOST:
            handle.close()
            raise RenderingError(
                f"The Studio of MuJoCo {mujoco.__version__} would be reachable from other machines."
            )
        return handle


def _line(start: np.ndarray, end: np.ndarray, radius: float, color: tuple[int, int, int]) -> Any:
    geom = mujoco.MjvGeom()
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    rgba = np.array([*(part / 255 for part in color), 1.0], dtype=np.float32)
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), rgba)
    mujoco.mjv_connector(geom, kind, radius, np.asarray(start, float), np.asarray(end, float))
    return geom
