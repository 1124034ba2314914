"""Ctrl-C, SIGTERM and SIGKILL, on whole runs in processes of their own."""

import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.kill import differences, kill_once, run_killed, start, wait_until
from benchmarks.kill_run import RESULT, STARTED
from sb3_mcbs import ExactCheckpointCallback, resume
from sb3_mcbs.checkpoints import TrainingInterrupted
from sb3_mcbs.checkpoints.store import Store
from tests.checkpoint_helpers import assert_same_runs, learn
from tests.test_checkpoints import maker

WORKERS = "Pendulum-v1 in workers"
ENDLESS = 1_000_000


def start_and_wait(
    folder: Path, case: str, steps: int = ENDLESS, save_freq: int = 100, algorithm: str = "mcbs_td3"
):
    process = start(algorithm, case, folder, steps, save_freq)
    assert wait_until((folder / STARTED).exists, process, 120), (folder / "output.txt").read_text()
    return process


def group_is_gone(group: int) -> bool:
    end = time.monotonic() + 20
    while time.monotonic() < end:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize(("signum", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_to_the_whole_group_saves_and_stops(signum, status, tmp_path):
    process = start_and_wait(tmp_path, WORKERS)
    os.killpg(process.pid, signum)
    assert process.wait(60) == status, (tmp_path / "output.txt").read_text()
    assert group_is_gone(process.pid)
    mark = json.loads((tmp_path / "checkpoints" / "interrupted.json").read_text())
    assert mark["signal"] == signal.Signals(signum).name
    newest = Store(tmp_path / "checkpoints").steps()[0]
    assert newest == mark["num_timesteps"]
    Store(tmp_path / "checkpoints").read(newest)
    output = (tmp_path / "output.txt").read_text()
    assert "Traceback" not in output
    assert f"Stopped by {mark['signal']} at {newest} steps" in output


def test_a_second_signal_stops_at_once(tmp_path):
    # One rollout is far longer than the test, so the first signal has to wait for its end.
    process = start("td3_one_rollout", "Pendulum-v1", tmp_path, ENDLESS, ENDLESS)
    assert wait_until((tmp_path / STARTED).exists, process, 120), (tmp_path / "output.txt").read_text()
    os.kill(process.pid, signal.SIGINT)
    assert wait_until(
        lambda: "Once more to stop at once" in (tmp_path / "output.txt").read_text(), process, 20
    )
    time.sleep(0.5)
    assert process.poll() is None
    os.kill(process.pid, signal.SIGINT)
    assert process.wait(20) != 130
    assert "KeyboardInterrupt" in (tmp_path / "output.txt").read_text()


class SignalAt(BaseCallback):
    """Sends this process a signal in the middle of a step, and may end training in that step."""

    not_checkpointed = ("step", "ends")

    def __init__(self, step: int | None, ends: bool = False) -> None:
        super().__init__()
        self.step = step
        self.ends = ends

    def _on_step(self) -> bool:
        if self.num_timesteps != self.step:
            return True
        os.kill(os.getpid(), signal.SIGTERM)
        return not self.ends


MAKE = maker(DDPG, buffer_size=1000, policy_kwargs=dict(net_arch=[8]))


@pytest.fixture(autouse=True)
def handlers_are_given_back():
    before = [signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)]
    yield
    assert [signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_signal_in_the_last_rollout_saves_and_stops(tmp_path, capsys):
    whole = learn(MAKE(tmp_path / "whole"), tmp_path / "whole", 100, more=[SignalAt(None)])
    with pytest.raises(TrainingInterrupted) as stopped:
        learn(MAKE(tmp_path / "stopped"), tmp_path / "stopped", 100, more=[SignalAt(100)])
    assert stopped.value.code == 143
    assert "Stopped by SIGTERM at 100 steps" in capsys.readouterr().err
    checkpoints = tmp_path / "stopped" / "checkpoints"
    assert Store(checkpoints).steps() == [100, 80]
    assert (checkpoints / "interrupted.json").exists()
    second = SignalAt(None)
    resumed = learn(resume(checkpoints), tmp_path / "stopped", 100, more=[second])
    assert_same_runs(whole, resumed)
    assert second.n_calls == 100
    assert not (checkpoints / "interrupted.json").exists()


def test_a_signal_when_a_callback_ends_training_stops_too(tmp_path):
    """There is nothing to save: the state in the middle of a rollout is none to go on from."""
    with pytest.raises(TrainingInterrupted):
        learn(MAKE(tmp_path), tmp_path, 100, more=[SignalAt(90, ends=True)])
    assert Store(tmp_path / "checkpoints").steps() == [80, 40]


def test_learn_may_be_called_again_after_a_signal(tmp_path):
    agent, callback = MAKE(tmp_path), ExactCheckpointCallback(40, tmp_path / "checkpoints")
    with pytest.raises(TrainingInterrupted):
        agent.learn(100, callback=[callback, SignalAt(50)])
    agent.learn(50, callback=callback, reset_num_timesteps=False)
    assert agent.num_timesteps == 100


@pytest.mark.parametrize(
    "algorithm",
    [
        "mcbs_td3",
        *(pytest.param(f"mcbs_{base}", marks=pytest.mark.slow) for base in ("ddpg", "sac", "tqc", "crossq")),
    ],
)
def test_killed_while_writing(tmp_path, algorithm):
    """The small version of ``make bench-kill``: one SIGKILL inside a checkpoint, against a whole run."""
    whole = start(algorithm, "Pendulum-v1", tmp_path / "whole", 600, 100)
    process = start_and_wait(tmp_path / "killed", "Pendulum-v1", 600, algorithm=algorithm)
    assert kill_once(process, tmp_path / "killed", True, 0.3) is not None
    assert start(algorithm, "Pendulum-v1", tmp_path / "killed", 600, 100).wait(120) == 0
    assert whole.wait(120) == 0
    assert differences(tmp_path / "whole", tmp_path / "killed") == []
    assert len(np.load(tmp_path / "whole" / RESULT).files) > 50


@pytest.mark.slow
@pytest.mark.parametrize(
    "algorithm", ["mcbs_td3", "mcbs_ddpg", "mcbs_sac", "mcbs_tqc", "mcbs_crossq", "td3", "sac"]
)
def test_killed_and_stopped_again_and_again(algorithm, tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert start(algorithm, WORKERS, whole, 3000, 100).wait(300) == 0
    process = start(algorithm, WORKERS, killed, 3000, 100)
    assert wait_until((killed / STARTED).exists, process, 120)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(60) == 130
    hits = run_killed(algorithm, WORKERS, killed, 3000, 100, 4, np.random.default_rng(0))
    assert hits
    assert differences(whole, killed) == []
    assert not (killed / "checkpoints" / "interrupted.json").exists()
