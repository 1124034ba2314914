"""The folder of an experiment's results: what is in it, and who works on it."""

import fcntl
import json
import os
import socket
import time
from pathlib import Path
from typing import IO, Any

import yaml

from sb3_mcbs.checkpoints.store import Store
from sb3_mcbs.experiments.plan import Run, from_yaml
from sb3_mcbs.experiments.spec import Spec
from sb3_mcbs.zoo.manager import CHECKPOINTS
from sb3_mcbs.zoo.paths import sibling_folder

FINISHED = "finished"
#: Seconds that another runner may take to set up the folder.
_PATIENCE = 30.0


class ResultsError(RuntimeError):
    """A folder of results is not what a command needs; the message says what to do."""


class Lock:
    """
    A file that one process at a time may hold, with the processes it hands it on to.

    The system lets it go when the last of them ends, however it ends.

    :param path: the file
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: IO[str] | None = None

    def take(self, patience: float = 0) -> bool:
        """
        :param patience: seconds to wait until it is free
        :return: whether it was free, and is ours now
        """
        give_up = time.monotonic() + patience
        while not self._try():
            if time.monotonic() >= give_up:
                return False
            time.sleep(0.1)
        return True

    def _try(self) -> bool:
        file = self.path.open("a+")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            return False
        file.truncate(0)
        file.write(f"{os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        self._file = file
        return True

    def give_back(self) -> None:
        """Let it go, as far as this process is concerned."""
        if self._file is not None:
            self._file.close()
            self._file = None

    @property
    def is_held(self) -> bool:
        """Whether this object holds it."""
        return self._file is not None

    @property
    def descriptor(self) -> int:
        """What a child process inherits to hold it as well."""
        assert self._file is not None
        return self._file.fileno()

    def holder(self) -> str:
        """
        :return: the process that took it last
        """
        return self.path.read_text().strip() if self.path.is_file() else ""


class RunFolder:
    """
    The files of one run.

    :param path: its folder
    """

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        self.name = path.name
        self.definition = self.path / "run.yml"
        self.hyperparameters = self.path / "hyperparameters.yml"
        self.log = self.path / "log.txt"
        self.progress_file = self.path / "progress.json"
        #: RL Zoo's log folder, for this run alone.
        self.logs = self.path / "logs"
        self.lock = Lock(self.path / "lock")
        self._status = self.path / "status.json"
        self._machines = self.path / "machines.json"

    def create(self, run: Run) -> None:
        """
        :param run: what is to be trained here; nothing is written over
        """
        if not self.definition.is_file():
            self.path.mkdir(parents=True, exist_ok=True)
            if run.agent is None:
                entry = yaml.safe_dump({run.environment: run.hyperparameters}, sort_keys=False)
                write(self.hyperparameters, entry)
            write(self.definition, run.as_yaml())

    def run(self) -> Run:
        """
        :return: what is trained here
        """
        return from_yaml(self.definition.read_text())

    def training(self, run: Run) -> Path:
        """
        :param run: what is trained here
        :return: RL Zoo's folder of the run; the same for the evaluation of a trained agent
        """
        return self.logs / run.algorithm / f"{run.environment.replace('/', '-')}_1"

    def evaluations(self, run: Run) -> list[Path]:
        """
        :param run: what is trained here
        :return: the folders that may have its evaluations: of what it is itself, and of the other policy
        """
        own = self.training(run)
        return [own, sibling_folder(own, "actor"), sibling_folder(own, "search")]

    def checkpoints(self, run: Run) -> Store:
        """
        :param run: what is trained here
        :return: its exact checkpoints
        """
        return Store(self.training(run) / CHECKPOINTS)

    def newest_checkpoint(self, run: Run) -> int | None:
        """
        :param run: what is trained here
        :return: the step of the newest exact checkpoint; None if there is none to go on from
        """
        return max(self.checkpoints(run).steps(), default=None)

    @property
    def status(self) -> dict[str, Any]:
        """``state`` (waiting, running, finished, failed or interrupted) and what there is to say about it."""
        return _read_json(self._status) or {"state": "waiting"}

    @status.setter
    def status(self, content: dict[str, Any]) -> None:
        write(self._status, json.dumps(content) + "\n")

    @property
    def progress(self) -> dict[str, Any]:
        """``step``, and ``returns`` of the policies once they were evaluated."""
        return _read_json(self.progress_file)

    @property
    def machines(self) -> list[dict[str, Any]]:
        """What the run's processes ran on, one entry for every change."""
        return list(_read_json(self._machines).get("machines", []))

    def note_machine(self, description: dict[str, Any]) -> None:
        """
        :param description: what the present process runs on
        """
        if description not in self.machines[-1:]:
            write(self._machines, json.dumps({"machines": [*self.machines, description]}, indent=1) + "\n")

    def log_tail(self, lines: int = 15) -> list[str]:
        """
        :param lines: how many
        :return: the last lines of the log
        """
        if not self.log.is_file():
            return []
        with self.log.open("rb") as file:
            file.seek(max(0, self.log.stat().st_size - 20_000))
            return file.read().decode(errors="replace").splitlines()[-lines:]


