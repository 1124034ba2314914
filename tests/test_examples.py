"""The scripts and notebooks in ``examples/`` run, on a small scale."""

import json
import re
import runpy
import sys
import types
from pathlib import Path

import huggingface_hub
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs import ExactCheckpointCallback
from tests.agent_files import untrained_agent

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
SCRIPTS = sorted(EXAMPLES.glob("*.py"))
NOTEBOOKS = sorted(EXAMPLES.glob("*.ipynb"))
#: Numbers of the notebooks that make them quick.
SMALL = {"STEPS": 60, "EPISODES": 1, "EPISODE_STEPS": 10, "VIDEO_STEPS": 5}


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Run an example in an empty folder, with arguments, and return what it prints."""
    monkeypatch.chdir(tmp_path)

    def run_example(name: str, *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        capsys.readouterr()
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run_example


@pytest.fixture
def agent(tmp_path: Path) -> str:
    """The file of an untrained agent."""
    env = VecNormalize(make_vec_env("InvertedPendulum-v5"))
    SAC("MlpPolicy", env, policy_kwargs=dict(net_arch=[16]), buffer_size=10, device="cpu").save(
        tmp_path / "sac.zip"
    )
    env.save(str(tmp_path / "vecnormalize.pkl"))
    return "sac.zip"


def test_scripts_are_short_and_documented() -> None:
    page = (EXAMPLES.parent / "docs" / "examples.md").read_text(encoding="utf-8")
    assert len(SCRIPTS) == 6 and len(NOTEBOOKS) == 2
    for path in SCRIPTS:
        assert len(path.read_text(encoding="utf-8").splitlines()) < 40, path.name
    for path in [*SCRIPTS, *NOTEBOOKS]:
        assert f"](../examples/{path.name})" in page


@pytest.mark.parametrize("statistics", [[], ["--vecnormalize", "vecnormalize.pkl"]])
def test_trained_agent(run, agent: str, statistics: list[str]) -> None:
    printed = run("trained_agent.py", agent, "--env", "InvertedPendulum-v5", "--episodes", "1", *statistics)
    assert re.search(
        r"^actor alone: \S+ \+- 0.0\nactor with search: \S+ \+- 0.0$", printed, flags=re.MULTILINE
    )


@pytest.mark.parametrize("algo", ["td3", "crossq"])
def test_train(run, algo: str, tmp_path: Path) -> None:
    small = ["--steps", "60", "--learning-starts", "30", "--net-arch", "16"]
    printed = run("train.py", "--algo", algo, "--env", "InvertedPendulum-v5", *small, "-o", "trained.zip")
    assert "Trained for 60 environment steps" in printed
    assert (tmp_path / "trained.zip").exists()


def test_evaluate(run, agent: str) -> None:
    options = ["--presets", "efficient", "paper", "--episodes", "1"]
    rows = run("evaluate.py", agent, "--env", "InvertedPendulum-v5", *options).splitlines()[1:]
    assert [row[:12].strip() for row in rows] == ["actor alone", "efficient", "paper"]
    simulated = [float(row[12:].split()[1].replace(",", "")) for row in rows]
    assert simulated[0] == 0 < simulated[1] < simulated[2]


def test_own_environment(run) -> None:
    assert "Docking is not a known family" in run("own_environment.py", "--steps", "60")


def test_deadline(run, agent: str) -> None:
    printed = run("deadline.py", agent, "--env", "InvertedPendulum-v5", "--steps", "5", "--budget-ms", "1000")
    assert "0.0% of the decisions late, 100.0 candidates" in printed


def test_resume_ends_as_a_run_that_was_not_stopped(run, monkeypatch: pytest.MonkeyPatch) -> None:
    options = ["--env", "InvertedPendulum-v5", "--steps", "60", "--save-freq", "20"]
    expected = run("resume.py", "whole", *options)

    class PowerCut(Exception):
        pass

    def fail_at_50(callback: ExactCheckpointCallback) -> bool:
        if callback.num_timesteps == 50:
            raise PowerCut
        return True

    with monkeypatch.context() as patch, pytest.raises(PowerCut):
        patch.setattr(ExactCheckpointCallback, "_on_step", fail_at_50)
        run("resume.py", "cut", *options)
    assert run("resume.py", "cut", *options) == expected


def code_of(cell: dict) -> str:
    """The code of a cell, without IPython's commands (installations)."""
    return re.sub(r"^(\s*)[%!].*", r"\1pass", "".join(cell["source"]), flags=re.MULTILINE)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4 and notebook["nbformat_minor"] >= 5
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    assert len(path.read_bytes()) < 100_000, "commit it without pictures"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", untrained_agent)
    if "IPython" in path.read_text(encoding="utf-8"):
        for module in ("IPython", "IPython.display"):
            monkeypatch.setitem(sys.modules, module, types.SimpleNamespace(Image=Path))
    names: dict = {"__name__": "__main__", "display": lambda *_: None}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec(compile(code_of(cell), f"{path.name}: {cell['id']}", "exec"), names)
            names.update({name: value for name, value in SMALL.items() if name in names})
    assert SMALL.keys() & names.keys(), "none of its numbers was made small"
