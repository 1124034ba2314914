"""The benchmarks still run, small, and count what they say that they count."""

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import TD3

from benchmarks import common


@pytest.fixture(autouse=True)
def results_elsewhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(common, "output_folder", tmp_path)


def run(monkeypatch, module, *words):
    """Run a benchmark's command."""
    monkeypatch.setattr("sys.argv", [module.__name__, *words])
    module.main()


def test_results_go_where_the_command_line_says(monkeypatch, capsys):
    for words, folder in ([], Path("benchmark-results")), (["--output", "a/b"], Path("a/b")):
        monkeypatch.setattr("sys.argv", ["benchmark", *words])
        assert vars(common.parse_args(argparse.ArgumentParser())) == {}
        assert common.write("nothing", [1.5]) == folder / "nothing.json"
        assert f"Written: {folder / 'nothing.json'}" in capsys.readouterr().out
        assert common.read("nothing") == [1.5]


def test_a_short_run_leaves_the_committed_results_alone(monkeypatch):
    from benchmarks import deadline

    committed = common.COMMITTED / "deadline.json"
    before = committed.read_bytes()
    assert common.read("deadline") == json.loads(before)["results"], "what a benchmark goes on from"
    run(monkeypatch, deadline, "--env", "Pendulum-v1", "--ms", "1", "--decisions", "10")
    assert committed.read_bytes() == before
    assert [row["env"] for row in common.read("deadline")] == ["Pendulum-v1"]


def test_arms_that_were_measured_before_are_named(monkeypatch, tmp_path, capsys, make_agent):
    from benchmarks import strategies

    make_agent(cls=TD3, learning_starts=100).save(tmp_path / "pendulum.zip")
    ran = []
    result = {"returns": [-1.0], "simulated steps": 0.0}
    monkeypatch.setattr(strategies, "run_arm", lambda *arguments: ran.append(arguments) or result)
    words = ["pendulum.zip", "Pendulum-v1", "--most", "30", "--arms", "actor alone", "beam 10x6"]
    for again, n_ran in ([], 1), ([], 1), (["--again"], 2):
        run(monkeypatch, strategies, *again, *words)
        output = capsys.readouterr().out
        assert len(ran) == n_ran
        assert "more than 30 steps (--most): beam 10x6" in output
    run(monkeypatch, strategies, *words)
    assert "benchmark-results/strategies.json has them (--again runs them anew): actor alone" in (
        capsys.readouterr().out
    )
    assert [row["returns"] for row in common.read("strategies") if row["agent"] == "pendulum"] == [[-1.0]]


def test_any_environment_has_the_costs_of_the_models_that_simulate_it(monkeypatch, capsys):
    from benchmarks import forward_models

    words = ("--env", "Pendulum-v1", "Hopper-v5", "--rows", "4", "--repetitions", "2")
    run(monkeypatch, forward_models, *words)
    _, *lines = capsys.readouterr().out.splitlines()
    cells = {tuple(line.split()[:2]): line.split()[2:] for line in lines}
    assert cells["Pendulum-v1", "mujoco"][0] == "cannot:"
    for row in (("Pendulum-v1", "pool"), ("Hopper-v5", "mujoco"), ("Hopper-v5", "pool")):
        assert len([float(cell) for cell in cells[row]]) == len(forward_models.COLUMNS)


def test_search_outside_mujoco(monkeypatch, tmp_path, capsys):
    from benchmarks import search

    run(monkeypatch, search, "--env", "Pendulum-v1", "--size", "3,2,2", "--seconds", "0.05")
    (row,) = common.read("search")
    missing = {"physics floor ms", "ms / floors", "usual way ms", "usual way / ours"}
    assert {name for name, value in row.items() if value is None} == missing
    assert row["simulated steps"] == 3 + 6 and row["control period ms"] == pytest.approx(50)
    assert "| Pendulum-v1 | (3, 2, 2) |" in capsys.readouterr().out
    assert common.output_path("search.png").stat().st_size > 0


@pytest.mark.slow
def test_search(tmp_path):
    from benchmarks import search

    result = search.measure("HalfCheetah-v5", (3, 2, 2), 0.1)
    assert result["simulated steps"] == 3 + 6
    search.draw([result])
    assert (tmp_path / "search.png").stat().st_size > 0


@pytest.mark.slow
def test_the_recorded_products_are_those_of_the_search():
    from benchmarks.search import Decision

    decision = Decision("HalfCheetah-v5", (3, 2, 2))
    rows = [len(left) for left, *_ in decision.products[0][::3]]
    # The actor at the root, after the first step (shared by simulations), after the second; both critics.
    assert rows == [1, 3, 6, 6, 6]
    assert [len(states) for states in decision.states] == [3, 6]


@pytest.mark.slow
def test_training(tmp_path, monkeypatch):
    from benchmarks import training

    arms = ("SB3 TD3", "SB3 TD3, our update", "MCBSTD3 (6,3,1)", "the usual way (6,3,5)")
    results = training.measure("HalfCheetah-v5", arms, 1, rounds=2, steps=5, sbx_python=None)
    assert [result["arm"] for result in results] == list(arms)
    assert results[0]["/ SB3 TD3"] == pytest.approx(1)
    assert {"simulate", "networks in search", "gradient"} <= results[2]["ms per step"].keys()
    training.draw(results)
    assert (tmp_path / "training.png").stat().st_size > 0