def prepare(folder: Path, spec: Spec, runs: list[Run]) -> list[RunFolder]:
    """
    Make the folder of an experiment, or check that it is one of the same experiment.

    :param folder: the folder
    :param spec: the experiment
    :param runs: its runs
    :return: their folders
    :raises ResultsError: if the folder has other runs of these names, or further ones, or cannot be written
    """
    lock = Lock(folder / "lock")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        is_ours = lock.take(_PATIENCE)
    except OSError as error:
        raise ResultsError(
            f"{folder} cannot be written: {error.strerror}. Name another one with --output."
        ) from error
    if not is_ours:  # another runner does the same at this moment
        raise ResultsError(f"{folder} has been locked for long by process {lock.holder()}. End that one.")
    try:
        by_name = {run.name: run for run in runs}
        for path in sorted((folder / "runs").glob("*/run.yml")):
            name = path.parent.name
            if name not in by_name:
                raise ResultsError(_other_spec(folder, f"it has the run {name}, which the spec does not"))
            try:
                difference = _difference(path, by_name[name])
            except (ValueError, yaml.YAMLError) as error:
                raise ResultsError(
                    f"{path} cannot be read. Remove {path.parent} to begin this run again."
                ) from error
            if difference:
                raise ResultsError(_other_spec(folder, f"{name}: {difference}"))
        folders = []
        for run in runs:
            folders.append(RunFolder(folder / "runs" / run.name))
            folders[-1].create(run)
        write(folder / "spec.yml", spec.text)
    finally:
        lock.give_back()
    return folders


def write(path: Path, content: str | bytes) -> None:
    """
    :param path: a file, replaced in one go
    :param content: its new content
    """
    partial = path.with_name(f".{path.name}.partial")
    partial.write_bytes(content.encode() if isinstance(content, str) else content)
    partial.replace(path)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return {}


def _other_spec(folder: Path, difference: str) -> str:
    return (
        f"The results in {folder} are of another spec: {difference}. Runs may be added to it, not changed. "
        f"Name another folder with --output, or go on with {folder / 'spec.yml'}."
    )


def _difference(path: Path, run: Run) -> str:
    """What is different in a run on the disk, or nothing."""
    then, now = _flat(yaml.safe_load(path.read_text())), _flat(yaml.safe_load(run.as_yaml()))
    changed = [
        f"{key} was {then.get(key, 'not there')!r}, is {now.get(key, 'not there')!r}"
        for key in {**then, **now}
        if (key in then, then.get(key)) != (key in now, now.get(key))
    ]
    return "; ".join(changed[:5]) + (" and more" if len(changed) > 5 else "")


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    if not isinstance(value, dict) or not value:
        return {name: value}
    return {
        key: item
        for part, content in value.items()
        for key, item in _flat(content, f"{name}.{part}".lstrip(".")).items()
    }
