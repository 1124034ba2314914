"""What trains a run on a node of a cluster; nothing here knows which cluster it is."""

import functools
import hashlib
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import sb3_mcbs
from sb3_mcbs.checkpoints.settings import processor, versions
from sb3_mcbs.experiments.process import Process, command
from sb3_mcbs.experiments.results import Lock, RunFolder, write
from sb3_mcbs.experiments.transfer import Packer, Parcel, unpack

#: Seconds within which the runner leaves the lock of a run to a worker.
_PATIENCE = 10.0
_PREFIX = "sb3-mcbs-"


@dataclass
class Order:
    """
    A run that a worker is to train.

    :param path: the run's folder, as the runner has it
    :param scratch: a folder of the node, in which the run is trained; None: in the run's folder
    :param parcel: all that the runner has of the run, for ``scratch``
    :param agent_files: the files of a trained agent, by name, for ``scratch``
    :param environment: variables for the process
    """

    path: Path
    scratch: Path | None
    parcel: Parcel
    agent_files: dict[str, bytes]
    environment: dict[str, str]


@dataclass
class Report:
    """
    How far a run is.

    :param status: the exit status of its process, once that has ended
    :param progress: of the run, as far as the runner does not see it
    :param parcel: what has changed, whenever there is a new checkpoint or evaluation, and at the end
    :param taken_by: the process that holds the run's lock, so that it was not started
    """

    status: int | None = None
    progress: dict[str, Any] | None = None
    parcel: Parcel | None = None
    taken_by: str = ""


@functools.cache
def describe() -> dict[str, str | None]:
    """
    :return: what must be equal on all nodes, or runs are not
    """
    root = Path(sb3_mcbs.__file__).parent
    sources = sorted(root.rglob("*.py"), key=lambda path: path.relative_to(root).parts)
    digest = hashlib.sha256(b"\0".join(path.read_bytes() for path in sources)).hexdigest()
    found = versions()
    return {**found, "sb3-mcbs": f"{found['sb3-mcbs']} (sources {digest[:10]})"}


def refusal(expected: dict[str, str | None], token: Path | None) -> str:
    """
    Check whether this node may train.

    :param expected: from :func:`describe`, of the runner
    :param token: a file of the runner's that this node must see; None: it need not see any
    :return: why not, and what to do; nothing if it may
    """
    here = describe()
    differing = [name for name in expected if here.get(name) != expected[name]]
    if differing:
        has = ", ".join(f"{name} {here.get(name)}" for name in differing)
        runner = ", ".join(f"{name} {expected[name]}" for name in differing)
        return f"it has {has}, the runner {runner}. Install the same on all nodes: runs would not be equal"
    if token is not None and not token.is_file():
        return (
            f"it does not see the results in {token.parent}. Choose an --output folder on a disk that all "
            "nodes have under the same path, or --scratch FOLDER to train in a folder of each node"
        )
    return ""


def refusal_of_scratch(scratch: Path | None) -> str:
    """
    Check whether this node can write where runs are trained.

    :param scratch: a folder; None: the runs' folders
    :return: why not, and what to do; nothing if it can
    """
    if scratch is not None:
        try:
            scratch.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=scratch) as file:
                file.write(b"something, which a full disk does not take")
        except OSError as error:
            return f"it cannot write in {scratch} ({error.strerror}). Choose another --scratch folder"
    return ""


class Worker:
    """
    Trains one run on this node.

    :ivar processor: of this node
    """

    def __init__(self) -> None:
        self.processor = processor()
        self._process: Process | None = None
        self._packer: Packer | None = None
        self._mark: Any = None

    def begin(self, order: Order) -> Report:
        """
        Start the run's process.

        :param order: the run
        :return: its first report
        """
        self._folder = RunFolder(order.path) if order.scratch is None else _make_folder(order)
        lock = self._folder.lock
        if not lock.is_held and not lock.take(_PATIENCE):
            return Report(taken_by=lock.holder() or "another process")
        if order.scratch is not None:
            self._packer = Packer(self._folder)
            self._packer.pack()  # the runner has what is there now
        self._run = self._folder.run()
        # Not from the folder where the cluster was started: the process imports what this worker does.
        environment = {"PYTHONSAFEPATH": "1", **order.environment}
        self._process = Process(self._folder, command(self._folder), environment)
        self._mark = self._what_counts()
        return Report()

    def look(self) -> Report:
        """
        :return: how far the run is; when it has ended its lock is free, and nothing of it is left in the
            scratch folder
        """
        assert self._process is not None
        report = Report(self._process.poll())
        if self._packer is not None:
            mark = self._what_counts()
            if report.status is not None or mark != self._mark:
                report.parcel, self._mark = self._packer.pack(), mark
            report.progress = self._folder.progress
            if report.status is not None:
                shutil.rmtree(self._folder.path, ignore_errors=True)
        if report.status is not None:
            self._folder.lock.give_back()
        return report

    def stop(self) -> None:
        """Let the run write a checkpoint and end."""
        if self._process is not None:
            self._process.ask_to_stop()

    def _what_counts(self) -> Any:
        """What is worth being sent as soon as it changes."""
        return self._folder.checkpoints(self._run).steps(), self._folder.progress.get("evaluations")


def _make_folder(order: Order) -> RunFolder:
    """The folder of a run in a scratch folder, with what the runner has. What killed ones left is removed."""
    assert order.scratch is not None
    order.scratch.mkdir(parents=True, exist_ok=True)
    among_workers = Lock(order.scratch / f"{_PREFIX}lock")
    if not among_workers.take(_PATIENCE):
        raise OSError(f"{among_workers.path} has been locked for long by process {among_workers.holder()}.")
    try:
        for path in order.scratch.glob(f"{_PREFIX}*/lock"):
            left = Lock(path)
            if left.take():
                shutil.rmtree(path.parent, ignore_errors=True)
                left.give_back()
        folder = RunFolder(Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{order.path.name}-", dir=order.scratch)))
        folder.lock.take()
    finally:
        among_workers.give_back()
    unpack(order.parcel, folder)
    if order.agent_files:
        _use_agent_files(folder, order.agent_files)
    return folder


def _use_agent_files(folder: RunFolder, files: dict[str, bytes]) -> None:
    """Have a run take the files of its agent from its own folder."""
    paths = {}
    for name, content in files.items():
        paths[name] = str(folder.path / f"agent-{name}")
        Path(paths[name]).write_bytes(content)
    run = folder.run()
    assert run.agent is not None
    write(folder.definition, replace(run, agent=replace(run.agent, **paths)).as_yaml())
