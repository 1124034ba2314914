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
from sb3_mcbs.experiments.spec import Agent
from sb3_mcbs.zoo.evaluations import ACTOR, SEARCH
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
    assert "sb3-mcbs report first/evaluations.csv</pre>" in check_page(tmp_path / "second" / "report.html")
    for of_folder, of_file in zip(load_results(folder).evaluated, load_results(csv).runs, strict=True):
        for attribute in ("name", "arm", "task", "environment", "seed", "state", "settings"):
            assert getattr(of_folder, attribute) == getattr(of_file, attribute)
        assert of_folder.policies.keys() == of_file.policies.keys()
        for policy, expected in of_folder.policies.items():
            found = of_file.policies[policy]
            np.testing.assert_array_equal(found.returns, expected.returns)
            np.testing.assert_array_equal(found.lengths, expected.lengths)
            assert found.costs(-1) == expected.costs(-1)


def test_a_file_with_one_run(tmp_path: Path) -> None:
    report(zoo(tmp_path / "logs", runs=1), output=tmp_path / "first")
    lines = report(tmp_path / "first" / "evaluations.csv", output=tmp_path / "second")
    assert lines[0] == "1 run, 1 finished" and lines[2].endswith("100, 1 run")


def test_the_file_has_every_digit(tmp_path: Path) -> None:
    folder, rng = zoo(tmp_path / "logs", runs=1), np.random.default_rng(0)
    returns = rng.normal(size=(40, 10)) * 1e4
    path = folder / "ppo" / "Hopper-v5_1" / "evaluations.npz"
    np.savez(path, timesteps=np.arange(1, 41), results=returns, seconds=rng.random(40))
    report(folder, output=tmp_path / "first")
    csv = tmp_path / "first" / "evaluations.csv"
    assert load_results(csv).runs[0].policies[ACTOR].returns.tolist() == returns.tolist()
    report(csv, output=tmp_path / "second")
    assert (tmp_path / "second" / "evaluations.csv").read_bytes() == csv.read_bytes()


def test_several_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own, others = experiment(tmp_path / "own"), zoo(zoo(tmp_path / "a b", "ppo"), "a2c")
    output = tmp_path / "out"
    words = ["sb3-mcbs", "report", str(own), "--baseline", "ppo", str(others), "-o", str(output)]
    monkeypatch.setattr(sys, "argv", words)
    cli.main()
    results = load_results(own, others, baseline="ppo")
    assert [run.arm for run in results.runs[:3]] == ["ppo", "ppo", "td3"] and len(results.runs) == 16
    text = check_page(output / "report.html")
    assert "own and a b" in text and "sb3-mcbs report own &#39;a b&#39; --baseline ppo" in text
    chosen = load_results(own, others, arms=["a2c", "td3"])
    assert list(dict.fromkeys(run.arm for run in chosen.runs)) == ["a2c", "td3"]
    with pytest.raises(PathError, match=r"no arm 'sac' .* in .*own and .*a b, only td3, mcbs_td3"):
        load_results(own, others, arms=["td3", "sac"])
    with pytest.raises(PathError, match=r"The baseline ppo is none of the arms to show: a2c, td3\."):
        load_results(own, others, arms=["a2c", "td3"], baseline="ppo")
    with pytest.raises(PathError, match=r"frozen: nothing was trained there"):
        load_results(own, frozen(tmp_path / "frozen"))


def test_the_command_asks_where_to_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(zoo(tmp_path / "logs"))
    for words, message in (
        ([folder, folder], "name the folder to write to: -o FOLDER"),
        ([folder, "--arms", "ppo"], "name the folder to write to: -o FOLDER"),
        (["--arms", "ppo", folder], f"{folder} was read as an arm: name paths before --arms"),
    ):
        monkeypatch.setattr(sys, "argv", ["sb3-mcbs", "report", *words])
        with pytest.raises(SystemExit):
            cli.main()
        assert message in capsys.readouterr().err


