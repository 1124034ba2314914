"""Videos: what they show is what the search simulated. Drawing MuJoCo's scene needs OpenGL."""

import os
import sys

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_mcbs import SearchPolicy, SnapshotEnvWrapper
from sb3_mcbs.video import Performer, RenderingError, record_episodes
from sb3_mcbs.video.bodies import find_bodies, mujoco_data
from sb3_mcbs.video.canvas import rank_color
from sb3_mcbs.video.looks import Look, Onlooker
from sb3_mcbs.video.panel import SIZE, Panel, Shown
from sb3_mcbs.video.rollouts import RecordedModel, replay
from sb3_mcbs.zoo.watch import parser, watch
from tests.conftest import SMALL

needs_opengl = pytest.mark.skipif(
    os.environ.get("MUJOCO_GL", "disabled") not in ("egl", "osmesa", "glfw"),
    reason="draws MuJoCo's scene: set MUJOCO_GL=egl or osmesa where such a library is installed",
)
NO_NOISE = dict(rollout_noise=0.0)


def make_vec_env(env_id: str = "InvertedDoublePendulum-v5", **kwargs) -> DummyVecEnv:
    return DummyVecEnv([lambda: SnapshotEnvWrapper(gym.make(env_id, **kwargs))])


def make_policy(vec_env, **settings) -> SearchPolicy:
    return SearchPolicy(TD3("MlpPolicy", vec_env, seed=0, **SMALL), vec_env, seed=0, **settings)


@pytest.mark.parametrize(
    ("settings", "all_are_valued"),
    [
        (dict(beam_width=4, search_kwargs=NO_NOISE), True),
        (dict(beam_width=4, n_simulations=3), False),
        (dict(beam_width=3, search_kwargs=dict(noise_hold=2, rollout_noise=0.0)), True),
        (dict(strategy="tree", beam_width=3, search_kwargs=dict(branching=2)), False),
        (dict(strategy="cem", beam_width=4, n_simulations=1, search_kwargs=dict(n_rounds=3)), True),
        (dict(beam_width=2, forward_model="pool", search_kwargs=NO_NOISE), True),
    ],
)
def test_recorded_rollouts_have_the_values_of_their_candidates(settings, all_are_valued) -> None:
    vec_env = make_vec_env()
    policy = make_policy(vec_env, **settings)
    planner, env = policy.planner, vec_env.envs[0]
    model = planner.source.model = RecordedModel(planner.source.model)
    vec_env.seed(0)
    observations = vec_env.reset()
    policy.predict(observations)
    result, functions = policy.last_result, planner.functions()
    rollouts = model.rollouts(policy.settings)
    assert {rollout.candidate for rollout in rollouts} == set(range(result.values.shape[1]))
    copy, state = env.clone(), env.snapshot()
    for rollout in rollouts:
        first = functions.unscale_action(result.candidates[0, rollout.candidate][None])[0]
        np.testing.assert_array_equal(rollout.actions[0], first)
        if not all_are_valued:
            continue
        copy.restore(state)
        total = 0.0
        for depth, action in enumerate(rollout.actions):
            observation, reward, terminated, _, _ = copy.step(action)
            total += functions.gamma**depth * reward
        if not terminated:
            last = observation[None]
            q = functions.value(last, functions.policy(last))[0]
            total += functions.gamma ** len(rollout.actions) * q
        assert total == pytest.approx(result.values[0, rollout.candidate], abs=1e-4)


def test_a_replay_follows_the_bodies_and_leaves_the_environment_alone() -> None:
    vec_env = make_vec_env("Reacher-v5")
    env = vec_env.envs[0]
    vec_env.seed(3)
    vec_env.reset()
    bodies = find_bodies(mujoco_data(env).model, ["fingertip", "body1"])
    actions = np.array([[0.5, -0.5], [1.0, 0.0]], dtype=np.float32)
    before = mujoco_data(env).xpos[bodies].copy()
    way = replay(env.clone(), env.snapshot(), actions, bodies, np.random.default_rng(0))
    np.testing.assert_array_equal(mujoco_data(env).xpos[bodies], before)
    expected = [before]
    for action in actions:
        env.step(action)
        expected.append(mujoco_data(env).xpos[bodies].copy())
    np.testing.assert_array_equal(way, expected)


