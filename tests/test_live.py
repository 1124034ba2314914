"""The live view: what the Studio gets, and that only this machine can reach it."""

import importlib.util
import sys
import urllib.request

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import TD3
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_mcbs import SearchPolicy, SnapshotEnvWrapper
from sb3_mcbs.video import Performer, RenderingError, show_live
from sb3_mcbs.video.bodies import mujoco_data
from sb3_mcbs.video.live import MOST_GEOMS, LiveScene
from sb3_mcbs.zoo.watch import parser, watch
from tests.conftest import SMALL

HAS_STUDIO = importlib.util.find_spec("mujoco") and importlib.util.find_spec("mujoco.studio")
needs_studio = pytest.mark.skipif(not HAS_STUDIO, reason="needs the Studio of MuJoCo 4")


def make_performer(env_id: str = "InvertedDoublePendulum-v5") -> Performer:
    vec_env = DummyVecEnv([lambda: SnapshotEnvWrapper(gym.make(env_id))])
    agent = TD3("MlpPolicy", vec_env, seed=0, **SMALL)
    return Performer("TD3", SearchPolicy(agent, vec_env, seed=0, preset="efficient"), vec_env)


@needs_studio
def test_the_studio_shows_what_happens_on_this_machine_only(monkeypatch: pytest.MonkeyPatch) -> None:
    shown, pages = [], []
    draw = LiveScene.draw

    def watched(self: LiveScene, look) -> None:
        draw(self, look)
        assert self._viewer._http_sock.getsockname()[0] == "127.0.0.1"
        shown.append((len(self._viewer.extra_geoms), self._data.qpos.copy()))
        assert self._data is not mujoco_data(self._env)
        np.testing.assert_array_equal(self._data.qpos, mujoco_data(self._env).qpos)
        self._data.qpos[:] = 0  # as a click on "reset" does

    monkeypatch.setattr(LiveScene, "draw", watched)
    outcomes = show_live(
        make_performer(), [3], steps=5, begun=lambda url: pages.append(urllib.request.urlopen(url).status)
    )
    assert pages == [200]
    assert len(shown) == 5 and all(0 < geoms <= MOST_GEOMS for geoms, _ in shown)
    assert not np.array_equal(shown[0][1], shown[-1][1])

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
def test_a_view_that_is_closed_ends_the_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    draws = []
    monkeypatch.setattr(LiveScene, "draw", lambda self, look: draws.append(look))
    monkeypatch.setattr(LiveScene, "is_open", property(lambda self: len(draws) < 3))
    outcomes = show_live(make_performer(), range(9), begun=lambda url: None)
    assert len(draws) == 3 and [outcome.steps for outcome in outcomes] == [2]


def test_what_cannot_be_shown_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RenderingError, match="an environment that MuJoCo simulates"):
        show_live(make_performer("Pendulum-v1"), [0])
    monkeypatch.setitem(sys.modules, "mujoco.studio", None)
    monkeypatch.setitem(sys.modules, "mujoco.studio.launch_thread", None)
    with pytest.raises(RenderingError, match="needs the Studio of MuJoCo 4"):
        show_live(make_performer(), [0])


def test_options_that_do_not_go_with_it_are_refused() -> None:
    args = parser().parse_args(["agent.zip", "--env", "Hopper-v5", "--live", "--compare"])
    with pytest.raises(ValueError, match="leave out --compare and --start"):
        watch(args)
    with pytest.raises(SystemExit):
        parser().parse_args(["agent.zip", "--live", "-o", "x.mp4"])
