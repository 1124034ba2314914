"""What a cluster needs, without a cluster: parcels, workers' folders, lost runs, the command's options."""

import io
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console

from sb3_mcbs.checkpoints.encoding import Encoded
from sb3_mcbs.checkpoints.store import Store
from sb3_mcbs.experiments import cluster, command, expand, read_spec, transfer
from sb3_mcbs.experiments.cluster import Cluster
from sb3_mcbs.experiments.display import Display
from sb3_mcbs.experiments.engine import LOSSES, Engine
from sb3_mcbs.experiments.process import Lost
from sb3_mcbs.experiments.results import RunFolder, prepare
from sb3_mcbs.experiments.transfer import Packer, unpack
from sb3_mcbs.experiments.worker import Order, Report, _make_folder, describe, refusal, refusal_of_scratch
from tests.experiment_helpers import SPEC, TD3, spec_file


def run_folder(path: Path) -> RunFolder:
    """The folder of a run that has not begun."""
    spec = read_spec(spec_file(path, arms={"td3": SPEC["arms"]["td3"]}))
    (folder,) = prepare(path / "results", spec, expand(spec))
    return folder


def empty_folder(path: Path) -> RunFolder:
    path.mkdir()
    return RunFolder(path)


def save(folder: RunFolder, step: int) -> None:
    """Write a checkpoint, and remove those that it replaces."""
    store = folder.checkpoints(folder.run())
    older = [part for old in store.steps()[:1] for part in store.read(old).manifest["rows"]]
    rows = store.write_rows(step - 100, step, {"actions": np.full(1000, step)})
    state = Encoded({"step": step}, {"networks": np.full(1000, step)})
    store.write(step, {"rows": [*older, rows][-2:]}, state)
    store.clean(2, step)
    (folder.training(folder.run()) / "0.monitor.csv").write_text(f"{step} steps\n")


def content(folder: RunFolder) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder.path)): path.read_bytes()
        for path in folder.path.rglob("*")
        if path.is_file() and path != folder.lock.path
    }


def test_parcels_bring_what_has_changed(tmp_path: Path) -> None:
    here, there = run_folder(tmp_path / "here"), empty_folder(tmp_path / "there")
    packer = Packer(here)
    for step in (100, 200, 300, 400):
        save(here, step)
        parcel = packer.pack()
        assert [name[-3:] for name in parcel.checkpoints] == [str(step)] and len(parcel.rows) == 1
        unpack(parcel, there)
        assert content(there) == content(here)
    assert there.checkpoints(there.run()).steps() == [400, 300]
    nothing = packer.pack()
    assert not nothing.rows and not nothing.checkpoints and not nothing.files
    here.status = {"state": "finished"}
    for path in (here.training(here.run()) / "checkpoints").rglob("*.*"):
        path.unlink()
    unpack(packer.pack(), there)
    assert there.status == {"state": "finished"} and there.newest_checkpoint(there.run()) is None
    assert not (there.training(there.run()) / "checkpoints").exists()


def test_what_is_being_written_or_is_damaged_stays_behind(tmp_path: Path) -> None:
    here, there = run_folder(tmp_path / "here"), empty_folder(tmp_path / "there")
    save(here, 100)
    save(here, 200)
    store = here.checkpoints(here.run())
    unfinished = store.folder / ".unfinished-step_000000000300"
    unfinished.mkdir()
    (unfinished / "arrays.npz").write_bytes(b"half")
    (here.path / ".status.json.partial").write_text("{")
    (store.rows_folder / "000000000100-000000000200.npz").unlink()  # of the newer one alone
    unpack(Packer(here).pack(), there)
    arrived = there.checkpoints(there.run())
    assert arrived.steps() == [100] and arrived.read(100).state.json == {"step": 100}
    assert not [name for name in content(there) if "/." in f"/{name}"]