@pytest.mark.parametrize(
    ("env_id", "body"), [("HalfCheetah-v5", "torso"), ("Reacher-v5", "fingertip"), ("Ant-v5", "torso")]
)
def test_the_body_that_is_followed(env_id, body) -> None:
    model = mujoco_data(SnapshotEnvWrapper(gym.make(env_id))).model
    assert [model.body(number).name for number in find_bodies(model, [])] == [body]
    with pytest.raises(ValueError, match=f"no body 'head'.*{body}"):
        find_bodies(model, ["head"])


def test_looking_on_changes_nothing_and_knows_the_gain() -> None:
    settings = dict(beam_width=4, search_kwargs=dict(rollout_noise=0.0, include_policy_action=True))

    def act(looks_on: bool) -> list[np.ndarray]:
        vec_env = make_vec_env()
        policy = make_policy(vec_env, **settings)
        model = policy.planner.model
        onlooker = Onlooker(policy, vec_env.envs[0])
        vec_env.seed(0)
        observations, actions = vec_env.reset(), []
        for _ in range(4):
            if looks_on:
                action, look = onlooker.act(observations)
                values = policy.last_result.values[0]
                np.testing.assert_allclose(look.values, values - values[0], atol=1e-4)
                assert look.gain == look.values.max() and len(look.traces) == 4
            else:
                action, _ = policy.predict(observations)
            actions.append(action)
            observations, *_ = vec_env.step(action)
        onlooker.close()
        assert policy.planner.model is model
        return actions

    np.testing.assert_array_equal(act(looks_on=True), act(looks_on=False))


def test_the_best_bar_is_lighter_and_invalid_candidates_are_left_out() -> None:
    look = Look(np.array([-1.0, 2.0, -np.inf, 0.5]), 1, [], None)
    np.testing.assert_allclose(look.ranks, [1 / 3, 1, 0, 2 / 3])
    picture = Image.new("RGB", (560, 480))
    frame = Panel("title", "subtitle").alone(Shown("SAC", [1.0], look), picture, magnified=1)
    colors = {color for _, color in frame.crop((560, 190, 854, 380)).getcolors(100_000)}
    assert frame.size == SIZE
    assert {rank_color(1.0), rank_color(2 / 3), rank_color(1 / 3)} <= colors and rank_color(0.0) not in colors