def test_a_run_in_two_folders_counts_once(tmp_path: Path) -> None:
    for name, means in (("short", [1.0]), ("long", [1.0, 2.0]), ("other", [3.0]), ("planned", [])):
        place = add_run(tmp_path / name, "td3", CHEETAH, 0)
        if means:
            evaluate(place, means)
    evaluate(add_run(tmp_path / "planned", "td3", CHEETAH, 1), [5.0])
    for order in (["short", "long"], ["long", "short"], ["short", "planned", "long"], ["long", "long"]):
        results = load_results(*(tmp_path / name for name in order))
        assert results.runs[0].last_step == 200 and not results.problems
        assert [run.seed for run in results.runs] == ([0, 1] if "planned" in order else [0])
    for order in (["other", "long"], ["long", "other"]):
        results = load_results(*(tmp_path / name for name in order))
        (problem,) = results.problems
        assert results.runs[0].last_step == 200 and len(results.runs) == 1
        assert "td3_HalfCheetah-v5_0 is in" in problem and problem.index("other") < problem.index("long")
    lines = report(tmp_path / "other", tmp_path / "long", output=tmp_path / "out")
    assert any("with other returns" in line for line in lines)


def test_of_two_copies_of_a_run_the_finished_one_and_both_policies_are_kept(tmp_path: Path) -> None:
    before, after = (add_run(tmp_path / name, "td3", CHEETAH, 0) for name in ("before", "after"))
    evaluate(before, [1.0, 2.0, 3.0], [4.0, 5.0, 6.0])
    before.status = {"state": "interrupted"}
    evaluate(after, [1.0, 2.0, 3.0], [4.0, 5.0, 6.0])
    report(tmp_path / "before", output=tmp_path / "csv")
    (run,) = load_results(tmp_path / "csv" / "evaluations.csv", tmp_path / "after").runs
    assert run.state == "finished" and run.folder.is_dir()
    evaluate(after, [1.0, 2.0, 3.0])  # the search's evaluations are in the other one only
    shutil.rmtree(after.training(after.run()).parents[1] / "td3_search")
    results = load_results(tmp_path / "after", tmp_path / "csv" / "evaluations.csv")
    assert results.runs[0].policies.keys() == {ACTOR, SEARCH} and not results.problems


def test_arms_with_other_settings_are_told_apart(tmp_path: Path) -> None:
    evaluate(add_run(tmp_path / "one", "td3", CHEETAH, 0), [1.0])
    evaluate(add_run(tmp_path / "two", "td3", CHEETAH, 0, gamma=0.5), [2.0])
    evaluate(add_run(tmp_path / "three", "td3", CHEETAH, 1), [3.0])
    results = load_results(tmp_path / "one", tmp_path / "two")
    assert [run.arm for run in results.runs] == ["td3 (one)", "td3 (two)"]
    assert [run.name for run in results.runs] == ["td3_HalfCheetah-v5_0", "td3_HalfCheetah-v5_0 (2)"]
    results = load_results(tmp_path / "three", tmp_path / "one")
    assert [(run.arm, run.seed) for run in results.runs] == [("td3", 0), ("td3", 1)]


def test_agents_of_one_name_in_two_environments_are_refused(tmp_path: Path) -> None:
    for environment in ("HalfCheetah-v4", "Walker2d-v4"):
        agent = Agent("sac", environment, "sac.zip", "0" * 64)
        evaluate(add_run(tmp_path / environment, "actor", environment, 0, agent), [10.0])
    with pytest.raises(PathError, match=r"'sac' acts in HalfCheetah-v4 in .*, and in Walker2d-v4 in"):
        load_results(tmp_path / "HalfCheetah-v4", tmp_path / "Walker2d-v4")


