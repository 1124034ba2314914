"""A live view in the browser: MuJoCo's Studio, with the rollouts of every decision."""

import contextlib
import signal
import subprocess
import sys
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.video.bodies import find_bodies, mujoco_data
from sb3_mcbs.video.looks import Look
from sb3_mcbs.video.scene import Magnifier, RenderingError, drawn_model, ways_of

#: The most lines that the Studio draws.
MOST_LINES = 1024
#: A decision's lines have this radius per pixel of width in a video, the camera this distance, and at first
#: this height is seen: as multiples of the robot's size.
_RADIUS, _DISTANCE, _VISIBLE = 6e-3, 6.0, 4.0
#: Seconds in which the Studio must have begun, and in which it must have ended.
_BEGIN, _END = 60.0, 3.0


class LiveScene:
    """
    The environment in MuJoCo's Studio, in a browser on this machine, with the candidates' rollouts.

    The Studio is a process of its own and gets copies: what is clicked there does not change the environment.

    :param env: the environment, simulated with MuJoCo
    :param title: of the page
    :param port: of this machine; 0: the first free one from 8080 on
    :param magnify: see :class:`~sb3_mcbs.video.scene.Magnifier`
    :raises RenderingError: if MuJoCo does not simulate the environment, or the Studio cannot begin
    """

    def __init__(
        self, env: SnapshotEnvWrapper, title: str = "", port: int = 0, magnify: float | None = None
    ) -> None:
        self._env, self._magnifier = env, Magnifier(magnify)
        self._source: Any = mujoco_data(env)
        if self._source is None:
            raise RenderingError("A live view needs an environment that MuJoCo simulates.")
        if int(mujoco.__version__.partition(".")[0]) < 4:
            raise RenderingError(f"A live view needs MuJoCo 4; this is {mujoco.__version__}.")
        model = drawn_model(self._source)
        body = find_bodies(model, [])[0]
        self._size = _size(model, body)
        camera = {"trackbodyid": body, "distance": _DISTANCE * self._size, "elevation": -20.0}
        self._pipe, theirs = Pipe()
        with theirs:
            # In a session of its own, where Ctrl-C does not reach it: it ends with the pipe.
            self.process = subprocess.Popen(
                [sys.executable, "-P", Path(__file__).with_name("studio.py"), str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
        try:
            self._send({"title": title, "port": port, "model": model, "camera": camera})
            #: Where the browser finds it.
            self.url = self._receive()
        except BaseException:
            self.close()
            raise

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
        :raises RenderingError: if the Studio has ended.
        """
        data: Any = mujoco_data(self._env)
        model = None
        if data is not self._source:  # some environments make a new simulator in each episode
            self._source, model = data, drawn_model(data)
        everything = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(data.model, everything))
        mujoco.mj_getState(data.model, data, state, everything)
        self._send((model, state, self._lines(look)))

    def close(self) -> None:
        """End the Studio."""
        for end in (self._pipe.close, self.process.terminate, self.process.kill):
            end()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(_END)
                return

    def _send(self, message: Any) -> None:
        try:
            self._pipe.send(message)
        except OSError:  # it has ended; it may have said why
            self._receive()

    def _receive(self) -> str:
        """Read the Studio's answer.

        :raises RenderingError: if it is an error, or none comes.
        """
        kind, text = "error", f"it did not begin within {_BEGIN:g} seconds."
        if self._pipe.poll(_BEGIN):
            try:
                kind, text = self._pipe.recv()
            except (EOFError, OSError):
                text = f"its process {self._ending()}. Begin again, or record a video with -o."
        if kind == "error":
            raise RenderingError(f"MuJoCo's Studio has ended: {text}")
        return text

    def _ending(self) -> str:
        try:
            code = self.process.wait(_END)
        except subprocess.TimeoutExpired:
            return "does not answer"
        return f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit status {code}"

    def _lines(self, look: Look | None) -> np.ndarray:
        """``[lines, 10]``, see :class:`sb3_mcbs.video.studio.Lines`."""
        found: list[np.ndarray] = []
        ways = ways_of(look, self.magnified) if look is not None and look.own is not None else []
        for way, color, width in reversed(ways):  # what matters comes first
            style = [_RADIUS * width * self._size, *(part / 255 for part in color)]
            for body in range(way.shape[1]):
                steps = zip(way[:-1, body], way[1:, body], strict=True)
                found += [np.array([*start, *end, *style]) for start, end in steps]
        return np.array(found[:MOST_LINES]).reshape(-1, 10)


def _size(model: Any, body: int) -> float:
    """How far the robot reaches. Not the model's extent, which includes the floor."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return max(float(np.linalg.norm(data.xpos[1:] - data.xpos[body], axis=1).max()), 0.1)