@pytest.fixture
def pendulum(monkeypatch):
    pytest.importorskip("pygame", reason="Pendulum draws with pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    return lambda: make_vec_env("Pendulum-v1", render_mode="rgb_array", max_episode_steps=12)


@pytest.mark.parametrize("ending", [".gif", ".png", ".mp4"])
def test_an_environment_without_mujoco_is_recorded_with_its_own_picture(ending, pendulum, tmp_path) -> None:
    if ending == ".mp4":
        ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs imageio-ffmpeg")
    vec_env = VecNormalize(pendulum(), training=False)
    policy = make_policy(vec_env, beam_width=3, normalize_reward=False)
    path = tmp_path / f"video{ending}"
    alone = Performer("alone", policy.model, VecNormalize(pendulum(), training=False))
    outcomes = record_episodes(path, [alone, Performer("search", policy, vec_env)], [5], steps=6, start=1)
    assert [(each.label, each.seed, each.steps, each.ended) for each in outcomes] == [
        ("alone", 5, 7, ""),
        ("search", 5, 7, ""),
    ]
    env = pendulum()
    env.seed(5)
    observations, total = env.reset(), 0.0
    for _ in range(7):
        action, _ = policy.model.predict(alone.vec_env.normalize_obs(observations), deterministic=True)
        observations, rewards, *_ = env.step(action)
        total += rewards[0]
    assert outcomes[0].total == pytest.approx(total)
    if ending == ".mp4":
        frames, _ = ffmpeg.count_frames_and_secs(str(path))
        assert frames == 6
    else:
        with Image.open(path) as picture:
            size, frames = {".gif": ((640, 360), 2), ".png": ((854, 4 * 480), 1)}[ending]
            assert (picture.size, getattr(picture, "n_frames", 1)) == (size, frames)
            assert len(picture.convert("RGB").getcolors(1_000_000)) > 50


def test_episodes_to_their_end_and_what_cannot_be_recorded(pendulum, tmp_path) -> None:
    policy = make_policy(pendulum(), beam_width=1, rollout_depth=0)
    performer = Performer("search", policy, policy.vec_env)
    outcomes = record_episodes(tmp_path / "a.png", [performer], [1, 2])
    assert [(outcome.seed, outcome.ended) for outcome in outcomes] == [
        (1, "time limit after 12 steps"),
        (2, "time limit after 12 steps"),
    ]
    with pytest.raises(ValueError, match="ended after 12 steps, before step 20"):
        record_episodes(tmp_path / "b.png", [performer], [1], start=20)
    with pytest.raises(ValueError, match=r"must end with one of \.mp4, \.gif, \.png"):
        record_episodes(tmp_path / "b.avi", [performer], [1])
    with pytest.raises(ValueError, match="There is no folder"):
        record_episodes(tmp_path / "no" / "b.png", [performer], [1])
    with pytest.raises(ValueError, match="not simulated with MuJoCo"):
        record_episodes(tmp_path / "b.png", [performer], [1], bodies=["torso"])
    blind = make_vec_env("Pendulum-v1")
    with pytest.raises(RenderingError, match="render_mode='rgb_array'"):
        record_episodes(tmp_path / "b.png", [Performer("blind", policy.model, blind)], [1])
    two = DummyVecEnv([lambda: gym.make("Pendulum-v1")] * 2)
    with pytest.raises(ValueError, match="got 2 in a DummyVecEnv"):
        record_episodes(tmp_path / "b.png", [Performer("two", policy.model, two)], [1])


def test_what_is_missing_for_drawing_is_said(monkeypatch, tmp_path) -> None:
    policy = make_policy(make_vec_env(), beam_width=2)
    performer = Performer("search", policy, policy.vec_env)
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    with pytest.raises(RenderingError, match=r"turns MuJoCo's pictures off.*libosmesa6"):
        record_episodes(tmp_path / "a.png", [performer], [1])
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(RenderingError, match=r"neither a screen nor a library.*libegl1"):
        record_episodes(tmp_path / "a.png", [performer], [1])
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"sb3-mcbs\[video\]"):
        record_episodes(tmp_path / "a.mp4", [performer], [1])


@needs_opengl
def test_the_command_draws_rollouts_in_the_scene(tmp_path, capsys) -> None:
    agent = tmp_path / "agent.zip"
    SAC("MlpPolicy", gym.make("HalfCheetah-v5"), seed=0, **SMALL).save(agent)

    def picture(name: str, *further: str) -> np.ndarray:
        path = tmp_path / name
        arguments = [str(agent), "--env", "HalfCheetah-v5", "-o", str(path), "--steps", "1", "--start", "2"]
        watch(parser().parse_args([*arguments, *further]))
        assert "SAC with search: return" in capsys.readouterr().out
        return np.asarray(Image.open(path).convert("RGB"))[:, :560].astype(int)

    def count_chosen(pixels: np.ndarray) -> int:
        return int((np.abs(pixels - rank_color(1.0)).max(axis=2) < 3).sum())

    seen = picture("a.png")
    assert count_chosen(seen) > 100
    # Traces are drawn over the scene, and the same seed draws the same ones.
    np.testing.assert_array_equal(seen, picture("b.png"))
    assert (seen != picture("c.png", "--body", "ffoot", "--body", "bfoot")).any()
    assert (seen != picture("d.png", "--magnify", "1")).any()
