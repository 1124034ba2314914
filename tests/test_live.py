"""The live view: what the Studio gets, that only this machine can reach it, and that its process ends."""

import importlib.util
import multiprocessing
import os
import signal
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from multiprocessing import Pipe
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from stable_baselines3 import TD3
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_mcbs import SearchPolicy, SnapshotEnvWrapper
from sb3_mcbs.video import Performer, RenderingError, show_live
from sb3_mcbs.video.bodies import mujoco_data
from sb3_mcbs.video.live import MOST_LINES, LiveScene
from sb3_mcbs.zoo.watch import parser, watch
from tests.conftest import SMALL

ENV_ID = "InvertedDoublePendulum-v5"
HAS_STUDIO = importlib.util.find_spec("mujoco.studio") is not None
needs_studio = pytest.mark.skipif(not HAS_STUDIO, reason="needs the Studio of MuJoCo 4")


def make_performer(env_id: str = ENV_ID) -> Performer:
    vec_env = DummyVecEnv([lambda: SnapshotEnvWrapper(gym.make(env_id))])
    agent = TD3("MlpPolicy", vec_env, seed=0, **SMALL)
    return Performer("TD3", SearchPolicy(agent, vec_env, seed=0, preset="efficient"), vec_env)


def make_env() -> SnapshotEnvWrapper:
    env = SnapshotEnvWrapper(gym.make(ENV_ID))
    env.reset(seed=0)
    return env


@pytest.fixture(autouse=True)
def studios(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[subprocess.Popen]]:
    """The Studios' processes that a test began. None may be left when it ends."""
    begun = []
    close = LiveScene.close
    monkeypatch.setattr(LiveScene, "close", lambda self: (begun.append(self.process), close(self))[1])
    yield begun
    assert all(process.returncode is not None for process in begun)


@needs_studio
def test_the_studio_shows_what_happens_on_this_machine_only(
    monkeypatch: pytest.MonkeyPatch, studios: list[subprocess.Popen]
) -> None:
    sent, pages = [], []
    send = LiveScene._send

    def watched(self: LiveScene, message) -> None:
        if isinstance(message, tuple):
            position = mujoco_data(self._env).qpos
            np.testing.assert_array_equal(
                message[1][1 : 1 + len(position)], position
            )  # the time is before it
        sent.append(message)
        send(self, message)

    def visit(url: str) -> None:
        pages.extend(urllib.request.urlopen(url + page).status for page in ("", "model"))
        port = int(url.strip("/").rpartition(":")[2])
        for other in ("127.0.0.2", "::1"):  # reached only by what listens on all interfaces
            with pytest.raises(OSError):
                socket.create_connection((other, port), timeout=2)

    monkeypatch.setattr(LiveScene, "_send", watched)
    outcomes = show_live(make_performer(), [3], steps=5, begun=visit)
    assert pages == [200, 200]
    _, *drawn = sent
    assert len(drawn) == 5 and all(model is None for model, _, _ in drawn)
    assert all(0 < len(lines) <= MOST_LINES and lines.shape[1] == 10 for _, _, lines in drawn)
    assert not np.array_equal(drawn[0][1], drawn[-1][1])
    assert [studio.returncode for studio in studios] == [0]

    alone = make_performer()
    alone.vec_env.seed(0)
    alone.vec_env.reset()
    alone.vec_env.seed(3)
    observations, total = alone.vec_env.reset(), 0.0
    for _ in range(5):
        observations, rewards, _, _ = alone.vec_env.step(alone.policy.predict(observations)[0])
        total += float(rewards[0])
    assert outcomes[0].steps == 5 and outcomes[0].total == pytest.approx(total)


@needs_studio
def test_views_one_after_another_and_at_once() -> None:
    env = make_env()
    for _ in range(2):
        scenes = [LiveScene(env), LiveScene(env)]
        assert len({scene.url for scene in scenes}) == 2
        for scene in scenes:
            scene.draw(None)
            assert urllib.request.urlopen(scene.url).status == 200
            scene.close()


