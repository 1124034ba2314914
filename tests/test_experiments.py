"""Experiments that are stopped, killed, crash, meet one another, and go on."""

import io
import os
import platform
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from rich.console import Console
from stable_baselines3 import TD3 as TD3Agent
from stable_baselines3.common.env_util import make_vec_env

from sb3_mcbs.agents.episodes import play
from sb3_mcbs.experiments import command, expand, read_spec
from sb3_mcbs.experiments.display import Display
from sb3_mcbs.experiments.engine import ATTEMPTS, Engine
from sb3_mcbs.experiments.process import Process
from sb3_mcbs.experiments.results import ResultsError, RunFolder, prepare
from tests.experiment_helpers import (
    MCBS,
    SPEC,
    TD3,
    assert_equal,
    begin,
    final,
    folder_of,
    kill,
    read_until,
    run,
    spec_file,
    trainers_of,
    wait_for,
)
from tests.zoo_helpers import evaluations

NAMES = (TD3, MCBS)
linux_only = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of two runs that nobody disturbed."""
    folder = tmp_path_factory.mktemp("undisturbed")
    status, text = run(spec_file(folder), folder / "results")
    assert status == 0, text
    assert "2 runs, 0 of them finished before" in text and "2 finished" in text
    return folder


def test_both_policies_of_a_run_in_the_same_episodes(undisturbed: Path) -> None:
    td3, mcbs = (final(folder_of(undisturbed / "results", name)) for name in NAMES)
    assert {name.split(".")[0] for name in mcbs if name.endswith("results")} == {"mcbs_td3", "mcbs_td3_actor"}
    assert "td3_search.results" not in td3
    assert mcbs["mcbs_td3.timesteps"].tolist() == td3["td3.timesteps"].tolist() == [200, 400]
    assert mcbs["mcbs_td3.seeds"].tolist() == td3["td3.seeds"].tolist() == [10_000, 10_001]
    assert mcbs["mcbs_td3.ep_lengths"].tolist() == [[200, 200], [200, 200]]
    assert mcbs["mcbs_td3.simulated_steps"].tolist() == [200, 600]
    assert td3["td3.simulated_steps"].tolist() == [0, 0]
    assert (mcbs["mcbs_td3.results"] != mcbs["mcbs_td3_actor.results"]).all()


def test_a_run_folder_says_what_it_is(undisturbed: Path) -> None:
    folder = folder_of(undisturbed / "results", MCBS)
    assert folder.run() == expand(read_spec(undisturbed / "tiny.yml"))[1]
    assert (undisturbed / "results" / "spec.yml").read_text() == (undisturbed / "tiny.yml").read_text()
    assert folder.status["state"] == "finished" and folder.status["crashes"] == 0
    assert [machine["python"] for machine in folder.machines] == [platform.python_version()]
    assert folder.machines[0]["torch"].startswith("2.") and socket.gethostname() not in str(folder.machines)
    assert folder.progress["step"] == 400 and set(folder.progress["returns"]) == {"actor", "search"}
    assert "Actor with search after 400 steps" in folder.log.read_text()
    assert not (folder.training(folder.run()) / "checkpoints").exists()


def test_what_is_finished_is_left_alone_and_runs_may_be_added(undisturbed: Path, tmp_path: Path) -> None:
    results = undisturbed / "results"
    before = {path: path.stat().st_mtime_ns for path in (results / "runs").rglob("*.zip")}
    arms = {**SPEC["arms"], "ppo": {"algorithm": "ppo", "params": {"n_steps": 64, "n_envs": 2}}}
    status, text = run(spec_file(tmp_path, arms=arms), results)
    assert status == 0 and "3 runs, 2 of them finished before" in text, text
    after = {path: path.stat().st_mtime_ns for path in (results / "runs").rglob("*.zip")}
    assert len(after) == 3 and before.items() <= after.items()
    assert final(folder_of(results, "ppo_Pendulum-v1_0"))["ppo.timesteps"].tolist() == [200, 400]


def test_a_trained_agent_alone_and_with_search(undisturbed: Path, tmp_path: Path) -> None:
    trained = folder_of(undisturbed / "results", TD3)
    agent = trained.training(trained.run()) / "Pendulum-v1.zip"
    search = {"policy": "search", "params": {"beam_width": 2, "rollout_depth": 1, "n_simulations": 1}}
    spec = {
        "agents": {"td3": {"file": str(agent), "environment": "Pendulum-v1"}},
        "seeds": [0],
        "evaluation": {"episodes": 2},
        "arms": {"actor": {"policy": "actor"}, "search": search},
    }
    (tmp_path / "frozen.yml").write_text(yaml.safe_dump(spec, sort_keys=False))
    status, text = run(tmp_path / "frozen.yml", tmp_path / "results")
    assert status == 0 and "2 of 2 episodes, search -" in text, text
    alone, searched = (
        evaluations(folder.training(folder.run()))
        for folder in (folder_of(tmp_path / "results", f"{name}_td3_0") for name in ("actor", "search"))
    )
    env = make_vec_env("Pendulum-v1")
    expected = [play(TD3Agent.load(agent), env, seed).total for seed in (10_000, 10_001)]
    assert alone["results"].tolist() == [expected]
    assert alone["seeds"].tolist() == searched["seeds"].tolist() == [10_000, 10_001]
    assert (alone["simulated_steps"], searched["simulated_steps"]) == ([0], [2 * 2 * 200])
    assert (alone["results"] != searched["results"]).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 800}, "td3_Pendulum-v1_0: steps was 400, is 800. Runs may be added"),
        ({"evaluation": {"every": 100, "episodes": 2}}, "evaluation.every was 200, is 100"),
        ({"arms": {"td3": SPEC["arms"]["td3"]}}, "it has the run mcbs_td3_Pendulum-v1_0, which the spec"),
        (
            {"arms": {**SPEC["arms"], "td3": {"algorithm": "td3", "params": {"gamma": 0.5}}}},
            "params.gamma was 'not there', is 0.5",
        ),
    ],
)
def test_another_spec_is_refused(changes: dict, message: str, tmp_path: Path) -> None:
    spec = read_spec(spec_file(tmp_path))
    prepare(tmp_path / "results", spec, expand(spec))
    other = read_spec(spec_file(tmp_path / "other", **changes))
    with pytest.raises(ResultsError, match=message):
        prepare(tmp_path / "results", other, expand(other))
    assert (tmp_path / "results" / "spec.yml").read_text() == spec.text


def test_a_broken_definition_of_a_run_is_named(tmp_path: Path) -> None:
    spec = read_spec(spec_file(tmp_path))
    folder = prepare(tmp_path / "results", spec, expand(spec))[0]
    folder.definition.write_text("a: [")
    with pytest.raises(ResultsError, match=r"run.yml cannot be read. Remove .* to begin this run again"):
        prepare(tmp_path / "results", spec, expand(spec))


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    for place in ("file", "file/results"):
        monkeypatch.setattr(sys, "argv", ["sb3-mcbs experiment", "smoke", "-o", str(tmp_path / place)])
        with pytest.raises(SystemExit, match=f"{place} cannot be written: .*--output"):
            command.main()


def test_the_command_checks_and_chooses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = spec_file(tmp_path)

    def say(*words: str) -> object:
        monkeypatch.setattr(sys, "argv", ["sb3-mcbs experiment", str(spec), *words])
        try:
            return command.main()
        except SystemExit as stopped:
            return stopped.code

    assert say("--check", "--only", "mcbs", "-o", str(tmp_path / "results")) is None
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(f"{MCBS}: mcbs_td3, 400 steps, hyperparameters of mcbs_td3.yml: Pendulum-v1 with")
    assert not (tmp_path / "results").exists()
    say("--check", "--only", TD3)  # which is a part of the other's name
    assert [line.partition(":")[0] for line in capsys.readouterr().out.splitlines()] == [TD3]
    assert f"no run has such a name; the runs are {TD3}, {MCBS}." in str(say("--only", "sac*"))
    spec.write_text(spec.read_text().replace("steps: 400", "steps: none"))
    assert str(say("--check")).startswith(f"sb3-mcbs experiment: {spec}, line 5: steps: must be an integer")


def has_a_checkpoint(folder: RunFolder, step: int = 100) -> bool:
    checkpoints = folder.training(folder.run()) / "checkpoints"
    return any(int(path.name.split("_")[1]) >= step for path in checkpoints.glob("step_*[0-9]"))


@linux_only
def test_killed_runs_and_a_killed_runner_end_as_if_nothing_had_happened(
    undisturbed: Path, tmp_path: Path
) -> None:
    spec, results = spec_file(tmp_path), tmp_path / "results"
    td3, mcbs = (folder_of(results, name) for name in NAMES)
    runner = begin(spec, results)
    # One run is killed, which the runner sees; then the runner itself, in the middle of the other.
    wait_for(lambda: td3.definition.is_file() and has_a_checkpoint(td3))
    kill(td3)
    read_until(runner, f" {TD3}: ended with status -9, trying again after attempt 1 of 3")
    wait_for(lambda: has_a_checkpoint(mcbs))
    runner.kill()
    runner.communicate(timeout=60)
    wait_for(lambda: not trainers_of(td3) and not trainers_of(mcbs), 10)
    assert "finished" not in (td3.status["state"], mcbs.status["state"])
    status, text = run(spec, results)
    assert status == 0 and f"{MCBS}: goes on" in text, text
    for name in NAMES:
        assert_equal(folder_of(results, name), folder_of(undisturbed / "results", name))
        assert "Resumed at" in folder_of(results, name).log.read_text()


@linux_only
def test_a_run_ends_with_its_runner_from_its_first_moment_on(tmp_path: Path) -> None:
    """Also while it imports, when nothing of this package is there yet to see to it."""
    code = (
        "import sys, time; from pathlib import Path; from sb3_mcbs.experiments.job import Job;"
        "from sb3_mcbs.experiments.process import Process;"
        "from sb3_mcbs.experiments.results import RunFolder; folder = RunFolder(Path(sys.argv[1]));"
        "folder.lock.take(); Job(folder).start(lambda folder: Process(folder, ['sleep', '60']));"
        "print('started', flush=True); time.sleep(60)"
    )
    spec = read_spec(spec_file(tmp_path))
    folder = prepare(tmp_path / "results", spec, expand(spec))[0]
    parent = subprocess.Popen(
        [sys.executable, "-c", code, str(folder.path)], stdout=subprocess.PIPE, text=True
    )
    read_until(parent, "started")
    assert not folder.lock.take()
    parent.kill()
    parent.communicate()
    wait_for(folder.lock.take, 2)


@linux_only
@pytest.mark.parametrize("signum", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_signal_stops_all_runs_after_a_checkpoint(
    signum: signal.Signals, undisturbed: Path, tmp_path: Path
) -> None:
    spec, results = spec_file(tmp_path), tmp_path / "results"
    mcbs = folder_of(results, MCBS)
    runner = begin(spec, results, "--only", "mcbs")
    wait_for(lambda: mcbs.definition.is_file() and has_a_checkpoint(mcbs))
    runner.send_signal(signum)
    text, _ = runner.communicate(timeout=60)
    assert runner.returncode == 130 and f"{MCBS}: stopped at" in text, text
    assert mcbs.status["state"] == "interrupted" and not trainers_of(mcbs)
    assert (mcbs.training(mcbs.run()) / "checkpoints" / "interrupted.json").is_file()
    status, text = run(spec, results, "--only", "mcbs")
    assert status == 0, text
    assert_equal(mcbs, folder_of(undisturbed / "results", MCBS))


@linux_only
@pytest.mark.slow
def test_an_algorithm_without_checkpoints_begins_again(tmp_path: Path) -> None:
    ppo = {"ppo": {"algorithm": "ppo", "params": {"n_steps": 64, "n_envs": 2}}}
    spec = spec_file(tmp_path, arms=ppo, steps=2000)
    assert run(spec, tmp_path / "calm")[0] == 0
    killed, calm = (folder_of(tmp_path / name, "ppo_Pendulum-v1_0") for name in ("killed", "calm"))
    runner = begin(spec, tmp_path / "killed")
    wait_for(lambda: killed.progress.get("evaluations"))
    kill(killed)
    text, _ = runner.communicate(timeout=120)
    assert runner.returncode == 0 and text.count("ppo_Pendulum-v1_0: started") == 2, text
    assert_equal(killed, calm)


@linux_only
def test_two_runners_never_train_the_same_run(undisturbed: Path, tmp_path: Path) -> None:
    spec, results = spec_file(tmp_path), tmp_path / "results"
    runners = [begin(spec, results, "--jobs", "2") for _ in range(2)]
    texts = [runner.communicate(timeout=120)[0] for runner in runners]
    for name in NAMES:
        assert sum(f" {name}: started" in text for text in texts) == 1, texts
        assert sum(f" {name}: finished" in text for text in texts) == 1, texts
        assert_equal(folder_of(results, name), folder_of(undisturbed / "results", name))
    # One runner has both runs, or each has one; who is left without work says so.
    assert 0 in [runner.returncode for runner in runners] or all("to process" in text for text in texts)


def engine(tmp_path: Path, code: str, *words: str) -> tuple[Engine, Console]:
    """One run, in whose place a line of Python is executed."""
    spec = read_spec(spec_file(tmp_path, arms={"td3": SPEC["arms"]["td3"]}))
    folders = prepare(tmp_path / "results", spec, expand(spec))
    console = Console(record=True, width=200, file=io.StringIO())
    script = (
        "import sys; from pathlib import Path; folder = Path(sys.argv[1]); status = folder / 'status.json'\n"
    )

    def launch(folder: RunFolder) -> Process:
        return Process(folder, [sys.executable, "-c", script + code, str(folder.path), *words])

    return Engine(folders, 1, Display(console), launch, grace=0.5), console


FINISH = 'status.write_text(\'{"state": "finished"}\')'


def test_what_crashes_is_tried_again_and_then_given_up(tmp_path: Path) -> None:
    crashing, console = engine(tmp_path, "print('no memory'); sys.exit(7)")
    assert crashing.finish() == 1
    text = console.export_text()
    assert f"{TD3}: ended with status 7, trying again after attempt 1 of 3" in text
    assert f"{TD3}: ended with status 7, given up after attempt 3 of 3" in text
    assert text.count("    no memory") >= ATTEMPTS and "1 failed" in text
    (job,) = crashing.jobs
    assert job.folder.status["state"] == "failed" and job.folder.status["exit_status"] == 7
    assert job.folder.log.read_text().count("no memory\n") == ATTEMPTS

    # The same command tries again, and this time it goes well.
    once = f"n = folder / 'n'; first = not n.exists(); n.touch(); {FINISH} if not first else sys.exit(1)"
    mended, _ = engine(tmp_path, once)
    assert mended.finish() == 0
    assert mended.jobs[0].folder.status["state"] == "finished"


def test_a_process_that_ends_without_finishing_has_crashed(tmp_path: Path) -> None:
    ending, _ = engine(tmp_path, "pass")
    assert ending.finish() == 1 and ending.jobs[0].crashes == ATTEMPTS


def test_what_another_runner_holds_is_left_to_it(tmp_path: Path) -> None:
    ours, console = engine(tmp_path, FINISH)
    other = RunFolder(ours.jobs[0].folder.path)
    assert other.lock.take() and not ours.jobs[0].folder.lock.take()
    assert ours.finish() == 1
    assert (
        f"{TD3}: left to process {os.getpid()} on {socket.gethostname()}, which trains it"
        in console.export_text()
    )
    other.lock.give_back()
    free, _ = engine(tmp_path, FINISH)
    assert free.finish() == 0


def test_a_second_signal_kills(tmp_path: Path) -> None:
    stubborn = (
        "import os, signal, time; signal.signal(signal.SIGTERM, lambda *_: os.kill(int(sys.argv[2]), 2));"
        "os.kill(int(sys.argv[2]), 2); time.sleep(60)"
    )
    runner, _ = engine(tmp_path, stubborn, str(os.getpid()))
    assert runner.finish() == 130
    assert runner.jobs[0].exit_status == -signal.SIGKILL
    assert runner.jobs[0].folder.status["state"] == "interrupted"


def test_the_table_of_a_terminal(tmp_path: Path, undisturbed: Path) -> None:
    spec = read_spec(undisturbed / "tiny.yml")
    folders = [folder_of(undisturbed / "results", run.name) for run in expand(spec)]
    runner = Engine(folders, 1, Display(Console(force_terminal=True, width=150, record=True)))
    with runner.display.of(runner.jobs):
        runner.display.refresh()
    text = runner.display.console.export_text()
    assert "per s" in text and "400 / 400" in text and "actor -" in text


def test_specs_of_other_names_have_folders_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "twice.yml").write_text(
        yaml.safe_dump({**SPEC, "algorithms": ["ppo"], "environments": ["Pendulum-v1"]})
    )
    names = [run.name for run in expand(read_spec(tmp_path / "twice.yml"))]
    assert len(names) == len(set(names)) == 3
