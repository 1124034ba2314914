"""What a report says about folders with known numbers."""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sb3_mcbs.experiments.report import statistics
from sb3_mcbs.experiments.report.command import report
from sb3_mcbs.experiments.report.comparisons import final_picture, heat_pictures, overall_pictures
from sb3_mcbs.experiments.report.content import number
from sb3_mcbs.experiments.report.curves import curve_pictures
from sb3_mcbs.experiments.report.page import Section, sections
from sb3_mcbs.experiments.report.references import paper_beam, paper_finals, published_curves
from sb3_mcbs.experiments.report.runs import Competitor
from sb3_mcbs.experiments.report.sources import load_results
from sb3_mcbs.experiments.report.statistics import (
    common_step,
    final_estimate,
    finals,
    improvement,
    learning_curve,
    overall,
)
from sb3_mcbs.experiments.report.tables import episode_table, machine_table, run_table, speed_table
from sb3_mcbs.zoo.evaluations import ACTOR, SEARCH
from sb3_mcbs.zoo.paths import PathError
from tests.report_helpers import add_run, check_page, evaluate, experiment, frozen, rows_of, zoo

TD3, MCBS, MCBS_SEARCH = (
    Competitor("td3", ACTOR),
    Competitor("mcbs_td3", ACTOR),
    Competitor("mcbs_td3", SEARCH),
)
CHEETAH, WALKER = "HalfCheetah-v5", "Walker2d-v5"


@pytest.fixture(scope="module", autouse=True)
def _few_resamples() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(statistics, "_REPEATS", 200)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return experiment(tmp_path_factory.mktemp("experiment") / "two-arms")


@pytest.fixture(scope="module")
def parts(folder: Path) -> dict[str, Section]:
    return {part.name: part for part in sections(load_results(folder))}


def test_arms_are_compared_where_all_runs_have_come(folder: Path, parts: dict[str, Section]) -> None:
    results = load_results(folder)
    assert (results.tasks, results.competitors) == ([CHEETAH, WALKER], [TD3, MCBS, MCBS_SEARCH])
    assert (common_step(results, CHEETAH), common_step(results, WALKER)) == (300, 200)
    assert finals(results, CHEETAH, TD3) == [3000, 4000, 5000]
    assert finals(results, WALKER, MCBS_SEARCH) == [800, 900]
    text = " ".join(parts["returns"].text)
    assert "In Walker2d-v5 runs are compared after 200 environment steps" in text
    assert "mcbs_td3_Walker2d-v5_1 came no further; others have 300" in text and CHEETAH not in text


def test_estimates_are_those_of_rliable(folder: Path) -> None:
    from rliable import metrics

    results = load_results(folder)
    estimate = final_estimate(results, CHEETAH, TD3)
    assert estimate is not None and estimate.low is not None and estimate.high is not None
    assert estimate.value == 4000 and 3000 <= estimate.low < 4000 < estimate.high <= 5000
    pair = final_estimate(results, WALKER, MCBS)
    assert pair == (750, None, None, 2)
    assert overall(results, TD3, {CHEETAH: 1000, WALKER: 100}) is not None
    generator = np.random.default_rng(0)
    scores, others = generator.normal(size=(5, 3)), generator.normal(size=(4, 3)).round(1)
    others[0] = scores[0]
    assert statistics._iqm(scores[:, :, None])[0] == pytest.approx(metrics.aggregate_iqm(scores))
    expected = metrics.probability_of_improvement(scores, others)
    assert statistics._probability(scores, others)[0] == pytest.approx(expected)


def test_probability_of_improvement(folder: Path) -> None:
    results = load_results(folder)
    # 8000, 9000, 10000 against 3000, 4000, 5000: always more, so that resamples cannot differ.
    assert improvement(results, MCBS, TD3, [CHEETAH]) == (1.0, None, None, 3)
    assert improvement(results, TD3, MCBS, [CHEETAH]) == (0.0, None, None, 3)
    both = improvement(results, MCBS, TD3, [CHEETAH, WALKER])
    assert both == (1.0, None, None, 2)
    same = improvement(results, TD3, TD3, [CHEETAH])
    assert same is not None and same.value == 0.5 and same.low is not None and same.low < 0.5


