"""Tuning with several seeds per trial and on several machines: kept agents, killed workers, servers."""

import argparse
import os
import pickle
import shutil
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.trial import TrialState
from stable_baselines3 import TD3

from sb3_mcbs.zoo import train, tuning
from sb3_mcbs.zoo.manager import MCBSExperimentManager
from tests.zoo_helpers import TINY, zoo_train

DATABASE = "sqlite:///study.db"
WORDS = ["-optimize", "-n", "120", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots",
         "--study-name", "tiny", "--num-threads", "1", "--sampler", "random", "--seed", "3"]  # fmt: skip


@pytest.fixture
def tune(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., optuna.Study]:
    """Tune TD3's learning rate."""
    from rl_zoo3 import exp_manager

    def sample(trial: optuna.Trial, *_: Any) -> dict[str, Any]:
        return {"learning_rate": trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True)}

    monkeypatch.setitem(exp_manager.HYPERPARAMS_SAMPLER, "td3", sample)

    def run(*words: str, storage: str = DATABASE, params: tuple[str, ...] = ()) -> optuna.Study:
        zoo_train(
            monkeypatch, tmp_path, "td3", *WORDS, "--storage", storage, *words, "-params", *TINY, *params
        )
        return optuna.load_study(study_name="tiny", storage=tuning.open_storage(storage))

    return run


def test_objective_pools_the_last_evaluations_of_all_seeds(tune: Callable[..., optuna.Study]) -> None:
    words = ["--n-trials", "1", "--trial-seeds", "3", "--trial-objective", "iqm", "--pruner", "none"]
    trial = tune(*words, "--n-evaluations", "2", "--eval-episodes", "2").trials[0]
    returns = np.array(trial.user_attrs["returns"])
    assert returns.shape == (3, 2, 2), "seeds, evaluations, episodes"
    assert len(np.unique(returns)) == returns.size, "each training has a seed of its own"
    assert len(set(trial.user_attrs["seeds"])) == 3
    assert trial.value == pytest.approx(np.sort(returns[:, 1].ravel())[1:-1].mean())
    assert (
        trial.intermediate_values
        == pytest.approx(
            {
                1: returns[0, 0].mean(),  # of two episodes, no quarter is cut
                2: returns[0, 1].mean(),
                3: np.sort(returns[:2, 1].ravel())[1:-1].mean(),
                4: trial.value,
            }
        )
    )

    again = tune(*words, "--n-evaluations", "2", "--eval-episodes", "2", storage="other.log").trials[0]
    assert again.user_attrs["returns"] == trial.user_attrs["returns"], "the seeds decide"


def test_one_seed_is_rl_zoos_trial(tune: Callable[..., optuna.Study]) -> None:
    trial = tune("--n-trials", "1", "--eval-episodes", "2").trials[0]
    assert np.shape(trial.user_attrs["returns"]) == (1, 1, 2)
    assert trial.value == np.mean(trial.user_attrs["returns"])
    assert trial.intermediate_values == {1: trial.value}
    assert "seeds" not in trial.user_attrs


def test_trials_are_pruned_between_seeds(
    tune: Callable[..., optuna.Study], monkeypatch: pytest.MonkeyPatch
) -> None:
    pruner = optuna.pruners.ThresholdPruner(lower=0.0, n_warmup_steps=2)
    monkeypatch.setattr(MCBSExperimentManager, "_create_pruner", lambda self, method: pruner)
    # RL Zoo prints the best trial, and there is none.
    monkeypatch.setattr(optuna.Study, "best_trial", property(lambda study: study.trials[0]))
    trial = tune("--n-trials", "1", "--trial-seeds", "3").trials[0]
    assert trial.state == TrialState.PRUNED
    assert len(trial.user_attrs["returns"]) == 2, "the third seed is not trained"


def test_interquartile_mean() -> None:
    assert tuning.interquartile_mean(np.array([100.0, 1.0, 3.0, -50.0])) == 2.0
    assert tuning.interquartile_mean(np.array([1.0, 2.0, 9.0])) == 4.0
    assert np.isnan(tuning.interquartile_mean(np.array([np.nan, 1.0, 3.0, -50.0])))