def test_a_checkpoint_that_was_written_anew_is_sent_anew(tmp_path: Path) -> None:
    here, there = run_folder(tmp_path / "here"), empty_folder(tmp_path / "there")
    packer = Packer(here)
    save(here, 100)
    unpack(packer.pack(), there)
    there.checkpoints(there.run()).path_of(100).joinpath("arrays.npz").write_bytes(b"damaged")
    save(here, 100)
    unpack(packer.pack(), there)
    assert there.checkpoints(there.run()).read(100).state.json == {"step": 100}


class Killed(BaseException):
    """The runner is killed."""


def test_a_runner_killed_while_it_unpacks_has_a_whole_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = run_folder(tmp_path / "here")
    save(here, 100)
    save(here, 200)
    packer = Packer(here)
    first = packer.pack()
    save(here, 300)
    second = packer.pack()
    writes: Iterator[None]
    real = transfer.write_file

    def write_or_die(path: Path, write: object) -> object:
        if next(writes, Killed) is Killed:
            path.write_bytes(b"half")
            raise Killed
        return real(path, write)  # type: ignore[arg-type]

    monkeypatch.setattr(transfer, "write_file", write_or_die)
    outcomes = []
    for n_writes in range(6):
        there = empty_folder(tmp_path / f"there-{n_writes}")
        writes = iter([None] * 100)
        unpack(first, there)
        writes = iter([None] * n_writes)
        try:
            unpack(second, there)
        except Killed:
            outcomes.append("killed")
        else:
            outcomes.append("done")
        store = Store(there.checkpoints(there.run()).folder)
        newest = store.read_newest()  # a warning would be an error: none is passed over
        assert newest.state.json == {"step": 300 if outcomes[-1] == "done" else 200}
        writes = iter([None] * 100)
        unpack(Packer(here).pack(), there)  # the next attempt's
        assert content(there) == content(here)
    assert outcomes == ["killed"] * 4 + ["done"] * 2


def order(folder: RunFolder, scratch: Path) -> Order:
    return Order(folder.path, scratch, Packer(folder).pack(), {}, {})


def test_scratch_folders_of_killed_workers_are_removed(tmp_path: Path) -> None:
    folder, scratch = run_folder(tmp_path / "here"), tmp_path / "scratch"
    save(folder, 100)
    lives, killed = (_make_folder(order(folder, scratch)) for _ in range(2))
    assert lives.path != killed.path and content(lives) == content(folder)
    killed.lock.give_back()
    new = _make_folder(order(folder, scratch))
    assert lives.path.is_dir() and new.path.is_dir() and not killed.path.exists()


def test_a_trained_agent_goes_along(tmp_path: Path) -> None:
    agent = tmp_path / "agent.zip"
    agent.write_bytes(b"the agent")
    spec = {
        "agents": {"mine": {"file": str(agent), "environment": "Pendulum-v1"}},
        "seeds": [0],
        "evaluation": {"episodes": 2},
        "arms": {"actor": {"policy": "actor"}},
    }
    (tmp_path / "spec.yml").write_text(yaml.safe_dump(spec))
    parsed = read_spec(tmp_path / "spec.yml")
    (folder,) = prepare(tmp_path / "results", parsed, expand(parsed))
    made = _make_folder(Cluster(print, None, tmp_path / "scratch", 0).order_for(folder))
    run = made.run()
    assert run.agent is not None and Path(run.agent.file).read_bytes() == b"the agent"
    assert Path(run.agent.file).is_relative_to(made.path) and run.agent.statistics is None
    # Nothing of this comes back: the results name the file that the spec names.
    packer = Packer(made)
    packer.pack()
    (made.path / "log.txt").write_text("played")
    unpack(packer.pack(), folder)
    assert folder.run().agent == parsed.agents[0] and folder.log_tail() == ["played"]