def test_means_over_environments_are_relative_to_a_published_agent(parts: dict[str, Section]) -> None:
    part = parts["comparison"]
    assert "divided by the return of RL Zoo's published TD3 agent after 1,000,000 steps" in " ".join(
        part.text
    )
    (picture,) = (picture for picture in part.pictures if picture.name == "overall")
    # 3 seeds of each: the middle four of 3000, 4000, 5000 by 10384.7 and of 200, 300, 400 by 4006.4.
    scores = sorted(
        [3000 / 10384.7, 4000 / 10384.7, 5000 / 10384.7, 200 / 4006.4, 300 / 4006.4, 400 / 4006.4]
    )
    assert rows_of(picture.table)["td3: alone"]["interquartile mean (95 % interval)"].startswith(
        number(float(np.mean(scores[1:5])))
    )
    assert rows_of(picture.table)["mcbs_td3: with search"]["runs per environment"] == "2"


def test_returns_below_zero_are_not_averaged_over_environments(tmp_path: Path) -> None:
    for environment in ("Pendulum-v1", CHEETAH):
        for seed in range(2):
            evaluate(add_run(tmp_path, "td3", environment, seed), [-300.0, -200.0, -100.0])
    results = load_results(tmp_path)
    assert not overall_pictures(results, {}, "")
    assert "90 %: steps" in speed_table(results).head
    assert rows_of(speed_table(results))["td3_Pendulum-v1_0"]["90 %: steps"] == "–"


def test_why_there_is_no_mean_over_environments(tmp_path: Path) -> None:
    for arm, environment in (("a", "Foo-v0"), ("b", "Foo-v0"), ("b", "Bar-v0")):
        for place in (1, 2):
            run = tmp_path / arm / f"{environment}_{place}"
            run.mkdir(parents=True)
            np.savez(run / "evaluations.npz", timesteps=[10], results=[[5.0]], ep_lengths=[[5]])
    text = " ".join(part.text[-1] for part in sections(load_results(tmp_path)) if part.name == "comparison")
    assert "no mean over environments: in some the baseline has no return above zero" in text


def test_curves_end_where_a_run_ends_and_show_every_seed(folder: Path) -> None:
    results = load_results(folder)
    curve = learning_curve(results.of(WALKER, MCBS), ACTOR)
    assert curve is not None and curve.low is None
    assert (curve.steps.tolist(), curve.centre.tolist(), curve.n) == ([100, 200], [650, 750], 2)
    curve = learning_curve(results.of(CHEETAH, TD3), ACTOR)
    assert curve is not None and curve.low is not None and curve.centre.tolist() == [2000, 3000, 4000]
    pictures = {picture.name: picture for picture in curve_pictures(results, CHEETAH)}
    assert list(pictures) == [f"curves-{CHEETAH}-{axis}" for axis in ("steps", "simulated", "time")]
    assert "mcbs_td3: with search ends at 10,000 after 300 steps" in pictures[f"curves-{CHEETAH}-steps"].alt
    assert "1k<" in pictures[f"curves-{CHEETAH}-simulated"].drawing.svg  # and no markup of a logarithm
    simulated = rows_of(pictures[f"curves-{CHEETAH}-simulated"].table)["300"]
    assert simulated["mcbs_td3: alone, steps of the environment and of the search"] == "3,300"
    time = rows_of(pictures[f"curves-{CHEETAH}-time"].table)["300"]
    assert time["td3: alone, hours of training"] == "3"


def test_markers_do_not_hide_a_long_curve(tmp_path: Path) -> None:
    run = zoo(tmp_path, runs=1) / "ppo" / "Hopper-v5_1"
    np.savez(run / "evaluations.npz", timesteps=np.arange(1, 3001), results=np.zeros((3000, 1)))
    (picture,) = curve_pictures(load_results(tmp_path), "Hopper-v5")
    assert 20 < picture.drawing.svg.count("<use") < 60


def test_tables_of_runs(folder: Path) -> None:
    results = load_results(folder)
    runs = rows_of(run_table(results))
    assert len(runs) == 12 and next(iter(runs)) == "td3_HalfCheetah-v5_0"
    assert [runs[f"mcbs_td3_Walker2d-v5_{seed}"]["state"] for seed in range(3)] == [
        "finished", "not started", "not started",
    ]  # fmt: skip
    assert runs["mcbs_td3_HalfCheetah-v5_0"]["steps of the search"] == "3,000"
    assert runs["mcbs_td3_HalfCheetah-v5_0"]["actor with search"] == "9,000"
    soon = rows_of(speed_table(results))["td3_HalfCheetah-v5_2"]
    # The mean of the baseline is 4000; this run has 3000, 4000, 5000, of which 4500 is 90 %.
    assert (soon["90 %: steps"], soon["baseline: steps"], soon["baseline: hours"]) == ("300", "200", "2")
    episodes = rows_of(episode_table(results))
    assert episodes["td3_HalfCheetah-v5_1"]["ended early"] == "50 %"
    assert episodes["td3_HalfCheetah-v5_1"]["mean length"] == "750"
    assert episodes["td3_HalfCheetah-v5_0"]["ended early"] == "0 %"


