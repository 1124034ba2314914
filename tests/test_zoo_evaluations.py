"""Evaluations of a run's two policies, what is printed after ``make train``, and the command's errors."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_mcbs import cli
from sb3_mcbs.experiments.report.command import report
from sb3_mcbs.zoo.evaluations import ACTOR, SEARCH, load_policies, newest_run


def write_evaluations(folder: Path, last: float) -> None:
    folder.mkdir(parents=True)
    results = np.array([[0.0, 2.0], [last - 1, last + 1]])
    np.savez(folder / "evaluations.npz", timesteps=[100, 200], results=results, ep_lengths=np.ones((2, 2)))


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    write_evaluations(tmp_path / "mcbs_td3" / "HalfCheetah-v5_1", 30)
    write_evaluations(tmp_path / "mcbs_td3_actor" / "HalfCheetah-v5_1", 20)
    write_evaluations(tmp_path / "td3" / "HalfCheetah-v5_1", 10)
    write_evaluations(tmp_path / "td3_search" / "HalfCheetah-v5_1", 40)
    write_evaluations(tmp_path / "sac" / "HalfCheetah-v5_1", 5)
    return tmp_path


def last_means(folder: Path) -> dict[str, float]:
    return {name: float(data.returns[-1].mean()) for name, data in load_policies(folder).items()}


def test_policies_are_told_apart(logs: Path) -> None:
    assert last_means(logs / "mcbs_td3" / "HalfCheetah-v5_1") == {ACTOR: 20, SEARCH: 30}
    assert last_means(logs / "td3" / "HalfCheetah-v5_1") == {ACTOR: 10, SEARCH: 40}
    assert last_means(logs / "sac" / "HalfCheetah-v5_1") == {ACTOR: 5}


def test_the_only_policy_of_a_folder_has_its_name(logs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = logs / "copied"
    alone.mkdir()
    for name, policy in (("mcbs_td3", SEARCH), ("mcbs_td3_actor", ACTOR), ("td3_search", SEARCH)):
        (logs / name).rename(alone / name)
        assert list(load_policies(alone / name / "HalfCheetah-v5_1")) == [policy]
        (alone / name).rename(logs / name)
    monkeypatch.chdir(logs / "mcbs_td3")
    assert last_means(Path("HalfCheetah-v5_1")) == {ACTOR: 20, SEARCH: 30}
    monkeypatch.chdir("HalfCheetah-v5_1")
    assert last_means(Path(".")) == {ACTOR: 20, SEARCH: 30}


def test_report_says_what_was_reached_and_where_it_lies(logs: Path) -> None:
    folder = logs / "mcbs_td3" / "HalfCheetah-v5_1"
    for name in ("best_model", "HalfCheetah-v5"):
        (folder / f"{name}.zip").touch()
    lines = report(folder, output=folder / "report")
    assert lines[0] == "Mean return of the actor alone: 20.0 (2 episodes after 200 steps)"
    assert lines[1] == "Mean return of the actor with search: 30.0 (2 episodes after 200 steps)"
    assert lines[2].endswith("HalfCheetah-v5.zip")
    picture = folder / "report" / "curves-HalfCheetah-v5-steps.png"
    assert lines[4].endswith(str(picture))
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert lines[5] == f"Report:         {folder / 'report' / 'report.html'}"


def test_newest_run_is_the_one_evaluated_last(logs: Path) -> None:
    for number, age in ((2, 50), (10, 100)):
        folder = logs / "mcbs_td3" / f"HalfCheetah-v5_{number}"
        write_evaluations(folder, 0)
        stamp = (logs / "mcbs_td3" / "HalfCheetah-v5_1" / "evaluations.npz").stat().st_mtime + age
        os.utime(folder / "evaluations.npz", (stamp, stamp))
    write_evaluations(logs / "mcbs_td3" / "HalfCheetah-v5_other_1", 0)
    assert newest_run(logs, "mcbs_td3", "HalfCheetah-v5").name == "HalfCheetah-v5_10"
    with pytest.raises(
        FileNotFoundError, match=r"No evaluated run of mcbs_td3 on Ant-v5.*--algo mcbs_td3 --env Ant-v5"
    ):
        newest_run(logs, "mcbs_td3", "Ant-v5")


def test_run_without_evaluations_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="--eval-freq"):
        report(tmp_path, output=tmp_path / "report")
    assert not (tmp_path / "report").exists()


def test_wrong_paths_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "evaluations.npz").write_text("no archive")
    for words, message in (
        (["report", str(tmp_path / "nowhere")], "There is no folder"),
        (["report", str(tmp_path)], "--eval-freq smaller"),
        (["report", str(tmp_path / "run")], "is not what an EvalCallback writes"),
        (["report", "-f", str(tmp_path)], "Train one first"),
        (["convert-statistics", str(tmp_path / "no.pkl"), "s.npz", "--trusted"], "No such file"),
        (
            ["convert-statistics", str(tmp_path / "run" / "evaluations.npz"), "s.npz", "--trusted"],
            "unpickled",
        ),
    ):
        monkeypatch.setattr(sys, "argv", ["sb3-mcbs", *words])
        with pytest.raises(SystemExit, match=f"^sb3-mcbs {words[0]}: .*{message}") as stopped:
            cli.main()
        assert "\n" not in str(stopped.value.code)


def test_command_hands_its_arguments_on(
    logs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["sb3-mcbs", "report", "--algo", "td3", "-f", str(logs)])
    cli.main()
    assert "Mean return of the actor with search: 40.0" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "status"), [([], 2), (["--help"], 0), (["plant"], "sb3-mcbs: unknown command 'plant'")]
)
def test_command_lists_what_it_can_do(
    words: list[str], status: int | str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["sb3-mcbs", *words])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == status
    output = capsys.readouterr().out
    assert all(f"\n  {name} " in output for name in cli.COMMANDS)
