"""MuJoCo's warnings are shown once."""

import io
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from sb3_mcbs import SnapshotEnvWrapper
from sb3_mcbs.models import LocalEnvironments
from sb3_mcbs.models.mujoco_batch import MujocoBatchModel
from sb3_mcbs.snapshot import mujoco_warnings

MODEL = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
)


@pytest.fixture(autouse=True)
def _as_in_a_new_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    before = mujoco.get_mju_user_warning()
    monkeypatch.setattr(mujoco_warnings, "_shown", set())
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    yield
    mujoco.set_mju_user_warning(before)


def diverge(time: float) -> None:
    data = mujoco.MjData(MODEL)
    data.qpos[0], data.time = 1e20, time
    mujoco.mj_step(MODEL, data)


def test_each_is_shown_once(capfd: pytest.CaptureFixture[str]) -> None:
    mujoco.set_mju_user_warning(None)
    mujoco_warnings.show_warnings_once()
    for time in (0.25, 17.5):
        diverge(time)
    errors = capfd.readouterr().err
    assert errors.count("huge value in QPOS") == 1 and "Time = 0.25" in errors
    assert Path("MUJOCO_LOG.TXT").read_text().count("WARNING") == 1


def test_nothing_is_said_of_the_xml_of_half_cheetah(capfd: pytest.CaptureFixture[str]) -> None:
    mujoco.set_mju_user_warning(None)
    mujoco_warnings.show_warnings_once()
    gym.make("HalfCheetah-v5").close()
    assert "settotalmass" not in capfd.readouterr().err and not Path("MUJOCO_LOG.TXT").exists()
    mujoco.set_mju_user_warning(None)
    gym.make("HalfCheetah-v5").close()
    assert "settotalmass" in capfd.readouterr().err, "MuJoCo says it by itself"


@pytest.mark.parametrize("stream", [None, io.TextIOWrapper(io.BytesIO())], ids=["none", "closed"])
def test_a_closed_stream_does_not_end_the_process(stream: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    if stream is not None:
        stream.close()
    monkeypatch.setattr(sys, "stderr", stream)
    mujoco.set_mju_user_warning(None)
    mujoco_warnings.show_warnings_once()
    diverge(0.25)
    assert "huge value in QPOS" in Path("MUJOCO_LOG.TXT").read_text()


def test_simulations_on_other_threads_warn_and_go_on() -> None:
    env = SnapshotEnvWrapper(gym.make("HalfCheetah-v5"))
    env.reset(seed=0)
    model = MujocoBatchModel(LocalEnvironments([env]), n_threads=4)
    mujoco.set_mju_user_warning(None)
    mujoco_warnings.show_warnings_once()
    env.unwrapped.data.qvel[:] = 1e20
    model.set_roots(model.read_roots([0]), np.zeros(16, dtype=int), np.random.default_rng(0))
    transition = model.step(np.zeros((16, 6), dtype=np.float32))
    model.close()
    assert not transition.valid.any()
    assert Path("MUJOCO_LOG.TXT").read_text().count("huge value in QVEL") == 1


def test_the_handler_of_somebody_else_stays() -> None:
    seen: list[str] = []
    mujoco.set_mju_user_warning(seen.append)
    mujoco_warnings.show_warnings_once()
    diverge(1.0)
    diverge(2.0)
    assert len(seen) == 2
