"""The benchmarks still run, small, and count what they say that they count."""

import json

import numpy as np
import pytest

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def results_elsewhere(monkeypatch, tmp_path):
    from benchmarks import common, memory, scaling, search, training

    for module in (common, memory, scaling, search, training):
        monkeypatch.setattr(module, "RESULTS", tmp_path)


def test_search(tmp_path):
    from benchmarks import search

    result = search.measure("HalfCheetah-v5", (3, 2, 2), 0.1)
    assert result["simulated steps"] == 3 + 6
    search.draw([result])
    assert (tmp_path / "search.png").stat().st_size > 0


def test_the_recorded_products_are_those_of_the_search():
    from benchmarks.search import Decision

    decision = Decision("HalfCheetah-v5", (3, 2, 2))
    rows = [len(left) for left, *_ in decision.products[0][::3]]
    # The actor at the root, after the first step (shared by simulations), after the second; both critics.
    assert rows == [1, 3, 6, 6, 6]
    assert [len(states) for states in decision.states] == [3, 6]


def test_training(tmp_path, monkeypatch):
    from benchmarks import training

    arms = ("SB3 TD3", "SB3 TD3, our update", "MCBSTD3 (6,3,1)", "the usual way (6,3,5)")
    results = training.measure("HalfCheetah-v5", arms, 1, rounds=2, steps=5, sbx_python=None)
    assert [result["arm"] for result in results] == list(arms)
    assert results[0]["/ SB3 TD3"] == pytest.approx(1)
    assert {"simulate", "networks in search", "gradient"} <= results[2]["ms per step"].keys()
    training.draw(results)
    assert (tmp_path / "training.png").stat().st_size > 0


def test_scaling_and_memory_and_deadline(monkeypatch):
    from benchmarks import common, deadline, memory, scaling

    monkeypatch.setitem(scaling.VARIED, "beam_width", (2, 4))
    results = scaling.measure("HalfCheetah-v5", "beam_width", 0.1)
    assert [result["simulated steps"] for result in results] == [22, 44]
    assert np.isfinite(scaling.exponent(results))
    scaling.draw("HalfCheetah-v5", [{**result, "exponent": 1.0} for result in results])
    agent = memory.make_agent("Pendulum-v1")
    assert len(memory.over_decisions(agent, 10, 5)) == 3
    assert len(memory.over_training(agent, 10, 5)) == 3
    assert deadline.measure("Pendulum-v1", 0.05, 20)["candidates"] > 0
    path = common.write("nothing", [1.5])
    assert json.loads(path.read_text())["results"] == [1.5]


def test_learned_model(monkeypatch, tmp_path):
    from benchmarks import common, learned_model

    monkeypatch.setattr(common, "RESULTS", tmp_path)
    monkeypatch.setattr(learned_model, "EPISODES", 1)
    arguments = "learned --env Pendulum-v1 --steps 620 --learning-starts 520 --max-error 2"
    monkeypatch.setattr("sys.argv", ["learned_model", *arguments.split()])
    learned_model.main()
    (path,) = tmp_path.glob("learned_model-Pendulum-v1-learned-0.json")
    results = json.loads(path.read_text())["results"]
    assert results["decisions searched"] == 99 and results["held-out error"] < 2
    assert set(results["returns"]) == {"actor", "search, ensemble"}
    errors = [row["observation error"] for row in results["error over horizon"]]
    assert len(errors) == 5 and errors[0] < errors[-1]
