"""``sb3-mcbs doctor``: what it finds out, and what it says about it."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_mcbs import save_statistics
from sb3_mcbs.doctor import command, questions, report
from sb3_mcbs.doctor.child import Examination, Request
from sb3_mcbs.doctor.isolation import Findings, examine
from sb3_mcbs.zoo import environments
from tests.agent_files import save_agent
from tests.doctor_envs import Ball
from tests.zoo_helpers import TINY, zoo_train

ENVS = Path(__file__).with_name("doctor_envs.py")


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(questions, "MEASURED", 0.02)
    monkeypatch.setattr(questions, "LAYERS", [16])
    monkeypatch.setattr(sys, "path", [*sys.path])


def request(environment: str, *wrappers: str, **changes: Any) -> Request:
    return Request(environment, [*wrappers], None, None, False, 1, 30.0)._replace(**changes)


def findings(environment: str, *wrappers: str, **changes: Any) -> dict[str, Any]:
    """What an examination in this process finds out."""
    collected = Findings(lambda stage: None)
    examination = Examination(
        request(environment, *wrappers, **changes),
        lambda message: collected.add(json.loads(json.dumps(message))),
    )
    examination.run()
    assert collected.ended
    return collected.found


def text(found: dict[str, Any], environment: str, *wrappers: str) -> str:
    """The whole report."""
    return "\n".join(report.lines(found, environment, report.block(found, environment, [*wrappers])))


def settings(found: dict[str, Any], environment: str, *wrappers: str) -> dict[str, Any]:
    """The entry to paste."""
    block = report.block(found, environment, [*wrappers])
    assert block is not None
    (entry,) = yaml.safe_load(block).values()
    return dict(entry)


def test_an_environment_of_mujoco_is_exact_and_fast() -> None:
    found = findings("HalfCheetah-v5")
    assert report.verdict(found) == report.EXACT_AND_FAST
    assert found["snapshot"]["steps_compared"] >= 300
    assert found["snapshot"]["captured_by"][1] == "MjDataAdapter (MuJoCo's data)"
    assert found["forward_model"]["kind"] == "mujoco" and found["forward_model"]["why_not_faster"] == ""
    assert found["environment"]["control_period"] == pytest.approx(0.05)
    steps = {cost["preset"]: cost["simulated_steps"] for cost in found["costs"]}
    assert list(steps) == ["paper", "efficient", "balanced", "strong"]
    assert steps["efficient"] == 18 and steps["strong"] == 576
    said = text(found, "HalfCheetah-v5")
    assert "Look-ahead works: exact and fast." in said and "-conf may be left out" in said
    assert all(len(line) <= 80 for line in said.splitlines())


def test_wrappers_decide_what_simulates_and_are_in_the_block(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "FAST", 1e-6)
    names = ("Reacher-v5", "gymnasium.wrappers.FlattenObservation")
    found = findings(*names)
    assert report.verdict(found) == report.SLOW
    assert "FlattenObservation may change observations" in found["forward_model"]["why_not_faster"]
    assert settings(found, *names)["env_wrapper"] == [names[1], "sb3_mcbs.SnapshotEnvWrapper"]
    said = text(found, *names)
    assert "Look-ahead is exact, but slow." in said and "may be left out" not in said


def test_what_costs_too_much_is_not_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    found = findings(f"{ENVS}:Ball")
    entry = settings(found, f"{ENVS}:Ball")
    assert (entry["preset"], entry["search_share"]) == ("efficient", 0.5)
    monkeypatch.setattr(report, "AFFORDABLE", 1e-6)
    assert settings(found, f"{ENVS}:Ball")["rollout_depth"] == 0


def test_a_decision_that_would_take_too_long_is_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_mcbs.doctor.child.MOST_SECONDS", 1e-9)
    found = findings(f"{ENVS}:Ball")
    assert ["too_slow" in cost for cost in found["costs"]] == [False, True, True, True]
    assert report.verdict(found) == report.SLOW and "not measured: about 0 s" in text(found, f"{ENVS}:Ball")


def test_random_dynamics_are_exact_but_some_presets_are_not_for_them() -> None:
    found = findings(f"{ENVS}:Windy")
    assert "problem" not in found and not found["forward_model"]["deterministic"]
    assert ["unsuitable" in cost for cost in found["costs"]] == [False, False, True, True]
    assert settings(found, f"{ENVS}:Windy")["n_simulations"] == 5
    assert "random: every simulation draws" in text(found, f"{ENVS}:Windy")


def test_observations_of_several_parts() -> None:
    names = ("Pendulum-v1", "tests.conftest.DictPendulum")
    found = findings(*names)
    assert found["environment"]["observations"] == "Dict of angle, speed" and len(found["costs"]) == 4
    assert settings(found, *names)["policy"] == "MultiInputPolicy"


def test_box2d_replays_the_episode_so_nothing_is_simulated_in_the_block() -> None:
    pytest.importorskip("Box2D")
    found = findings("LunarLanderContinuous-v3")
    assert found["snapshot"]["replays"] and settings(found, "LunarLanderContinuous-v3")["rollout_depth"] == 0


@pytest.mark.parametrize(
    ("name", "stage", "says"),
    [
        ("Discrete", "looking at the actions", "look-ahead is for continuous actions"),
        ("Unbounded", "looking at the actions", "RescaleAction"),
        ("Broken", "stepping the environment", "KeyError: 'joint_7' (doctor_envs.py, line"),
        ("Robot", "taking snapshots", "Robot.connection cannot be part of a snapshot"),
        ("Forgetful", "taking snapshots", "step 1 of Forgetful gave reward"),
        ("nothing", "making the environment", "returned None instead of a gymnasium.Env"),
        ("missing", "making the environment", "has no function 'missing'"),
    ],
)
def test_what_is_wrong_is_said(name: str, stage: str, says: str) -> None:
    found = findings(f"{ENVS}:{name}")
    assert report.verdict(found) == report.DOES_NOT_WORK
    assert found["stage"] == stage and says in found["problem"]
    assert ("rollout_depth: 0" in text(found, f"{ENVS}:{name}")) == (stage == "taking snapshots")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("HalfCheeta-v5", "Did you mean: `HalfCheetah`? Those of another package are found as module:"),
        ("no_such_module:X-v0", "No module named 'no_such_module'"),
        ("nowhere.py:make", "There is no file nowhere.py"),
    ],
)
def test_an_unknown_environment(name: str, says: str) -> None:
    found = findings(name)
    assert says in found["problem"] and "The environment cannot be made." in text(found, name)


def test_a_file_that_is_no_python(tmp_path: Path) -> None:
    (tmp_path / "wrong.py").write_text("import os\ndef make(:\n")
    assert "wrong.py, line 2: invalid syntax" in findings(f"{tmp_path}/wrong.py:make")["problem"]
    (tmp_path / "failing.py").write_text("import os\n1 / 0\n")
    problem = findings(f"{tmp_path}/failing.py:make")["problem"]
    assert "ZeroDivisionError: division by zero (failing.py, line 2)" in problem


def test_unknown_wrappers() -> None:
    assert "Write each as module.Class" in findings("Pendulum-v1", "no_such_module.Wrapper")["problem"]


@pytest.fixture
def agent(make_agent: Any, tmp_path: Path) -> Path:
    """A TD3 agent for the ball, with statistics beside it."""
    env = DummyVecEnv([Ball])
    _, path = save_agent(make_agent, tmp_path, env=env)
    normalizer = VecNormalize(env, norm_reward=False)
    normalizer.reset()
    save_statistics(normalizer, tmp_path / "statistics.npz")
    return path


def test_an_agent_plays_alone_and_with_search(agent: Path) -> None:
    statistics = environments.statistics_beside(agent)
    assert statistics == agent.with_name("statistics.npz")
    found = findings(f"{ENVS}:Ball", agent=str(agent), statistics=str(statistics))
    assert [policy["policy"] for policy in found["episodes"]] == ["actor alone", "efficient", "balanced"]
    simulated = [policy["episodes"][0]["simulated_steps"] for policy in found["episodes"]]
    # 20 steps; at the last two, rollouts end with the episode.
    assert simulated == [0, 18 * 18 + 12 + 6, 18 * 108 + 72 + 36]
    assert settings(found, f"{ENVS}:Ball")["normalize"] == "{'norm_obs': True, 'norm_reward': False}"
    assert f"normalized with {statistics}" in text(found, f"{ENVS}:Ball").replace("\n" + " " * 15, " ")


def test_there_is_a_limit_to_the_time_that_episodes_take(agent: Path) -> None:
    found = findings(f"{ENVS}:Ball", agent=str(agent), seconds=1e-9)
    assert len(found["episodes"]) == 1 and len(found["not_played"]) == 2
    assert "balanced     not played" in text(found, f"{ENVS}:Ball")


def test_an_agent_of_another_environment(agent: Path) -> None:
    found = findings("Pendulum-v1", agent=str(agent))
    assert found["stage"] == "loading the agent" and "Is it the environment" in found["problem"]
    assert "The agent cannot be used." in text(found, "Pendulum-v1")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("Crashing", "crashed with SIGSEGV. It was in step ("),
        ("Exiting", "ended with exit status 0. Its last output: the robot is gone"),
    ],
)
def test_the_doctor_outlives_its_patient(name: str, says: str) -> None:
    stages: list[str] = []
    found = examine(request(f"{ENVS}:{name}"), 60, stages.append)
    assert says in found["problem"] and stages[-1] == found["stage"] == "stepping the environment"
    assert report.verdict(found) == report.DOES_NOT_WORK


def test_the_doctor_does_not_wait_forever() -> None:
    found = examine(request(f"{ENVS}:Hanging"), 2, lambda stage: None)
    assert "did not come back within 2 seconds. It was in step (" in found["problem"]


def test_the_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(command, "examine", lambda request, limit, on_stage: findings(*request[:1]))
    monkeypatch.setattr(sys, "argv", ["sb3-mcbs doctor", "CartPole-v1", "--json"])
    with pytest.raises(SystemExit) as ended:
        command.main()
    said = json.loads(capsys.readouterr().out)
    assert ended.value.code == said["status"] == 2 and said["hyperparameters"] is None
    assert "Discrete(2)" in said["problem"]


def test_a_pickle_needs_trust(
    agent: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    agent.with_name("statistics.npz").rename(agent.with_name("vecnormalize.pkl"))
    monkeypatch.setattr(sys, "argv", ["sb3-mcbs doctor", f"{ENVS}:Ball", "--agent", str(agent)])
    with pytest.raises(SystemExit) as ended:
        command.main()
    assert ended.value.code == 2 and "say so with --trusted" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "wrappers", "env_id", "words"),
    [
        ("HalfCheetah-v5", (), "HalfCheetah-v5", ()),
        ("Pendulum-v1", ("gymnasium.wrappers.FlattenObservation",), "Pendulum-v1", ()),
        (f"{ENVS}:Ball", (), "Ball-v0", ("--gym-packages", "doctor_envs")),
        ("doctor_envs:Ball-v0", ("doctor_envs.Mirror",), "Ball-v0", ("--gym-packages", "doctor_envs")),
        (f"{ENVS}:Forgetful", (), "Forgetful-v0", ("--gym-packages", "doctor_envs")),
    ],
)
def test_rl_zoo_trains_with_the_block(
    name: str,
    wrappers: tuple[str, ...],
    env_id: str,
    words: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.syspath_prepend(ENVS.parent)
    block = report.block(findings(name, *wrappers), name, [*wrappers])
    assert block is not None and " ".join(["--algo mcbs_crossq --env", env_id]) in block
    assert all(word in block for word in words)
    (tmp_path / "doctor.yml").write_text(block)
    words = ("-conf", "doctor.yml", "-n", "150", "--eval-freq", "-1", *words, "-params", *TINY)
    zoo_train(monkeypatch, tmp_path, "mcbs_crossq", *words, env=env_id)
    assert "Trained for 150 environment steps" in capsys.readouterr().out