def test_agents_of_the_best_trials_are_kept(tune: Callable[..., optuna.Study], tmp_path: Path) -> None:
    words = ["--n-trials", "3", "--trial-seeds", "2", "--pruner", "none", "--optimization-log-path", "agents"]
    study = tune(*words, "--keep-trials", "1", params=("normalize:True",))
    best = study.best_trial
    folder = tmp_path / "agents" / f"trial_{best.number}"
    assert len(study.trials) == 3
    assert [path.name for path in (tmp_path / "agents").iterdir()] == [folder.name]
    assert best.user_attrs["folder"] == str(folder)
    for seed in ("seed_0", "seed_1"):
        assert TD3.load(folder / seed / "best_model.zip").num_timesteps == 120
        statistics = pickle.loads((folder / seed / "vecnormalize.pkl").read_bytes())
        assert statistics.obs_rms.count > 120
        assert (folder / seed / "evaluations.npz").exists()


def test_other_studies_agents_are_not_deleted(tmp_path: Path) -> None:
    study = optuna.create_study(direction="maximize")
    for number, value in enumerate([1.0, 3.0, 2.0]):
        trial = study.ask()
        folder = tuning.trial_folder(str(tmp_path), number)
        Path(folder).mkdir()
        # As if the first trial of this study had not been trained here.
        trial.set_user_attr(tuning.FOLDER, folder if number else "/elsewhere")
        study.tell(trial, value)
    tuning.delete_agents(study, str(tmp_path), 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["trial_0", "trial_1"]


def lose_a_trial(tmp_path: Path, age: int) -> dict[str, Any]:
    """Begin a trial as a worker does that is killed then. Its last heartbeat is ``age`` seconds old."""
    storage = tuning.open_storage(f"sqlite:///{tmp_path / 'study.db'}", heartbeat=1)
    study = optuna.create_study(storage=storage, study_name="tiny", direction="maximize")
    trial = study.ask()
    trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True)
    trial.set_user_attr(tuning.SEEDS, [11, 12])
    trial.set_user_attr(tuning.RETURNS, [[[-1.0]]])
    study._storage.record_heartbeat(trial._trial_id)  # type: ignore[attr-defined]
    study._storage.remove_session()
    with sqlite3.connect(tmp_path / "study.db") as connection:
        connection.execute("update trial_heartbeats set heartbeat = datetime('now', ?)", (f"-{age} seconds",))
    return dict(trial.params)


@pytest.mark.parametrize("age", [1000, 0])
def test_a_killed_workers_trial_is_given_to_another(
    tune: Callable[..., optuna.Study], tmp_path: Path, age: int
) -> None:
    """Before the worker begins, or when it would have ended."""
    params = lose_a_trial(tmp_path, age)
    study = tune("--max-total-trials", "2", "--trial-seeds", "2", "--heartbeat", "1", "--pruner", "none")
    failed, *others = study.trials
    assert failed.state == TrialState.FAIL
    assert [trial.state for trial in others] == [TrialState.COMPLETE] * 2, "as many as asked for"
    (retried,) = [trial for trial in others if trial.system_attrs.get("retry_history") == [failed.number]]
    assert retried.params == params
    assert retried.user_attrs["seeds"] == [11, 12]
    assert np.shape(retried.user_attrs["returns"]) == (2, 1, 1), "nothing is left of the killed training"


def test_without_heartbeat_a_lost_trial_stays(tune: Callable[..., optuna.Study], tmp_path: Path) -> None:
    lose_a_trial(tmp_path, 1000)
    study = tune("--max-total-trials", "2", "--heartbeat", "0")
    assert [trial.state for trial in study.trials] == [TrialState.RUNNING, TrialState.COMPLETE]


def test_workers_agree_on_the_objective(tune: Callable[..., optuna.Study]) -> None:
    tune("--n-trials", "1")
    with pytest.raises(SystemExit, match="study tiny has --trial-seeds 1, not 2"):
        tune("--n-trials", "1", "--trial-seeds", "2")
    with pytest.raises(SystemExit, match="study tiny has --heartbeat 60, not 0"):
        tune("--n-trials", "1", "--heartbeat", "0")


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--keep-trials", "1"], "--optimization-log-path FOLDER"),
        (["--trial-seeds", "2", "--n-jobs", "2"], "several workers"),
        (["--storage", "study.txt"], "names no storage .* postgresql.psycopg://USER@HOST:PORT/DATABASE"),
        (["--storage", "grpc://host"], "write grpc://HOST:PORT"),
        (["--storage", "grpc://host:port"], "write grpc://HOST:PORT"),
        (["--storage", "postgresql+pg8000://host/name"], r"driver .*No module named 'pg8000'.*\[tuning\]"),
        (["--storage", "sqlite:////no/such/folder/study.db"], "unable to open database file"),
    ],
)
def test_errors_say_what_to_do(tune: Callable[..., optuna.Study], words: list[str], reason: str) -> None:
    with pytest.raises(SystemExit, match=reason):
        tune(*words)


