"""Experiments on a real Ray cluster of two nodes, of which one is killed, and runners that are."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from sb3_mcbs import __version__
from sb3_mcbs.checkpoints.store import Store
from sb3_mcbs.experiments.results import RunFolder
from tests.experiment_helpers import (
    MCBS,
    REPOSITORY,
    TD3,
    assert_equal,
    begin,
    folder_of,
    run,
    spec_file,
    wait_for,
)

pytest.importorskip("ray", reason="needs Ray: pip install 'sb3-mcbs[ray]'")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc"),
]
NAMES = (TD3, MCBS)
LONGER = {"steps": 800, "evaluation": {"every": 400, "episodes": 1}}
_RAY = [sys.executable, "-m", "ray.scripts.scripts", "start", "--block", "--disable-usage-stats"]
_SMALL = ["--num-cpus=1", "--object-store-memory=100000000"]


def processes() -> dict[int, tuple[int, int, list[str]]]:
    """Parent, session and command of every process that lives."""
    found = {}
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            state, parent, _, session = (path / "stat").read_text().rpartition(")")[2].split()[:4]
            words = (path / "cmdline").read_bytes().decode(errors="replace").split("\0")
            if state != "Z":
                found[int(path.name)] = (int(parent), int(session), words)
    return found


class Machine:
    """A node of a Ray cluster, whose processes are a session."""

    def __init__(self, *words: str, source: Path = REPOSITORY) -> None:
        self.process = subprocess.Popen(
            [*_RAY, *_SMALL, *words],
            env={**os.environ, "PYTHONPATH": str(source)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    def trainers(self) -> dict[int, Path]:
        """What trains a run here, and in which folder."""
        living = processes()
        return {
            pid: Path(words[-2])
            for pid, (parent, _, words) in living.items()
            if "sb3_mcbs.experiments.train_run" in words
            and living.get(parent, (0, 0, []))[1] == self.process.pid
        }

    def kill(self) -> None:
        """As if its power failed, but for the trainers, which must end without our help."""
        for pid, (_, session, _) in processes().items():
            if session == self.process.pid:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        self.process.wait()


class Cluster:
    """A head, and a node beside it."""

    def __init__(self) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.address = f"127.0.0.1:{probe.getsockname()[1]}"
        self.folder = Path(tempfile.mkdtemp(prefix="ray-"))  # pytest's are too long for the names of sockets
        self.machines: list[Machine] = []
        port = self.address.split(":")[1]
        self.add("--head", f"--port={port}", "--include-dashboard=false", f"--temp-dir={self.folder}")

    def add(self, *words: str, source: Path = REPOSITORY) -> Machine:
        """Start a machine, and wait until the cluster has it."""
        self.machines.append(Machine(*(words or [f"--address={self.address}"]), source=source))
        wait_for(lambda: self.n_alive() == sum(each.process.poll() is None for each in self.machines))
        return self.machines[-1]

    def n_alive(self) -> int:
        code = f"import ray; ray.init('{self.address}'); print(sum(n['Alive'] for n in ray.nodes()))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        return int(done.stdout or 0)

    def end(self) -> None:
        for machine in self.machines:
            machine.kill()
        shutil.rmtree(self.folder, ignore_errors=True)


@pytest.fixture
def cluster() -> Iterator[Cluster]:
    cluster = Cluster()
    try:
        yield cluster
    finally:
        cluster.end()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the local engine."""
    folder = tmp_path_factory.mktemp("undisturbed")
    status, text = run(spec_file(folder, **LONGER), folder / "results")
    assert status == 0, text
    return folder / "results"


def newest(folder: RunFolder) -> int:
    return (folder.definition.is_file() and folder.newest_checkpoint(folder.run())) or 0


def stop_in_mid_run(machine: Machine) -> tuple[int, str]:
    """Have a run of this machine stand still after its first steps; its process, and its name."""

    def begun() -> tuple[int, str] | None:
        for pid, path in machine.trainers().items():
            if any(
                max(Store(found).steps(), default=0) >= 100 for found in path.glob("logs/*/*/checkpoints")
            ):
                os.kill(pid, signal.SIGSTOP)
                return pid, next(name for name in NAMES[::-1] if name in path.name)
        return None

    return wait_for(begun)


