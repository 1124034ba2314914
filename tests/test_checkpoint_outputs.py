"""A resumed run changes no file before it goes on, and no checkpoint decides where it writes."""

import shutil
import tempfile
from pathlib import Path

import pytest
from rl_zoo3.callbacks import SaveVecNormalizeCallback
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import SubprocVecEnv, VecMonitor, VecNormalize

from sb3_mcbs import CheckpointError, resume
from sb3_mcbs.checkpoints import components
from sb3_mcbs.checkpoints.state import RunState
from sb3_mcbs.zoo import resume as zoo_resume
from tests.checkpoint_helpers import assert_same_runs, crash, learn
from tests.test_checkpoints import maker, returns_in

SETTINGS = dict(buffer_size=1000, learning_starts=10_000, policy_kwargs=dict(net_arch=[8]))
STEPS = 450


def files_in(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def make_with_logs(n_envs=1, vec_env_cls=None):
    """A run that writes every kind of log file."""

    def make(folder):
        folder.mkdir(exist_ok=True)
        agent = maker(
            DDPG,
            n_envs=n_envs,
            vec_env_cls=vec_env_cls,
            wrap=lambda env: VecMonitor(env, str(folder / "vec")),
            **SETTINGS,
        )(folder)
        agent.set_logger(configure(str(folder / "log"), ["csv", "json", "log", "tensorboard"]))
        return agent

    return make


@pytest.fixture(params=[(1, None), (2, SubprocVecEnv)], ids=["here", "workers"])
def lost(request, tmp_path):
    """The folder of a run that was lost after the end of an episode, later than its last checkpoint."""
    n_envs, vec_env_cls = request.param
    folder = tmp_path / "lost"
    crash(make_with_logs(n_envs, vec_env_cls), folder, STEPS, 410, save_freq=180, log_interval=1)
    return folder


def other_total(agent, folder):
    learn(agent, folder, STEPS + 1)


def other_callbacks(agent, folder):
    agent.learn(STEPS)


def other_settings(agent, folder):
    agent.gamma = 0.5
    learn(agent, folder, STEPS, save_freq=180)


@pytest.mark.parametrize("call", [None, other_total, other_callbacks, other_settings])
def test_a_run_that_does_not_go_on_leaves_all_files_as_they_were(call, lost):
    before = files_in(lost)
    assert sum(len(content) > 0 for path, content in before.items() if "checkpoints" not in path.parts) >= 5
    agent = resume(lost / "checkpoints")
    if call is not None:
        with pytest.raises(CheckpointError):
            call(agent, lost)
    agent.logger.close()
    agent.env.close()
    assert files_in(lost) == before


def test_a_state_that_is_refused_late_leaves_all_files_as_they_were(lost, monkeypatch):
    before = files_in(lost)
    agent = resume(lost / "checkpoints")

    def refuse(*args):
        raise CheckpointError("after the environments were put back")

    monkeypatch.setattr(RunState, "_decode", refuse)
    with pytest.raises(CheckpointError, match="after the environments"):
        learn(agent, lost, STEPS, save_freq=180)
    agent.env.close()
    assert files_in(lost) == before


def test_after_a_refused_call_the_run_still_goes_on(tmp_path):
    make = make_with_logs()
    kwargs = dict(save_freq=180, log_interval=1)
    whole = learn(make(tmp_path / "whole"), tmp_path / "whole", STEPS, **kwargs)
    crash(make, tmp_path / "lost", STEPS, 410, **kwargs)
    agent = resume(tmp_path / "lost" / "checkpoints")
    with pytest.raises(CheckpointError, match="Repeat the original call"):
        learn(agent, tmp_path / "lost", STEPS + 1, **kwargs)
    resumed = learn(resume(tmp_path / "lost" / "checkpoints"), tmp_path / "lost", STEPS, **kwargs)
    assert_same_runs(whole, resumed)
    assert returns_in(tmp_path / "whole") == returns_in(tmp_path / "lost") != [[]]
    for name in ("log/progress.csv", "log/progress.json", "log/log.txt", "vec.monitor.csv"):
        lengths = [len((tmp_path / run / name).read_text().splitlines()) for run in ("whole", "lost")]
        assert lengths[0] == lengths[1] > 1, name


def test_an_environment_of_the_caller_may_keep_its_file_too(tmp_path):
    """As the documentation says: with override_existing=False."""

    def env(**kwargs):
        return make_vec_env("Pendulum-v1", 1, seed=0, monitor_dir=str(tmp_path / "monitor"), **kwargs)

    crash(lambda folder: DDPG("MlpPolicy", env(), seed=0, **SETTINGS), tmp_path, STEPS, 410, save_freq=180)
    before = files_in(tmp_path)
    agent = resume(tmp_path / "checkpoints", env(monitor_kwargs=dict(override_existing=False)))
    assert files_in(tmp_path) == before
    learn(agent, tmp_path, STEPS, save_freq=180)
    assert len(returns_in(tmp_path)[0]) == 2


def test_a_run_of_rl_zoo_that_does_not_go_on(tmp_path, monkeypatch):
    crash(maker(DDPG, **SETTINGS), tmp_path, 50, 45)
    file = tmp_path / "0.monitor.csv"
    file.write_text("rows\n")

    def repeat(folder):
        file.write_text("")
        raise CheckpointError("refused")

    monkeypatch.setattr(zoo_resume, "load_run", lambda folder: ({}, {}))
    monkeypatch.setattr(zoo_resume, "repeat", repeat)
    with pytest.raises(CheckpointError, match="refused"):
        zoo_resume.resume(tmp_path)
    assert file.read_text() == "rows\n"


class Plots(BaseCallback):
    """Writes into folders that it keeps as text and as a path."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.log_dir = str(folder / "plots")
        self.out = folder / "out"
        self.phase = "beginning"

    def _on_step(self) -> bool:
        self.phase = "middle"
        for place in (Path(self.log_dir), self.out):
            place.mkdir(exist_ok=True)
            (place / str(self.num_timesteps)).touch()
        return True


def writers(folder: Path) -> list[BaseCallback]:
    """Every callback of SB3 and RL Zoo that writes, some of them within others."""
    evaluation = EvalCallback(
        VecNormalize(make_vec_env("Pendulum-v1", 1, seed=7), training=False),
        callback_on_new_best=SaveVecNormalizeCallback(1, str(folder / "best")),
        n_eval_episodes=1,
        eval_freq=30,
        log_path=str(folder / "evaluations"),
        best_model_save_path=str(folder / "best"),
        verbose=0,
    )
    checkpoints = CheckpointCallback(1, str(folder / "models"), name_prefix="agent")
    return [CallbackList([evaluation, EveryNTimesteps(25, checkpoints)]), Plots(folder)]


def make_normalized(folder: Path):
    return DDPG("MlpPolicy", VecNormalize(make_vec_env("Pendulum-v1", 1, seed=0)), seed=0, **SETTINGS)


@pytest.mark.parametrize("by_an_older_version", [False, True])
def test_callbacks_write_where_those_of_learn_do(by_an_older_version, tmp_path, monkeypatch):
    """Also if the checkpoint says otherwise, as that of an older version or of a stranger."""
    with monkeypatch.context() as older:
        if by_an_older_version:
            older.setattr(components, "_is_place", lambda component, name: False)
        crash(make_normalized, tmp_path / "old", 150, 105, writers)
    shutil.move(tmp_path / "old", tmp_path / "new")
    agent = resume(tmp_path / "new" / "checkpoints")
    callbacks = writers(tmp_path / "new")
    learn(agent, tmp_path / "new", 150, more=callbacks)
    assert not (tmp_path / "old").exists()
    for place in (
        "evaluations/evaluations.npz",
        "best/best_model.zip",
        "models/agent_150_steps.zip",
        "plots/150",
        "out/150",
    ):
        assert (tmp_path / "new" / place).exists(), place
    assert callbacks[-1].phase == "middle", "text that names no place is state"


def test_an_attribute_that_only_the_checkpoint_has_names_no_place(tmp_path):
    plots = Plots(tmp_path)
    assert {"video_folder", "log_dir", "out"} <= components.not_state_of(plots, {"video_folder": "/"})
    assert not {"phase", "n_calls"} & components.not_state_of(plots, ["phase", "n_calls"])


def test_the_loggers_folder_is_below_the_roots(tmp_path, monkeypatch):
    def make(folder):
        agent = maker(DDPG, **SETTINGS)(folder)
        agent.set_logger(configure(str(tmp_path / "elsewhere"), []))
        return agent

    crash(make, tmp_path / "run", 150, 105)
    agent = resume(tmp_path / "run" / "checkpoints")
    learn(agent, tmp_path / "run", 150)
    assert agent.logger.dir == tempfile.gettempdir()
    crash(make, tmp_path / "run2", 150, 105)
    agent = resume(tmp_path / "run2" / "checkpoints", log_folder=tmp_path)
    learn(agent, tmp_path / "run2", 150)
    assert agent.logger.dir == str(tmp_path / "elsewhere")


def test_tensorboards_folder_is_below_the_roots(tmp_path):
    """A second learn() of the resumed agent would write there."""

    def make(folder):
        agent = maker(DDPG, tensorboard_log=str(tmp_path / "elsewhere"), **SETTINGS)(folder)
        agent.set_logger(configure(str(folder), []))
        return agent

    crash(make, tmp_path / "run", 150, 105)
    with pytest.raises(CheckpointError, match="log_folder="):
        resume(tmp_path / "run" / "checkpoints")
    resume(tmp_path / "run" / "checkpoints", log_folder=tmp_path)