@pytest.mark.slow
def test_scaling_and_memory_and_deadline(monkeypatch):
    from benchmarks import deadline, memory, scaling

    monkeypatch.setitem(scaling.VARIED, "beam_width", (2, 4))
    results = scaling.measure("HalfCheetah-v5", "beam_width", 0.1)
    assert [result["simulated steps"] for result in results] == [22, 44]
    assert np.isfinite(scaling.exponent(results))
    scaling.draw("HalfCheetah-v5", [{**result, "exponent": 1.0} for result in results])
    agent = memory.make_agent("Pendulum-v1")
    assert len(memory.over_decisions(agent, 10, 5)) == 3
    assert len(memory.over_training(agent, 10, 5)) == 3
    assert deadline.measure("Pendulum-v1", 0.05, 20)["candidates"] > 0


SLOWLY = {
    "snapshot": {
        "captured_by": ["MjModelAdapter (model)", "MjDataAdapter"],
        "replays": False,
        "steps_compared": 9,
    },
    "forward_model": {"kind": "pool", "deterministic": True},
    "costs": [{"preset": "paper", "milliseconds": 12.34}],
    "hyperparameters": {"policy": "MultiInputPolicy", "preset": "efficient", "learning_rate": 1e-3},
}


def test_the_support_table_names_what_is_missing_and_what_fails(monkeypatch, tmp_path, capsys):
    from benchmarks import support_table

    Row = support_table.Row
    rows = (
        Row("Fetch-v4", also="HER"),
        Row("Other-v0"),
        Row("No-v0", package="not-a-package"),
        Row("Bad-v0"),
    )
    examined = []

    def examine(request, limit, on_stage):
        examined.append(request.environment)
        return {"problem": "It is broken."} if request.environment == "Bad-v0" else dict(SLOWLY)

    monkeypatch.setattr(support_table, "ROWS", rows)
    monkeypatch.setattr(support_table, "examine", examine)
    monkeypatch.setattr(
        support_table,
        "block",
        lambda found, *_: None if "problem" in found else json.dumps({"entry": found["hyperparameters"]}),
    )
    page = tmp_path / "page.md"
    page.write_text(f"Before\n{support_table.BEGIN}\nold\n{support_table.END}\nafter\n")
    run(monkeypatch, support_table, "--page", str(page))
    assert examined == ["Fetch-v4", "Other-v0", "Bad-v0"]
    text = page.read_text()
    assert text.startswith("Before\n") and text.endswith("after\n") and "old" not in text
    assert "| `Fetch-v4` | MuJoCo | copies | 9 steps | 12.3 | A, `MultiInputPolicy`, HER |" in text
    assert "| `Other-v0` | MuJoCo | copies | 9 steps | 12.3 | A, `MultiInputPolicy` |" in text
    assert "not installed: `pip install not-a-package`" in text
    assert "no: It is broken." in text
    assert "- **A** `{preset: efficient}`" in text
    assert "| `Fetch-v4` |" in capsys.readouterr().out

    page.write_text("no marks")
    with pytest.raises(SystemExit, match="has no lines"):
        run(monkeypatch, support_table, "--page", str(page), "--only", "No-v0")
    assert page.read_text() == "no marks"


def test_the_check_of_a_gpu_needs_one(monkeypatch):
    from benchmarks import check_gpu

    monkeypatch.setattr(check_gpu.th.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit, match="There is no GPU that torch can use"):
        run(monkeypatch, check_gpu)


@pytest.mark.slow
def test_the_check_of_a_gpu_measures(monkeypatch):
    from benchmarks import check_gpu

    row = check_gpu.gradient_step("TD3", 0.0, "cpu")
    assert row["SB3 / graphs"] == pytest.approx(row["SB3 us"] / row["graphs us"])
    for name in check_gpu.TRAININGS:
        row = check_gpu.training(name, 0.5, "cpu")
        assert row["steps"] > 0 and row["steps/s"] > 0


def test_the_check_of_a_gpu_reports_failures(monkeypatch, tmp_path, capsys):
    from benchmarks import check_gpu

    (tmp_path / "test_it.py").write_text("def test_good(): pass\ndef test_bad(): assert 0\n")
    monkeypatch.setattr(check_gpu, "TESTS", tmp_path / "test_it.py")
    monkeypatch.setattr(check_gpu.th.cuda, "is_available", lambda: True)
    monkeypatch.setattr(check_gpu.th.cuda, "get_device_name", lambda: "Some GPU")
    monkeypatch.setattr(check_gpu, "gradient_step", lambda *args: {"gradient step": args[0]})
    monkeypatch.setattr(check_gpu, "training", lambda *args: {"training": args[0], "steps/s": 2.0})
    with pytest.raises(SystemExit, match="Not passed: test_bad"):
        run(monkeypatch, check_gpu)
    results = common.read("check_gpu")
    assert results["checks"] == {"test_good": "passed", "test_bad": "failed"}
    assert [row["of SB3's"] for row in results["trainings"]] == [1.0] * 5
    assert "| test_bad | failed |" in capsys.readouterr().out
