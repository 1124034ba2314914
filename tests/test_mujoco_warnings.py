"""MuJoCo's warnings are shown once."""

from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import mujoco
import pytest

from sb3_mcbs.snapshot import mujoco_warnings


@pytest.fixture(autouse=True)
def _as_in_a_new_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    before = mujoco.get_mju_user_warning()
    monkeypatch.setattr(mujoco_warnings, "_shown", set())
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    yield
    mujoco.set_mju_user_warning(before)


def diverge(height: float) -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qpos[0], data.time = 1e20, height
    mujoco.mj_step(model, data)


def test_each_is_shown_once(capfd: pytest.CaptureFixture[str]) -> None:
    mujoco.set_mju_user_warning(None)
    mujoco_warnings.show_warnings_once()
    for time in (0.25, 17.5):
        gym.make("HalfCheetah-v5").close()
        diverge(time)
    errors = capfd.readouterr().err
    assert errors.count("settotalmass") == 1
    assert errors.count("huge value in QPOS") == 1 and "Time = 0.25" in errors
    assert Path("MUJOCO_LOG.TXT").read_text().count("WARNING") == 2


def test_the_handler_of_somebody_else_stays() -> None:
    seen: list[str] = []
    mujoco.set_mju_user_warning(seen.append)
    mujoco_warnings.show_warnings_once()
    diverge(1.0)
    diverge(2.0)
    assert len(seen) == 2