@pytest.mark.parametrize("shared", [True, False], ids=["shared", "scratch"])
def test_a_node_is_killed_in_mid_run(
    shared: bool, cluster: Cluster, undisturbed: Path, tmp_path: Path
) -> None:
    doomed, results, scratch = cluster.add(), tmp_path / "results", tmp_path / "scratch"
    words = [
        "--engine",
        "ray",
        "--address",
        cluster.address,
        *([] if shared else ["--scratch", str(scratch)]),
    ]
    runner = begin(spec_file(tmp_path, **LONGER), results, *words)
    pid, name = stop_in_mid_run(doomed)
    wait_for(lambda: newest(folder_of(results, name)) >= 100)
    doomed.kill()
    wait_for(lambda: pid not in processes(), 5)
    text, _ = runner.communicate(timeout=300)
    assert runner.returncode == 0 and f" {name}: lost at " in text and f" {name}: goes on, node" in text, text
    for each in NAMES:
        assert text.count(f" {each}: finished") == 1, text
        assert_equal(folder_of(results, each), folder_of(undisturbed, each))
        assert not folder_of(results, each).checkpoints(folder_of(results, each).run()).folder.exists()
    assert "Resumed at" in folder_of(results, name).log.read_text()
    assert not list(results.glob(".seen*"))


def test_a_signal_and_a_killed_runner(cluster: Cluster, undisturbed: Path, tmp_path: Path) -> None:
    spec, results, scratch = spec_file(tmp_path, **LONGER), tmp_path / "results", tmp_path / "scratch"
    words = ["--engine", "ray", "--address", cluster.address, "--scratch", str(scratch), "--only", "mcbs"]
    (head,), mcbs = cluster.machines, folder_of(results, MCBS)
    runner = begin(spec, results, *words)
    pid, _ = stop_in_mid_run(head)
    runner.send_signal(signal.SIGTERM)
    os.kill(pid, signal.SIGCONT)
    text, _ = runner.communicate(timeout=120)
    assert runner.returncode == 130 and f" {MCBS}: stopped at" in text, text
    stopped_at = newest(mcbs)
    assert mcbs.status["state"] == "interrupted" and stopped_at > 0
    assert "Stopped by SIGTERM" in mcbs.log.read_text()
    assert not list(scratch.glob("*_*"))

    runner = begin(spec, results, *words)
    wait_for(lambda: newest(mcbs) > stopped_at)
    runner.kill()
    runner.communicate()
    wait_for(lambda: not head.trainers(), 10)
    assert mcbs.status["state"] == "running" and len(list(scratch.glob("*_*"))) == 1

    runner = begin(spec, results, *words)
    text, _ = runner.communicate(timeout=300)
    assert runner.returncode == 0 and f" {MCBS}: goes on, node" in text, text
    assert_equal(mcbs, folder_of(undisturbed, MCBS))
    assert not list(scratch.glob("*_*"))


def test_a_node_with_other_sources_is_refused(cluster: Cluster, undisturbed: Path, tmp_path: Path) -> None:
    shutil.copytree(REPOSITORY / "sb3_mcbs", tmp_path / "other" / "sb3_mcbs")
    with (tmp_path / "other" / "sb3_mcbs" / "types.py").open("a") as file:
        file.write("# changed\n")
    cluster.add(source=tmp_path / "other")
    # In this folder are the runner's sources, and Ray would have all workers import from it.
    words = ["--engine", "ray", "--address", cluster.address]
    runner = begin(spec_file(tmp_path, **LONGER), tmp_path / "results", *words)
    text, _ = runner.communicate(timeout=300)
    refusal = f"is refused: it has sb3-mcbs {__version__} (sources"
    assert runner.returncode == 0 and text.count(refusal) == 1, text
    for each in NAMES:
        assert_equal(folder_of(tmp_path / "results", each), folder_of(undisturbed, each))

    cluster.machines[0].kill()  # the head
    runner = begin(spec_file(tmp_path, **LONGER), tmp_path / "results", *words)
    text, _ = runner.communicate(timeout=300)
    assert runner.returncode == 1 and f"No Ray cluster answers at {cluster.address}" in text, text
