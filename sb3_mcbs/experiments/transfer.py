"""The files of a run on their way between two folders that no disk connects."""

import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path

from sb3_mcbs.checkpoints import CheckpointError
from sb3_mcbs.checkpoints.store import MANIFEST, read_manifest, sync_folder, write_file
from sb3_mcbs.experiments.results import RunFolder, write

_STATUS = "status.json"
#: Of a checkpoint that is being written; the checkpoints' own writer removes it if it stays.
_UNFINISHED = ".unfinished-received-"


@dataclass
class Parcel:
    """
    What has changed in a run's folder.

    :param rows: files with rows of the replay buffer, which checkpoints need
    :param checkpoints: by folder, the files of each exact checkpoint
    :param files: all others
    :param present: all files that there are, changed or not

    All names are relative to the run's folder.
    """

    rows: dict[str, bytes] = field(default_factory=dict)
    checkpoints: dict[str, dict[str, bytes]] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    present: set[str] = field(default_factory=set)


class Packer:
    """
    Packs what has changed in a run's folder since it was packed last, also while the run is trained there.

    :param folder: of the run
    """

    def __init__(self, folder: RunFolder) -> None:
        self.folder = folder
        self._packed: dict[str, tuple[int, int, int]] = {}

    def pack(self) -> Parcel:
        """
        :return: every checkpoint in it is whole
        """
        parcel = Parcel()
        checkpoints = self.folder.checkpoints(self.folder.run())
        # All else is read after the checkpoints, so that what they need is there.
        for step in checkpoints.steps():
            self._pack_checkpoint(parcel, checkpoints.path_of(step), checkpoints.rows_folder)
        for path in sorted(self.folder.path.rglob("*")):
            parts = path.relative_to(self.folder.path).parts
            hidden = any(part.startswith(".") for part in parts)
            if hidden or path == self.folder.lock.path or path.is_relative_to(checkpoints.folder):
                continue
            if path.is_file():
                self._pack_file(parcel, parcel.files, path)
        self._packed = {name: seen for name, seen in self._packed.items() if name in parcel.present}
        return parcel

    def _pack_checkpoint(self, parcel: Parcel, path: Path, rows_folder: Path) -> None:
        trial, packed = Parcel(), dict(self._packed)
        files: dict[str, bytes] = {}
        try:
            rows = [rows_folder / part["name"] for part in read_manifest(path)["rows"]]
            is_new = self._seen(path / MANIFEST) != packed.get(self._name(path / MANIFEST))
            for file in sorted(path.iterdir()):
                if is_new:  # as a whole
                    self._packed.pop(self._name(file), None)
                self._pack_file(trial, files, file, must_exist=True)
            for file in rows:
                self._pack_file(trial, trial.rows, file, must_exist=True)
        except (OSError, CheckpointError):  # it was removed a moment ago, or is damaged
            self._packed = packed
            return
        if files:
            parcel.checkpoints[self._name(path)] = {Path(name).name: data for name, data in files.items()}
        parcel.rows |= trial.rows
        parcel.present |= trial.present

    def _pack_file(
        self, parcel: Parcel, into: dict[str, bytes], path: Path, must_exist: bool = False
    ) -> None:
        name = self._name(path)
        try:
            seen = self._seen(path)
            if self._packed.get(name) != seen:
                into[name] = path.read_bytes()
        except FileNotFoundError:
            if must_exist:
                raise
            return
        self._packed[name] = seen
        parcel.present.add(name)

    def _name(self, path: Path) -> str:
        return str(path.relative_to(self.folder.path))

    @staticmethod
    def _seen(path: Path) -> tuple[int, int, int]:
        about = os.stat(path)
        return about.st_ino, about.st_size, about.st_mtime_ns


def unpack(parcel: Parcel, folder: RunFolder) -> None:
    """
    Make a run's folder what the sender's is.

    A checkpoint appears when it is whole, and nothing is removed before what replaces it is there. Whoever is
    killed in between leaves a folder from which the run goes on.

    :param parcel: from the sender
    :param folder: of the run
    """
    for name, content in parcel.rows.items():
        _write_durably(folder.path / name, content)
    for name, content in parcel.files.items():
        if name != _STATUS:
            (folder.path / name).parent.mkdir(parents=True, exist_ok=True)
            write(folder.path / name, content)
    for name, files in parcel.checkpoints.items():
        _write_checkpoint(folder.path / name, files)
    if _STATUS in parcel.files:  # last, since it may say that all is there
        write(folder.path / _STATUS, parcel.files[_STATUS])
    _remove_others(folder, parcel.present)


def _write_durably(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(_UNFINISHED + path.name)
    _write_and_flush(unfinished, content)
    unfinished.replace(path)
    sync_folder(path.parent)


def _write_and_flush(path: Path, content: bytes) -> None:
    write_file(path, lambda file: file.write(content))


def _write_checkpoint(path: Path, files: dict[str, bytes]) -> None:
    unfinished = path.with_name(_UNFINISHED + path.name)
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    for name, content in files.items():
        _write_and_flush(unfinished / name, content)
    sync_folder(unfinished)
    _remove_checkpoint(path)  # a damaged one that the run has passed again
    unfinished.rename(path)
    sync_folder(path.parent)


def _remove_checkpoint(path: Path) -> None:
    """Its name first, so that half of it is never taken for a checkpoint."""
    if path.is_dir():
        old = path.with_name(_UNFINISHED + "old-" + path.name)
        shutil.rmtree(old, ignore_errors=True)
        path.rename(old)
        shutil.rmtree(old)


def _remove_others(folder: RunFolder, present: set[str]) -> None:
    kept = {folder.path / name for name in present}
    checkpoints = folder.checkpoints(folder.run())
    for path in map(checkpoints.path_of, checkpoints.steps()):
        if path / MANIFEST not in kept:
            _remove_checkpoint(path)
    for path in sorted(folder.logs.rglob("*"), reverse=True):  # what is in a folder before the folder
        if path.is_dir():
            if not any(path.iterdir()):
                path.rmdir()
        elif path not in kept:
            path.unlink()