def test_published_figures_stand_beside_ones_own(folder: Path) -> None:
    cells = rows_of(final_picture(load_results(folder), CHEETAH).table)
    assert cells["paper's MCBS-TD3, 1M (Table I)"]["mean"] == "10,471"
    assert (cells["td3: alone"]["mean"], cells["td3: alone"]["standard deviation"]) == ("4,000", "1,000")
    assert paper_finals("Swimmer-v5")["TD3"] == (349.92, 4.04) and not paper_finals("Pendulum-v1")
    assert paper_beam()[18, 6] == (10840.47, 247.58)
    by_name = {
        each.name: dict(zip(each.steps, each.returns, strict=True)) for each in published_curves(CHEETAH)
    }
    assert (by_name["RL Zoo TD3"][300_000], by_name["CrossQ"][100_000]) == (8487.9, 8365)


def test_a_grid_around_a_trained_agent(tmp_path: Path) -> None:
    results = load_results(frozen(tmp_path / "frozen"))
    own, paper = heat_pictures(results)
    assert rows_of(own.table) == {
        "6": {"B": "6", "D = 1": "61, 1 run", "D = 3": "63, 1 run"},
        "18": {"B": "18", "D = 1": "181, 1 run", "D = 3": "183, 1 run"},
    }
    assert rows_of(paper.table)["1"]["D = 6"] == "–"
    assert not any("improvement" in line for part in sections(results) for line in part.text)
    lines = report(tmp_path / "frozen", output=tmp_path / "out")
    assert lines[:2] == ["5 runs, 5 finished", "sac:"] and "actor" in lines[2]
    text = check_page(tmp_path / "out" / "report.html")
    assert "Learning curves" not in text and "nothing was trained" in text
    assert [line.split()[0] for line in lines[2:7]] == ["actor", *["search"] * 4]
    assert [" ".join(line.split()[1:3]) for line in lines[3:7]] == [
        "B=6 D=1",
        "B=6 D=3",
        "B=18 D=1",
        "B=18 D=3",
    ]


def test_the_page_and_its_files(folder: Path, tmp_path: Path) -> None:
    lines = report(folder, output=tmp_path)
    assert lines[0] == "12 runs, 10 finished" and lines[-1] == f"Report: {tmp_path / 'report.html'}"
    assert "  td3: alone                       4,000 (3,000 to 5,000), 3 runs" in lines
    text = check_page(tmp_path / "report.html")
    assert "prefers-color-scheme: dark" in text
    assert "sb3-mcbs experiment two-arms/spec.yml -o two-arms" in text
    assert "The machine and the versions of packages are not recorded" in text
    assert str(folder.parent) not in text
    pictures = {path.stem for path in tmp_path.glob("*.png")}
    assert pictures == {path.stem for path in tmp_path.glob("*.svg")} and len(pictures) == text.count(
        "<figure>"
    )
    with (tmp_path / "runs.csv").open() as file:
        runs = {row["run"]: row for row in csv.DictReader(file)}
    assert runs["mcbs_td3_HalfCheetah-v5_0"]["actor_with_search_return"] == "9000.0"
    assert runs["mcbs_td3_Walker2d-v5_2"]["actor_alone_return"] == ""
    with (tmp_path / "evaluations.csv").open() as file:
        evaluations = list(csv.DictReader(file))
    assert len(evaluations) == 6 * 3 + 2 * (4 * 3 + 2)
    assert evaluations[0] == {
        "run": "td3_HalfCheetah-v5_0", "arm": "td3", "task": CHEETAH, "environment": CHEETAH,
        "seed": "0", "state": "finished", "settings": '{"algorithm": "td3"}', "policy": "actor alone",
        "timesteps": "100", "simulated_steps": "0", "seconds": "3600.0", "mean_return": "1000.0",
        "return_0": "999.0", "length_0": "1000", "return_1": "1001.0", "length_1": "1000",
    }  # fmt: skip


