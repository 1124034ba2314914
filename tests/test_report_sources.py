"""Reports of several folders, and of the ``evaluations.csv`` of other reports."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sb3_mcbs import cli
from sb3_mcbs.experiments.report import statistics
from sb3_mcbs.experiments.report.command import report
from sb3_mcbs.experiments.report.sources import load_results
from sb3_mcbs.zoo.paths import PathError
from tests.report_helpers import add_run, check_page, evaluate, experiment, frozen, zoo

CHEETAH = "HalfCheetah-v5"


@pytest.fixture(autouse=True)
def _few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "_REPEATS", 200)


@pytest.mark.parametrize("make", [experiment, zoo, frozen])
def test_evaluations_csv_is_as_good_as_the_folder(make, tmp_path: Path) -> None:
    folder = make(tmp_path / "folder")
    lines = report(folder, output=tmp_path / "first")
    csv = tmp_path / "first" / "evaluations.csv"
    again = report(csv, output=tmp_path / "second")
    missing = len(load_results(folder).runs) - len(load_results(csv).runs)
    assert missing == (1 if make is experiment else 0)  # the run without evaluations
    assert lines[1:-1] == again[1:-1]
    assert (tmp_path / "second" / "evaluations.csv").read_bytes() == csv.read_bytes()
    names = {path.name for path in (tmp_path / "first").iterdir()}
    assert names == {path.name for path in (tmp_path / "second").iterdir()}
    assert "sb3-mcbs report evaluations.csv</pre>" in check_page(tmp_path / "second" / "report.html")
    for of_folder, of_file in zip(load_results(folder).evaluated, load_results(csv).runs, strict=True):
        assert (of_folder.seed, of_folder.state, of_folder.task) == (
            of_file.seed,
            of_file.state,
            of_file.task,
        )
        assert of_folder.policies.keys() == of_file.policies.keys()
        for policy, expected in of_folder.policies.items():
            found = of_file.policies[policy]
            np.testing.assert_array_equal(found.returns, expected.returns)
            np.testing.assert_array_equal(found.lengths, expected.lengths)
            assert found.costs(-1) == expected.costs(-1)


def test_a_file_with_one_run(tmp_path: Path) -> None:
    report(zoo(tmp_path / "logs", runs=1), output=tmp_path / "first")
    lines = report(tmp_path / "first" / "evaluations.csv", output=tmp_path / "second")
    assert lines[0] == "1 runs, 1 finished" and lines[2].endswith("100, 1 run")


def test_several_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    own, others = experiment(tmp_path / "own"), zoo(zoo(tmp_path / "a b", "ppo"), "a2c")
    monkeypatch.setattr(sys, "argv", ["sb3-mcbs", "report", str(own), str(others), "--baseline", "ppo"])
    cli.main()
    results = load_results(own, others, baseline="ppo")
    assert [run.arm for run in results.runs[:3]] == ["ppo", "ppo", "td3"] and len(results.runs) == 16
    text = check_page(own / "report" / "report.html")
    assert "own and a b" in text and "sb3-mcbs report own &#39;a b&#39; --baseline ppo" in text
    chosen = load_results(own, others, arms=["a2c", "td3"])
    assert list(dict.fromkeys(run.arm for run in chosen.runs)) == ["a2c", "td3"]
    with pytest.raises(PathError, match=r"no arm 'sac' .* in .*own and .*a b, only td3, mcbs_td3"):
        load_results(own, others, arms=["td3", "sac"])
    with pytest.raises(PathError, match=r"no arm 'ppo' .*, only a2c, td3\."):
        load_results(own, others, arms=["a2c", "td3"], baseline="ppo")
    with pytest.raises(PathError, match="cannot be reported together"):
        load_results(own, frozen(tmp_path / "frozen"))


def test_a_run_in_two_folders_counts_once(tmp_path: Path) -> None:
    for name, means in (("short", [1.0]), ("long", [1.0, 2.0]), ("other", [3.0]), ("planned", [])):
        place = add_run(tmp_path / name, "td3", CHEETAH, 0)
        if means:
            evaluate(place, means)
    evaluate(add_run(tmp_path / "planned", "td3", CHEETAH, 1), [5.0])
    for order in (["short", "long"], ["long", "short"], ["short", "planned", "long"]):
        results = load_results(*(tmp_path / name for name in order))
        assert results.runs[0].last_step == 200 and not results.problems
        assert len(results.runs) == (2 if "planned" in order else 1)
    for order in (["other", "long"], ["long", "other"]):
        results = load_results(*(tmp_path / name for name in order))
        (problem,) = results.problems
        assert results.runs[0].last_step == 200 and len(results.runs) == 1
        assert "td3_HalfCheetah-v5_0 is in" in problem and problem.index("other") < problem.index("long")


def test_runs_without_a_seed_may_have_one_name(tmp_path: Path) -> None:
    zoo(tmp_path / "here"), zoo(tmp_path / "there")
    assert len(load_results(tmp_path / "here", tmp_path / "there").runs) == 4


def test_a_report_does_not_replace_what_it_reads(tmp_path: Path) -> None:
    csv = tmp_path / "out" / "evaluations.csv"
    report(zoo(tmp_path / "logs"), output=csv.parent)
    before = csv.read_bytes()
    with pytest.raises(PathError, match="would replace the file that is read: name another -o"):
        report(csv, output=csv.parent, arms=["ppo"])
    assert csv.read_bytes() == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda rows: rows.drop(columns=["arm", "seed"]),
            "lacks the columns arm, seed. Name the",
        ),
        (lambda rows: rows.assign(policy="actor"), "a policy that is neither 'actor alone' nor"),
        (lambda rows: rows[::-1], r"evaluations.csv, ppo_Hopper-v5_\d cannot be used: timesteps do not"),
        (
            lambda rows: rows.assign(return_1=np.nan, return_0=np.inf),
            "ppo_Hopper-v5_1 has returns that are not",
        ),
        (lambda rows: rows.assign(return_0="much"), "cannot be used: results has values of type object"),
        (lambda rows: rows.assign(settings="{"), "the settings '{' are no JSON object"),
        (lambda rows: rows[:0], "has no rows"),
    ],
)
def test_a_file_that_cannot_be_used(change, message: str, tmp_path: Path) -> None:
    csv = tmp_path / "evaluations.csv"
    report(zoo(tmp_path / "logs"), output=tmp_path)
    change(pd.read_csv(csv)).to_csv(csv, index=False)
    with pytest.raises(PathError, match=message):
        load_results(csv)


def test_no_such_file_and_no_table(tmp_path: Path) -> None:
    with pytest.raises(PathError, match="There is no folder"):
        load_results(tmp_path / "missing.csv")
    (tmp_path / "empty.csv").touch()
    with pytest.raises(PathError, match=r"empty.csv cannot be read"):
        load_results(tmp_path / "empty.csv")
    shutil.copy(zoo(tmp_path / "logs") / "ppo" / "Hopper-v5_1" / "evaluations.npz", tmp_path)
    with pytest.raises(PathError, match=r"evaluations.npz cannot be read"):
        load_results(tmp_path / "evaluations.npz")