@pytest.mark.parametrize("scheme", ["grpc", "postgresql+psycopg"])
def test_unreachable_servers_are_named(
    tune: Callable[..., optuna.Study], monkeypatch: pytest.MonkeyPatch, scheme: str
) -> None:
    pytest.importorskip("grpc" if scheme == "grpc" else "psycopg")
    monkeypatch.setattr(tuning, "PROXY_TIMEOUT", 0.5)
    with pytest.raises(SystemExit, match=r"(no answer|refused).* Start the (proxy|server)"):
        tune(storage=f"{scheme}://127.0.0.1:{free_port()}" + ("" if scheme == "grpc" else "/study"))


def test_tables_that_another_worker_creates_are_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    from sqlalchemy.exc import IntegrityError, OperationalError

    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    errors: list[Exception] = [
        IntegrityError("", {}, Exception("UNIQUE constraint failed: alembic_version.version_num")),
        OperationalError("", {}, Exception("table studies already exists")),
    ]

    def connect() -> Any:
        if errors:
            raise errors.pop()
        return "connected"

    assert tuning._with_tables(connect) == "connected"
    errors[:] = [OperationalError("", {}, Exception("connection refused"))] * 2
    with pytest.raises(OperationalError, match="refused"):
        tuning._with_tables(connect)
    assert len(errors) == 1


@pytest.mark.parametrize(
    ("option", "value"), [("--trial-seeds", "0"), ("--keep-trials", "x"), ("--heartbeat", "-1")]
)
def test_numbers_are_checked(option: str, value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        tuning.TrainParser().parse_args([f"{option}={value}"])
    least = 0 if option == "--heartbeat" else 1
    assert f"{option}: must be a whole number of {least} or more, got '{value}'" in capsys.readouterr().err


@pytest.mark.parametrize("module", ["rl_zoo3.train", train.__name__])
def test_the_command_has_the_options(module: str) -> None:
    result = subprocess.run([sys.executable, "-m", module, "--trial-seeds=0"], capture_output=True, text=True)
    assert result.returncode == 2 and "must be a whole number of 1 or more" in result.stderr
    assert not issubclass(argparse.ArgumentParser, tuning.TrainParser), "other commands have not"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_study_behind_a_grpc_proxy(tune: Callable[..., optuna.Study], tmp_path: Path) -> None:
    pytest.importorskip("grpc")
    port = free_port()
    behind = optuna.storages.get_storage(f"sqlite:///{tmp_path / 'study.db'}")
    serve = optuna.storages.run_grpc_proxy_server
    threading.Thread(
        target=serve, args=(behind,), kwargs=dict(host="127.0.0.1", port=port), daemon=True
    ).start()
    with pytest.warns(UserWarning, match="gRPC proxy knows no heartbeats"):
        study = tune("--max-total-trials", "1", storage=f"grpc://127.0.0.1:{port}")
    assert [trial.state for trial in study.trials] == [TrialState.COMPLETE]
    assert optuna.load_study(study_name="tiny", storage=behind).best_value == study.best_value
    manager: Any = object.__new__(MCBSExperimentManager)
    manager.algo = "td3"
    loaded = manager.load_trial(f"grpc://127.0.0.1:{port}", "tiny", 0, convert=False)
    assert loaded == study.trials[0].params


@pytest.fixture
def postgres_url() -> Iterator[str]:
    """A new PostgreSQL server, which refuses to run as root."""
    programs = [Path(path).parent for path in [shutil.which("initdb")] if path]
    programs += sorted(Path("/usr/lib/postgresql").glob("*/bin"))
    if not programs:
        pytest.skip("PostgreSQL's initdb was not found")
    pytest.importorskip("psycopg")
    user: dict[str, Any] = {}
    folder = tempfile.mkdtemp()
    if os.getuid() == 0:
        user = dict(user="postgres", group="postgres")
        try:
            shutil.chown(folder, **user)
        except LookupError:
            pytest.skip("PostgreSQL cannot run as root, and there is no user postgres")
    port = free_port()

    def call(program: str, *words: str) -> None:
        command = [str(programs[0] / program), "-D", f"{folder}/data", *words]
        subprocess.run(command, check=True, cwd=folder, stdout=subprocess.DEVNULL, timeout=60, **user)

    try:
        call("initdb", "--auth=trust", "--username=tuner", "--no-sync")
        options = f"-p {port} -k {folder} -c listen_addresses=127.0.0.1"
        call("pg_ctl", "start", "-w", "-o", options, "-l", f"{folder}/log")
        yield f"postgresql+psycopg://tuner@127.0.0.1:{port}/postgres"
        call("pg_ctl", "stop", "-m", "immediate")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def start_worker(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen]]:
    """Start a process that tunes."""
    workers: list[subprocess.Popen] = []

    def start(storage: str, seed: int, *words: str) -> subprocess.Popen:
        command = [sys.executable, "-m", train.__name__, "--algo", "mcbs_td3", "--env", "Pendulum-v1", *WORDS]
        options = ["--storage", storage, "--optimization-log-path", f"worker_{seed}", "--seed", str(seed)]
        params = ["-params", *TINY, "model_kwargs:dict(n_threads=1)"]
        workers.append(subprocess.Popen([*command, *options, *words, *params], cwd=tmp_path))
        return workers[-1]

    yield start
    for worker in workers:
        worker.kill()


