"""What a report says about folders whose runs are broken, late, of another version, or strangely named."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sb3_mcbs import cli
from sb3_mcbs.experiments.report import statistics
from sb3_mcbs.experiments.report.command import report
from sb3_mcbs.experiments.report.page import sections
from sb3_mcbs.experiments.report.runs import Competitor
from sb3_mcbs.experiments.report.sources import load_results
from sb3_mcbs.experiments.report.statistics import final_estimate, finals
from sb3_mcbs.experiments.report.tables import episode_table
from sb3_mcbs.zoo.evaluations import ACTOR
from sb3_mcbs.zoo.paths import PathError
from tests.report_helpers import add_run, check_page, evaluate, rows_of, zoo

CHEETAH = "HalfCheetah-v5"


@pytest.fixture(scope="module", autouse=True)
def _few_resamples() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(statistics, "_REPEATS", 200)
        yield


def test_a_run_that_was_first_evaluated_later_is_not_compared(tmp_path: Path) -> None:
    for place, steps in ((1, [10]), (2, [8, 16]), (3, [50, 100])):
        run = tmp_path / "ppo" / f"Pendulum-v1_{place}"
        run.mkdir(parents=True)
        results = 100.0 * place + np.array(steps)[:, None]
        np.savez(run / "evaluations.npz", timesteps=steps, results=results, ep_lengths=results)
    results = load_results(tmp_path)
    assert finals(results, "Pendulum-v1", Competitor("ppo", ACTOR)) == [110, 208]
    assert list(rows_of(episode_table(results))) == ["ppo_Pendulum-v1_1", "ppo_Pendulum-v1_2"]
    assert "No curve of ppo: alone in Pendulum-v1" in " ".join(sections(results)[1].text)
    text = " ".join(sections(results)[0].text)
    assert "Some runs in Pendulum-v1 were not evaluated at that step, but before" in text
    assert "Not compared in Pendulum-v1, since first evaluated later: ppo_Pendulum-v1_3." in text


def test_names_are_escaped(tmp_path: Path) -> None:
    (tmp_path / "spec.yml").write_text("# <b>&\n")
    evaluate(add_run(tmp_path, "td3", CHEETAH, 0), [1.0, 2.0, 3.0])
    report(tmp_path, output=tmp_path / "report")
    assert "# &lt;b&gt;&amp;" in check_page(tmp_path / "report" / "report.html")


def test_names_of_folders_are_no_markup(tmp_path: Path) -> None:
    names = ("a$_{$b", "<b>\"&'", "{{7*7}}", "_x")
    for name in names:
        zoo(tmp_path / "logs", name)
    report(tmp_path / "logs", output=tmp_path / "report")
    text = check_page(tmp_path / "report" / "report.html")
    assert "<b>" not in re.sub(r"<li><b>", "", text) and "{{7*7}}: alone" in text and "a$_{$b: alone" in text


def test_a_broken_file_is_named_and_the_others_are_reported(tmp_path: Path) -> None:
    broken = zoo(tmp_path / "logs", runs=3) / "ppo" / "Hopper-v5_2" / "evaluations.npz"
    broken.write_bytes(b"PK no archive")
    lines = report(tmp_path / "logs", output=tmp_path / "report")
    assert any(str(broken) in line and "is not what an EvalCallback writes" in line for line in lines)
    assert lines[2].endswith("200, 2 runs")
    assert "Problems:" in check_page(tmp_path / "report" / "report.html")
    np.savez(broken, timesteps=[1, 2], results=np.zeros((1, 2)), ep_lengths=np.zeros((1, 2)))
    assert "results has the shape (1, 2)" in " ".join(load_results(tmp_path / "logs").problems)
    np.savez(broken, timesteps=[2, 1], results=np.zeros((2, 2)))
    assert "timesteps do not increase" in " ".join(load_results(tmp_path / "logs").problems)
    np.savez(broken, timesteps=["a"], results=np.zeros((1, 2)))
    assert "timesteps has values of type <U1" in " ".join(load_results(tmp_path / "logs").problems)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_run_that_diverged_does_not_count_as_the_best(tmp_path: Path, value: float) -> None:
    for place in range(1, 6):
        run = tmp_path / "ppo" / f"Pendulum-v1_{place}"
        run.mkdir(parents=True)
        last = value if place == 1 else float(place)
        np.savez(run / "evaluations.npz", timesteps=[10, 20], results=np.array([[1.0], [last]]))
    results = load_results(tmp_path)
    estimate = final_estimate(results, "Pendulum-v1", Competitor("ppo", ACTOR))
    assert estimate is not None and (estimate.value, estimate.n) == (3.5, 4)
    (problem,) = results.problems
    assert "Pendulum-v1_1" in problem and "not finite numbers, first after 20 steps" in problem


@pytest.mark.parametrize("content", ["", "[]", "text", "{name: td3, steps: 3}", "{agent: [1]}"])
def test_a_run_of_another_version_is_named(tmp_path: Path, content: str) -> None:
    evaluate(add_run(tmp_path, "td3", CHEETAH, 0), [1.0])
    other = add_run(tmp_path, "td3", CHEETAH, 1).definition
    other.write_text(content)
    results = load_results(tmp_path)
    assert [run.seed for run in results.runs] == [0]
    assert len(results.problems) == 1 and f"{other} cannot be read" in results.problems[0]


def test_broken_files_of_an_experiment_do_not_end_the_report(tmp_path: Path) -> None:
    place = add_run(tmp_path, "td3", CHEETAH, 0)
    evaluate(place, [1.0])
    (tmp_path / "spec.yml").write_bytes(b"# \xff")
    (place.path / "status.json").write_text("[1]")
    (place.path / "machines.json").write_text("[1]")
    (run,) = load_results(tmp_path).runs
    assert (run.state, run.machines) == ("not started", [])


def test_folders_with_nothing_in_them(tmp_path: Path) -> None:
    add_run(tmp_path / "planned", "td3", CHEETAH, 0)
    with pytest.raises(PathError, match=r"nothing to report in .*planned. Its runs have not come to an"):
        load_results(tmp_path / "planned")
    (tmp_path / "empty").mkdir()
    with pytest.raises(PathError, match=r"Name the folder of a run, .*--eval-freq"):
        load_results(tmp_path / "empty")


def test_several_runs_need_rliable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rliable.library", None)
    monkeypatch.setattr(sys, "argv", ["sb3-mcbs", "report", str(zoo(tmp_path / "logs"))])
    with pytest.raises(SystemExit, match=r"^sb3-mcbs report: .*pip install 'sb3-mcbs\[report\]'"):
        cli.main()
    monkeypatch.setattr(sys, "argv", ["sb3-mcbs", "report", str(tmp_path / "logs" / "ppo" / "Hopper-v5_1")])
    cli.main()
    assert "Mean return of the actor alone: 100.0 (2 episodes after 100000 steps)" in capsys.readouterr().out