@needs_studio
def test_the_studio_takes_over_models_states_and_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    from mujoco.studio import launch_thread

    from sb3_mcbs.video import studio

    ended = []
    monkeypatch.setattr(studio.os, "_exit", ended.append)
    model, rows = mujoco_data(make_env()).model, np.arange(10.0)[None]
    here, there = Pipe()
    here.send((model, np.arange(3.0), rows))
    here.close()
    viewer, pipe_end = launch_thread.make_thread_endpoints()
    with pytest.raises(EOFError):
        studio._forward(there, pipe_end)
    assert ended == [0]
    (event,) = viewer.get_sim_events()
    np.testing.assert_array_equal(event.model.geom_size, model.geom_size)
    state, lines = viewer.get_sim_snapshots()
    np.testing.assert_array_equal(state.state, np.arange(3.0))

    shown = SimpleNamespace(extra_geoms=["old"])
    studio.OnThisMachine.on_lines(shown, lines)
    (geom,) = shown.extra_geoms
    np.testing.assert_allclose(geom.pos, (rows[0, :3] + rows[0, 3:6]) / 2)
    np.testing.assert_allclose(geom.rgba, [7, 8, 9, 1])
    assert geom.size[0] == 6


@needs_studio
def test_a_new_simulator_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, sent = LiveScene(make_env()), []
    monkeypatch.setattr(scene, "_send", sent.append)
    scene._env = make_env()
    scene.draw(None)
    scene.draw(None)
    scene.close()
    assert [model is not None for model, _, _ in sent] == [True, False]


@needs_studio
def test_a_studio_that_ends_is_one_error() -> None:
    env = make_env()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(
            RenderingError, match=f"Port {port} is already in use: choose another one with --live"
        ):
            LiveScene(env, port=port)
    scene = LiveScene(env)
    scene.process.send_signal(signal.SIGSEGV)
    scene.process.wait(10)
    with pytest.raises(RenderingError, match="was ended by SIGSEGV"):
        scene.draw(None)
    scene.close()


@needs_studio
def test_a_studio_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch, studios: list) -> None:
    monkeypatch.setattr("sb3_mcbs.video.live._END", 0.1)
    scene = LiveScene(make_env())
    scene.process.send_signal(signal.SIGSTOP)
    assert becomes(scene.process.pid, "T")
    scene.close()
    assert [studio.returncode for studio in studios] == [-signal.SIGKILL]


@needs_studio
def test_ctrl_c_ends_both(monkeypatch: pytest.MonkeyPatch, studios: list[subprocess.Popen]) -> None:
    sessions = []

    def interrupted(self: LiveScene, look) -> None:
        sessions.append(os.getsid(self.process.pid))
        if len(sessions) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(LiveScene, "draw", interrupted)
    outcomes = show_live(make_performer(), range(9), begun=lambda url: None)
    assert [outcome.steps for outcome in outcomes] == [2]
    assert [studio.returncode for studio in studios] == [0]
    assert sessions[0] != os.getsid(0)  # a terminal's Ctrl-C goes to the other session alone


def _hold_a_view(told) -> None:
    scene = LiveScene(make_env())
    told.send(scene.process.pid)
    signal.pause()


@needs_studio
def test_the_studio_ends_when_who_began_it_is_killed() -> None:
    here, there = Pipe()
    main = multiprocessing.get_context("fork").Process(target=_hold_a_view, args=(there,), daemon=True)
    main.start()
    assert here.poll(30)
    studio = here.recv()
    assert state(studio) != "Z"
    main.kill()
    main.join()
    assert becomes(studio, "Z")


def becomes(pid: int, letter: str) -> bool:
    """Whether a process soon is in a state: ``T``, stopped, or ``Z``, ended (waited for, or not any more)."""
    deadline = time.monotonic() + 10
    while (now := state(pid)) != letter and time.monotonic() < deadline:
        time.sleep(0.02)
    return now == letter


def state(pid: int) -> str:
    try:
        with open(f"/proc/{pid}/stat") as status:
            return status.read().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return "Z"


def test_what_cannot_be_shown_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RenderingError, match="an environment that MuJoCo simulates"):
        show_live(make_performer("Pendulum-v1"), [0])
    monkeypatch.setattr(mujoco, "__version__", "3.17.0")
    with pytest.raises(RenderingError, match="needs MuJoCo 4; this is 3"):
        show_live(make_performer(), [0])


def test_options_that_do_not_go_with_it_are_refused() -> None:
    args = parser().parse_args(["agent.zip", "--env", "Hopper-v5", "--live", "--compare"])
    with pytest.raises(ValueError, match="leave out --compare and --start"):
        watch(args)
    with pytest.raises(SystemExit):
        parser().parse_args(["agent.zip", "--live", "-o", "x.mp4"])
