"""
MuJoCo's Studio in a process of its own: ``python studio.py FD``, where ``FD`` is one end of a pipe.

There can be one Studio per process, and here a crash ends nothing else. Through the pipe come the arguments
of ``_open``, answered with the address or with what is wrong, and then models, states and lines. The process
ends when the other end of the pipe is closed, also if who held it was killed. It imports nothing of this
package, so that it begins at once.
"""

import os
import sys
import threading
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import mujoco
import numpy as np
from mujoco.studio import endpoints, launch_thread, messages, viewer_protocol, web_viewer

#: Not reachable from other machines: the Studio asks nobody who they are.
HOST = "127.0.0.1"


@dataclass(frozen=True)
class Lines(messages.Snapshot):
    """
    :param rows: ``[lines, 10]``: start, end, radius, and red, green and blue from 0 to 1
    """

    rows: np.ndarray


class OnThisMachine(web_viewer.WebViewer):
    """The Studio, for browsers of this machine only; it has no setting for that."""

    _host = property(lambda self: HOST, lambda self, everywhere: None)

    @property
    def address(self) -> tuple[str, int]:
        """What it listens on."""
        host, port = self._http_sock.getsockname()[:2]
        return host, port

    def listen(self) -> None:
        """Let browsers wait for the server, whose thread has only begun."""
        self._http_sock.listen()

    @messages.handler
    def on_lines(self, lines: Lines) -> None:
        """Draw other lines than before."""
        self.extra_geoms[:] = [_capsule(row) for row in lines.rows]


def main() -> None:
    """Show what comes through the pipe."""
    pipe: Connection = Connection(int(sys.argv[1]))
    try:
        viewer_end, pipe_end = launch_thread.make_thread_endpoints()
        viewer = _open(viewer_end, **pipe.recv())
        pipe.send(("url", "http://{}:{}/".format(*viewer.address)))
        threading.Thread(target=_forward, args=(pipe, pipe_end), daemon=True).start()
        viewer_protocol.run_viewer_loop(viewer)
    except Exception as error:
        pipe.send(("error", _in_words(error)))


def _open(
    endpoint: endpoints.ViewerEndpoint, title: str, port: int, model: Any, camera: dict[str, float]
) -> OnThisMachine:
    view = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, view)
    view.type = mujoco.mjtCamera.mjCAMERA_TRACKING
    for name, value in camera.items():
        setattr(view, name, value)
    config = viewer_protocol.ViewerConfig(title=title, gfx="web", http_port=port)
    viewer = OnThisMachine(config, endpoint, model=model, camera=view)
    if viewer.address[0] != HOST:
        raise RuntimeError(f"in MuJoCo {mujoco.__version__} it would be reachable from other machines")
    viewer.listen()
    return viewer


def _forward(pipe: Connection, viewer: endpoints.SimEndpoint) -> None:
    """Give the viewer what comes. End with the pipe, whatever the viewer does."""
    try:
        while True:
            model, state, rows = pipe.recv()
            if model is not None:
                viewer.send_to_viewer(messages.ModelEvent(model))
            everything = mujoco.mjtState.mjSTATE_INTEGRATION.value
            viewer.send_to_viewer(messages.StateSnapshot(state, everything))
            viewer.send_to_viewer(Lines(rows))
    finally:
        os._exit(0)


def _capsule(row: np.ndarray) -> Any:
    geom = mujoco.MjvGeom()
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    rgba = np.array([*row[7:], 1.0], dtype=np.float32)
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), rgba)
    mujoco.mjv_connector(geom, kind, row[6], row[:3], row[3:6])
    return geom


def _in_words(error: Exception) -> str:
    text = str(error)
    if "in use" in text:  # the Studio's advice is about an option of its own command
        return f"{text.partition(',')[0]}: choose another one with --live PORT."
    return f"{type(error).__name__}: {text}"


if __name__ == "__main__":
    main()