@pytest.mark.slow
def test_four_workers_one_killed(postgres_url: str, start_worker: Callable[..., subprocess.Popen]) -> None:
    """The recipe of docs/tuning.md."""
    options = ["-n", "200", "--max-total-trials", "8", "--trial-seeds", "2", "--heartbeat", "3"]
    workers = [start_worker(postgres_url, seed, *options) for seed in range(4)]
    storage = tuning.open_storage(postgres_url)
    tuning.join_study(storage, "tiny", {})
    study = optuna.load_study(study_name="tiny", storage=storage)

    def trained_by_the_first() -> list[optuna.trial.FrozenTrial]:
        """Its trial with the first seed behind it."""
        running = study.get_trials(states=(TrialState.RUNNING,))
        return [
            t for t in running if "worker_0" in t.user_attrs.get("folder", "") and t.user_attrs["returns"]
        ]

    while not (lost := trained_by_the_first()):
        assert workers[0].poll() is None
        time.sleep(0.2)
    workers[0].kill()
    assert [worker.wait(500) for worker in workers[1:]] == [0, 0, 0]

    trials = study.trials
    assert trials[lost[0].number].state == TrialState.FAIL
    (retried,) = [t for t in trials if t.system_attrs.get("retry_history") == [lost[0].number]]
    assert retried.params == lost[0].params and "worker_0" not in retried.user_attrs["folder"]
    assert retried.user_attrs["seeds"] == lost[0].user_attrs["seeds"]
    finished = [trial for trial in trials if trial.state in (TrialState.COMPLETE, TrialState.PRUNED)]
    # Workers that end a trial in the same moment may begin one too many.
    assert 8 <= len(finished) <= 10 and len(finished) + 1 == len(trials)


@pytest.mark.slow
def test_workers_through_a_proxy(postgres_url: str, start_worker: Callable[..., subprocess.Popen]) -> None:
    pytest.importorskip("grpc")
    port = free_port()
    serve = (
        "from optuna.storages import get_storage, run_grpc_proxy_server\n"
        f"run_grpc_proxy_server(get_storage({postgres_url!r}), host='127.0.0.1', port={port})"
    )
    proxy = subprocess.Popen([sys.executable, "-c", serve])
    try:
        workers = [start_worker(f"grpc://127.0.0.1:{port}", seed, "--n-trials", "1") for seed in (1, 2)]
        assert [worker.wait(300) for worker in workers] == [0, 0]
    finally:
        proxy.kill()
    assert len(optuna.load_study(study_name="tiny", storage=tuning.open_storage(postgres_url)).trials) == 2