def test_runs_without_a_seed_are_one_if_their_returns_are(tmp_path: Path) -> None:
    here, there = zoo(tmp_path / "here"), zoo(tmp_path / "there")
    report(here, output=tmp_path / "csv")
    again = tmp_path / "csv" / "evaluations.csv", here / "ppo" / "Hopper-v5_1"
    assert len(load_results(here, there, *again).runs) == 2
    for run in (1, 2):
        path = there / "ppo" / f"Hopper-v5_{run}" / "evaluations.npz"
        np.savez(path, timesteps=[50_000], results=np.array([[7.0 * run]]))
    names = [run.name for run in load_results(here, there).runs]
    assert sorted(names) == sorted({*names}) and len(names) == 4
    report(here, there, output=tmp_path / "both")
    assert [run.name for run in load_results(tmp_path / "both" / "evaluations.csv").runs] == names


def test_a_report_does_not_replace_what_it_reads(tmp_path: Path) -> None:
    csv = tmp_path / "out" / "evaluations.csv"
    report(zoo(tmp_path / "logs"), output=csv.parent)
    before = csv.read_bytes()
    with pytest.raises(PathError, match="could replace a file that is read: name another -o"):
        report(csv, output=csv.parent, arms=["ppo"])
    assert csv.read_bytes() == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows.drop(columns=["arm", "seed"]), "lacks the columns arm, seed. Name the"),
        (lambda rows: rows[:0], "has no rows"),
        (lambda rows: rows.assign(arm=""), "has no arm in row 2"),
        (lambda rows: rows.assign(timesteps=np.nan), "has no timesteps in row 2"),
        (lambda rows: rows.assign(policy="actor"), "a policy that is neither 'actor alone' nor"),
        (lambda rows: rows.assign(seed=0.5), "has a seed that is no integer"),
        (lambda rows: rows.assign(seed="s0"), "has a seed that is no integer"),
        (lambda rows: rows.assign(settings="{"), "the settings { are no JSON object"),
        (lambda rows: rows[::-1], r"evaluations.csv, ppo_Hopper-v5_\d cannot be used: timesteps do not"),
        (lambda rows: rows.assign(seconds=[1.0, np.nan] * 2), "seconds are not recorded"),
        (lambda rows: rows.assign(seconds=np.inf), "seconds are not recorded, or not finite"),
        (lambda rows: rows.drop(columns="length_1"), "there are not as many lengths as returns"),
        (lambda rows: rows.assign(return_1=[1.0, np.nan] * 2), "fewer episodes than others, by returns"),
        (lambda rows: rows.assign(return_0=np.inf), "ppo_Hopper-v5_1 has returns that are not"),
        (lambda rows: rows.assign(return_0="much"), "cannot be used: results has values of type"),
    ],
)
def test_a_file_that_cannot_be_used(change, message: str, tmp_path: Path) -> None:
    csv = tmp_path / "evaluations.csv"
    report(zoo(tmp_path / "logs"), output=tmp_path)
    change(pd.read_csv(csv)).to_csv(csv, index=False)
    with pytest.raises(PathError, match=message):
        load_results(csv)


def test_no_such_file_and_no_table(tmp_path: Path) -> None:
    with pytest.raises(PathError, match=r"There is no folder"):
        load_results(tmp_path / "missing.csv")
    (tmp_path / "empty.csv").touch()
    with pytest.raises(PathError, match=r"empty.csv cannot be read"):
        load_results(tmp_path / "empty.csv")
    (tmp_path / "semicolons.csv").write_text("run;arm;task\na;b;c\n")
    with pytest.raises(PathError, match=r"semicolons.csv has one column: its values must be separated"):
        load_results(tmp_path / "semicolons.csv")
    run = zoo(tmp_path / "logs") / "ppo" / "Hopper-v5_1"
    with pytest.raises(PathError, match=r"is a part of a run: name its folder, .*Hopper-v5_1"):
        load_results(run / "evaluations.npz")


def test_arms_may_be_called_as_missing_values_are(tmp_path: Path) -> None:
    report(zoo(tmp_path / "logs", "null", runs=1), output=tmp_path)
    assert load_results(tmp_path / "evaluations.csv").runs[0].arm == "null"