def test_a_node_that_is_not_like_the_runners_is_refused(tmp_path: Path) -> None:
    (tmp_path / "token").touch()
    assert refusal(describe(), tmp_path / "token") == refusal(describe(), None) == ""
    other = {**describe(), "torch": "1.0"}
    text = refusal(other, None)
    assert text.startswith("it has torch ") and ", the runner torch 1.0. Install" in text
    assert "does not see the results" in refusal(describe(), tmp_path / "nothing")
    scratch = tmp_path / "token" / "scratch"
    assert refusal_of_scratch(tmp_path / "new") == refusal_of_scratch(None) == ""
    text = refusal_of_scratch(scratch)
    assert text == f"it cannot write in {scratch} (Not a directory). Choose another --scratch folder"
    assert "sources" in str(describe()["sb3-mcbs"])


class Fleeting:
    """A trainer that waits for a place, then gets lost, or ends."""

    def __init__(self, outcome: int | Lost) -> None:
        self.where: str | None = None
        self._outcome = outcome

    def poll(self) -> int | Lost | None:
        if self.where is None:
            self.where = ", node somewhere"
            return None
        return self._outcome

    def ask_to_stop(self) -> None: ...

    def kill(self) -> None: ...


def lose(path: Path, monkeypatch: pytest.MonkeyPatch, n_checkpoints: int) -> tuple[Engine, str, int]:
    """An engine whose nodes are lost again and again; the first times there is a new checkpoint."""
    monkeypatch.setattr("sb3_mcbs.experiments.engine._TICK", 0)
    launched = []

    def launch(folder: RunFolder) -> Fleeting:
        launched.append(folder)
        if len(launched) <= n_checkpoints:
            save(folder, 100 * len(launched))
        return Fleeting(Lost("the power is off"))

    console = Console(record=True, width=200, file=io.StringIO())
    engine = Engine([run_folder(path)], None, Display(console), launch)
    assert engine.finish() == 1
    return engine, console.export_text(), len(launched)


def test_a_lost_node_is_no_crash_but_not_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    engine, text, n_launched = lose(tmp_path, monkeypatch, 0)
    (job,) = engine.jobs
    assert (n_launched, job.crashes, job.state, job.folder.status["state"]) == (LOSSES, 0, "failed", "failed")
    assert f" {TD3}: started, node somewhere" in text
    assert f" {TD3}: lost at 0 steps, goes on elsewhere: the power is off" in text
    assert f" {TD3}: lost at 0 steps, given up after {LOSSES} times without a new checkpoint" in text


def test_losses_count_from_the_last_new_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, text, n_launched = lose(tmp_path, monkeypatch, 3)
    assert n_launched == 3 + LOSSES - 1 and f" {TD3}: goes on, node somewhere" in text


def test_results_that_cannot_be_stored_are_a_loss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(cluster, "unpack", fail)
    monkeypatch.setattr(cluster.RayRun, "_take_place", lambda run: None)
    monkeypatch.setattr(cluster.RayRun, "_leave_place", lambda run: None)
    folder = run_folder(tmp_path)
    run = cluster.RayRun(Cluster(print, None, None, 0.0), folder)
    run._on_report(Report(parcel=Packer(folder).pack()))
    assert run.poll() == Lost("its results cannot be stored here: no space left on device")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scratch", "/tmp/x"], "--scratch: only with --engine ray"),
        (["--address", "auto", "--gpus-per-run", "1"], "--address, --gpus-per-run: only with --engine ray"),
        (["--engine", "ray", "--scratch", "here"], "--scratch must be an absolute path"),
        (["--engine", "ray", "--gpus-per-run", "nan"], "--gpus-per-run must be 0 or more"),
        (["--jobs", "0"], "--jobs must be 1 or more"),
    ],
)
def test_options_are_checked(
    words: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["sb3-mcbs experiment", "smoke", *words])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    assert stopped.value.code == 2 and message in capsys.readouterr().err


def test_without_ray_the_command_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    words = [str(spec_file(tmp_path)), "-o", str(tmp_path / "results"), "--engine", "ray"]
    monkeypatch.setattr(sys, "argv", ["sb3-mcbs experiment", *words])
    with pytest.raises(SystemExit, match=r"pip install 'sb3-mcbs\[ray\]'"):
        command.main()