def test_the_same_report_twice(folder: Path) -> None:
    state = np.random.get_state()[1].tolist()
    pictures = []
    for _ in range(2):
        statistics._single.cache_clear()
        pictures.append(final_picture(load_results(folder), CHEETAH))
    assert pictures[0] == pictures[1] and "(3,000 to 5,000)" in pictures[0].alt
    assert np.random.get_state()[1].tolist() == state


def test_logs_of_another_algorithm(tmp_path: Path) -> None:
    lines = report(zoo(tmp_path / "logs"), output=tmp_path / "report")
    assert lines[:3] == [
        "2 runs, 2 finished",
        "Hopper-v5, interquartile mean after 100000 steps:",
        f"  {'ppo: alone':32} 150, 2 runs",
    ]
    text = check_page(tmp_path / "report" / "report.html")
    assert "for 2 of 2 runs, which are drawn over environment steps only" in text
    names = {path.name for path in (tmp_path / "report").glob("*.svg")}
    assert names == {"final-Hopper-v5.svg", "curves-Hopper-v5-steps.svg", "published-Hopper-v5.svg"}
    assert rows_of(episode_table(load_results(tmp_path / "logs")))["ppo_Hopper-v5_1"]["ended early"] == "50 %"


def test_runs_stand_in_the_order_of_their_seeds(tmp_path: Path) -> None:
    zoo(tmp_path, runs=10)
    assert [run.folder.name for run in load_results(tmp_path).runs][-1] == "Hopper-v5_10"
    for run in range(1, 11):
        place = tmp_path / "ppo" / f"Hopper-v5_{run}" / "Hopper-v5"
        place.mkdir()
        (place / "args.yml").write_text(f"{{env: Hopper-v5, seed: {20 - run}}}")
        (place / "config.yml").write_text("{gamma: 0.9}")
    assert [run.seed for run in load_results(tmp_path).runs] == list(range(10, 20))


def test_runs_of_one_algorithm_with_other_settings_are_other_arms(tmp_path: Path) -> None:
    zoo(tmp_path, "mcbs_td3", runs=3)
    for run, width in ((1, 6), (2, 18), (3, 18)):
        place = tmp_path / "mcbs_td3" / f"Hopper-v5_{run}" / "Hopper-v5"
        place.mkdir()
        (place / "args.yml").write_text(f"{{env: Hopper-v5, seed: {run}}}")
        (place / "config.yml").write_text(f"{{beam_width: {width}, n_timesteps: {run}.0, rollout_depth: 3}}")
    results = load_results(tmp_path)
    arms = [(run.arm, run.seed) for run in results.runs]
    assert arms == [
        ("mcbs_td3-beam_width=6", 1),
        ("mcbs_td3-beam_width=18", 2),
        ("mcbs_td3-beam_width=18", 3),
    ]
    assert rows_of(heat_pictures(results)[0].table)["18"]["D = 3"] == "250, 2 runs"


def test_the_run_of_an_experiment_is_one_run(tmp_path: Path) -> None:
    place = add_run(tmp_path, "mcbs_td3", CHEETAH, 0)
    evaluate(place, [1.0, 2.0, 3.0], [2.0, 3.0, 4.0])
    training = place.training(place.run())
    (training / f"{CHEETAH}.zip").touch()
    lines = report(place.path, output=tmp_path / "report")
    assert lines[1] == "Mean return of the actor with search: 4.0 (2 episodes after 300 steps)"
    assert lines[2:4] == [f"Model:          {training / CHEETAH}.zip", f"Logs:           {training}"]


def test_the_baseline_can_be_chosen(tmp_path: Path) -> None:
    zoo(zoo(tmp_path, "a2c"), "ppo")
    assert load_results(tmp_path).competitors[0].arm == "a2c"
    assert load_results(tmp_path, baseline="ppo").competitors[0].arm == "ppo"
    with pytest.raises(PathError, match=r"There is no arm 'td3' with evaluations in .*, only a2c, ppo"):
        load_results(tmp_path, baseline="td3")


def test_machines_of_runs(tmp_path: Path) -> None:
    for seed, version in enumerate(("1.0", "1.0", "2.0")):
        place = add_run(tmp_path, "td3", CHEETAH, seed)
        evaluate(place, [1.0, 2.0, 3.0])
        for _ in range(2):
            place.note_machine({"python": "3.11", "torch": version})
    table = machine_table(load_results(tmp_path))
    assert table is not None
    assert (table.head, table.rows) == (
        ["", "of 2 runs", "of 1 run"],
        [["python", "3.11", "3.11"], ["torch", "1.0", "2.0"]],
    )
