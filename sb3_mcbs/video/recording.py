"""Acts in environments and records what can be seen."""

import itertools
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, unwrap_vec_normalize
from tqdm import tqdm

from sb3_mcbs.agents import SearchPolicy
from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.video.bodies import mujoco_data
from sb3_mcbs.video.files import check_path, open_video
from sb3_mcbs.video.live import LiveScene
from sb3_mcbs.video.looks import Onlooker
from sb3_mcbs.video.panel import ALONE, COMPARED, Panel, Shown
from sb3_mcbs.video.scene import EnvironmentPicture, MujocoScene

#: Some environments make 125 steps per second.
_MOST_FPS = 30.0


class Performer(NamedTuple):
    """
    Who acts, and where.

    :param label: a name for the video
    :param policy: an agent, or one with search; a search's decisions are shown
    :param vec_env: one environment in this process. Its render mode is ``rgb_array``, unless it is MuJoCo's
    """

    label: str
    policy: BaseAlgorithm | SearchPolicy
    vec_env: VecEnv


class Outcome(NamedTuple):
    """
    An episode, as far as it was recorded.

    :param label: who acted
    :param seed: of the environment
    :param steps: steps from the beginning
    :param total: their rewards, not normalised
    :param ended: how it ended; "": it was cut off
    """

    label: str
    seed: int
    steps: int
    total: float
    ended: str


def record_episodes(
    path: str | Path,
    performers: Sequence[Performer],
    seeds: Sequence[int],
    *,
    steps: int | None = None,
    start: int = 0,
    bodies: Sequence[str] = (),
    magnify: float | None = None,
    title: str = "",
    subtitle: str = "",
    progress: bool = False,
) -> list[Outcome]:
    """
    Record episodes to a file: ``.mp4``, ``.gif``, or four moments as ``.png``.

    :param path: the file
    :param performers: one, or two that are shown side by side from the same seed
    :param seeds: of the environment, one per episode
    :param steps: that are recorded in each episode, at most; None: until it ends
    :param start: steps before those, which are not recorded
    :param bodies: names of MuJoCo bodies whose ways are shown; none: the first one that moves
    :param magnify: factor by which differences between rollouts are magnified; None: so that they can be seen
    :param title: of the panel; "": the performer's label
    :param subtitle: a line below it
    :param progress: whether a progress bar is shown, on a terminal
    :return: the episodes of every performer
    :raises ValueError: if there are not one or two performers, a body or the folder does not exist, an
        environment is not alone or in another process, or nothing was recorded
    :raises RenderingError: if no picture can be drawn
    """
    if len(performers) not in (1, 2):
        raise ValueError(f"One or two can be shown at a time, got {len(performers)}.")
    path = check_path(path)
    size = ALONE if len(performers) == 1 else COMPARED
    stages: list[_Stage] = []
    outcomes: list[Outcome] = []
    try:
        for performer in performers:
            stages.append(_Stage(performer, partial(_picture, size=size, magnify=magnify), bodies))
        panel = Panel(title or performers[0].label, subtitle)
        frame = partial(_frame, panel, stages)
        with open_video(path, stages[0].fps) as video, _progress_bar(steps, seeds, progress) as bar:
            for seed in seeds:
                for _ in _act(stages, seed, start, steps):
                    video.add(frame)
                    bar.update()
                if video.plays and all(stage.shown.ended for stage in stages):
                    for _ in range(round(stages[0].fps)):  # long enough to read how it ended
                        video.add(frame)
                outcomes += [stage.outcome(seed) for stage in stages]
    finally:
        for stage in stages:
            stage.close()
    return outcomes


def show_live(
    performer: Performer,
    seeds: Iterable[int],
    *,
    steps: int | None = None,
    bodies: Sequence[str] = (),
    magnify: float | None = None,
    port: int = 0,
    begun: Callable[[str], None] = print,
) -> list[Outcome]:
    """
    Show episodes in the browser as they happen, not faster than in reality.

    :param performer: who acts in an environment that MuJoCo simulates
    :param seeds: of the environment, one per episode
    :param steps: of each episode, at most; None: until it ends
    :param bodies: see :func:`record_episodes`
    :param magnify: see :func:`record_episodes`
    :param port: of this machine; 0: the first free one from 8080 on
    :param begun: is told the address
    :return: the episodes, until Ctrl-C
    :raises ValueError: if a body does not exist, or an environment is not alone or in another process
    :raises RenderingError: if there is no live view of this environment, or the Studio ends
    """
    stage = _Stage(performer, partial(LiveScene, title=performer.label, port=port, magnify=magnify), bodies)
    outcomes: list[Outcome] = []
    try:
        begun(stage.scene.url)
        for seed in seeds:
            next_frame = time.perf_counter()
            for _ in _act([stage], seed, 0, steps):
                stage.draw()
                next_frame = max(next_frame + 1 / stage.real_fps, time.perf_counter())
                time.sleep(max(0.0, next_frame - time.perf_counter()))
            outcomes.append(stage.outcome(seed))
    except KeyboardInterrupt:
        outcomes.append(stage.outcome(seed))
    finally:
        stage.close()
    return outcomes


def _picture(
    env: SnapshotEnvWrapper, size: tuple[int, int], magnify: float | None
) -> MujocoScene | EnvironmentPicture:
    in_mujoco = mujoco_data(env) is not None
    return MujocoScene(env, size, magnify) if in_mujoco else EnvironmentPicture(env, size)


class _Stage:
    """One environment, who acts in it, and its picture."""

    def __init__(
        self, performer: Performer, make_scene: Callable[[SnapshotEnvWrapper], Any], bodies: Sequence[str]
    ) -> None:
        self.label, self.policy, self.vec_env = performer
        self._env = _single_environment(self.vec_env)
        self.shown = Shown(self.label)
        self._action: np.ndarray | None = None
        self._picture: Image.Image | None = None
        self.reset(0)  # some environments have a simulator only then
        policy = self.policy
        self._onlooker = Onlooker(policy, self._env, bodies) if isinstance(policy, SearchPolicy) else None
        self.scene = make_scene(self._env)

    @property
    def real_fps(self) -> float:
        """Steps per second as in reality."""
        return float(self._env.metadata.get("render_fps") or _MOST_FPS)

    @property
    def fps(self) -> float:
        """Steps per second as in reality, or fewer so that each can be seen."""
        return min(self.real_fps, _MOST_FPS)

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self.vec_env.seed(seed)
        self._observations: Any = self.vec_env.reset()
        self._picture = None
        self.shown = Shown(self.label)

    def decide(self) -> None:
        """Choose an action."""
        if self.shown.ended:
            return
        if self._onlooker is not None:
            self._action, self.shown.look = self._onlooker.act(self._observations)
            self.shown.gains.append(self.shown.look.gain)
            self.scene.note(self.shown.look)
        else:
            self._action, _ = self.policy.predict(self._observations, deterministic=True)

    def draw(self) -> Image.Image:
        """The picture of the last decision, or of the last one that was drawn if the episode has ended."""
        if self._picture is None or not self.shown.ended:
            self._picture = self.scene.draw(self.shown.look)
        return self._picture

    def step(self) -> None:
        """Execute the action that was decided on."""
        if self.shown.ended:
            return
        assert self._action is not None
        self._observations, rewards, dones, infos = self.vec_env.step(self._action)
        normalizer = unwrap_vec_normalize(self.vec_env)
        reward = (rewards if normalizer is None else normalizer.get_original_reward())[0]
        before = self.shown.returns[-1] if self.shown.returns else 0.0
        self.shown.returns.append(before + float(reward))
        if dones[0]:
            cut = infos[0].get("TimeLimit.truncated", False)
            how = "time limit" if cut else "ended"
            self.shown.ended = f"{how} after {len(self.shown.returns)} steps"

    def outcome(self, seed: int) -> Outcome:
        """The episode so far."""
        returns = self.shown.returns
        return Outcome(self.label, seed, len(returns), returns[-1] if returns else math.nan, self.shown.ended)

    def close(self) -> None:
        """Release the picture and the copy of the environment, but not the environment."""
        if self._onlooker is not None:
            self._onlooker.close()
        self.scene.close()


def _act(stages: Sequence[_Stage], seed: int, start: int, steps: int | None) -> Iterator[None]:
    """Act for an episode. Stops after every decision from ``start`` on, before its action is executed."""
    for stage in stages:
        stage.reset(seed)
    for number in itertools.count() if steps is None else range(start + steps):
        ended = [stage for stage in stages if stage.shown.ended]
        if ended and number <= start:
            raise ValueError(
                f"The episode with seed {seed} ended after {len(ended[0].shown.returns)} steps, before step "
                f"{start}, from which it was to be recorded."
            )
        if len(ended) == len(stages):
            return
        for stage in stages:
            stage.decide()
        if number >= start:
            yield
        for stage in stages:
            stage.step()


def _single_environment(vec_env: VecEnv) -> SnapshotEnvWrapper:
    base = vec_env.unwrapped
    if not isinstance(base, DummyVecEnv) or base.num_envs != 1:
        raise ValueError(
            f"A video shows one environment in this process, a DummyVecEnv with n_envs=1; got "
            f"{base.num_envs} in a {type(base).__name__}."
        )
    base.envs[0] = env = SnapshotEnvWrapper(base.envs[0])
    return env


def _frame(panel: Panel, stages: Sequence[_Stage]) -> Image.Image:
    pictures = [stage.draw() for stage in stages]
    shown = [stage.shown for stage in stages]
    magnified = max(stage.scene.magnified for stage in stages)
    if len(stages) == 1:
        return panel.alone(shown[0], pictures[0], magnified)
    return panel.compared(shown, pictures, magnified)


def _progress_bar(steps: int | None, seeds: Sequence[int], wanted: bool) -> Any:
    total = None if steps is None else steps * len(seeds)
    # None: hidden unless standard error is a terminal.
    return tqdm(total=total, unit="frame", disable=None if wanted else True)
