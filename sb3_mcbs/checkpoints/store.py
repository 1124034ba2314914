"""Checkpoints on disk: written beside, flushed, renamed; checked by size and SHA-256 when read.

A folder of checkpoints holds ``step_N`` for every checkpoint that is kept, each with a manifest, and
``rows`` with the replay buffer's rows in files that several checkpoints share.
"""

import hashlib
import io
import json
import os
import shutil
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_mcbs.checkpoints.encoding import Encoded
from sb3_mcbs.checkpoints.errors import CheckpointError

FORMAT = 1
MANIFEST, STATE, ARRAYS, ROWS = "manifest.json", "state.json", "arrays.npz", "rows"
_UNFINISHED = ".unfinished-"
STEP = "step_"
#: More than any manifest needs: a file from a stranger is not read without a limit.
_MAX_MANIFEST = 16 * 2**20


class Checkpoint(NamedTuple):
    """A checkpoint that was read and found whole, all but the replay buffer's rows.

    :param manifest: what it says about itself.
    :param state: its arrays are by section and dtype.
    """

    manifest: dict[str, Any]
    state: Encoded


#: What a file must be, as JSON has it: its size and the SHA-256 of its content.
Seal = list[Any]


def write_file(path: Path, write: Callable[[Any], Any]) -> Seal:
    """Write a file and have it on the disk when this returns.

    :param path: the file.
    :param write: called with the open file.
    """
    with open(path, "w+b") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())
        return _seal_of(file)


def _seal_of(file: io.BufferedRandom | io.BufferedReader) -> Seal:
    file.seek(0)
    return [os.fstat(file.fileno()).st_size, hashlib.file_digest(file, "sha256").hexdigest()]


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> Seal:
    """Write arrays as an uncompressed npz.

    :param path: the file.
    :param arrays: without objects.
    """
    return write_file(path, lambda file: np.savez(file, allow_pickle=False, **arrays))


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read an npz that :func:`write_arrays` wrote.

    :param path: the file.
    :raises CheckpointError: if it is something else.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise CheckpointError(f"{path} is compressed, which no checkpoint is.")
        with np.load(path, allow_pickle=False) as loaded:
            return {name: loaded[name] for name in loaded.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error


def sync_folder(folder: Path) -> None:
    """Have the names of a folder's files on the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


class Store:
    """A folder of checkpoints.

    :param folder: the folder.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.rows_folder = self.folder / ROWS

    def steps(self) -> list[int]:
        """Return the environment steps at which there are checkpoints, newest first."""
        names = [path.name for path in self.folder.glob(STEP + "*")] if self.folder.is_dir() else []
        numbers = [name.removeprefix(STEP) for name in names]
        return sorted((int(number) for number in numbers if number.isdecimal()), reverse=True)

    def path_of(self, step: int) -> Path:
        """Return the folder of a checkpoint.

        :param step: environment steps.
        """
        return self.folder / f"{STEP}{step:012d}"

    def write_rows(self, first: int, end: int, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
        """Write rows of the replay buffer.

        :param first: number of the first row, counted since the beginning.
        :param end: one more than the number of the last row.
        :param arrays: the rows.
        :return: how a manifest refers to the file.
        """
        self.rows_folder.mkdir(parents=True, exist_ok=True)
        name = f"{first:012d}-{end:012d}.npz"
        unfinished = self.rows_folder / (_UNFINISHED + name)
        with _removed_if_it_fails(unfinished):
            seal = write_arrays(unfinished, arrays)
        os.replace(unfinished, self.rows_folder / name)
        sync_folder(self.rows_folder)
        return {"name": name, "first": first, "end": end, "seal": seal}

    def write(self, step: int, manifest: dict[str, Any], state: Encoded) -> None:
        """Write a checkpoint; it appears whole or not at all.

        :param step: environment steps.
        :param manifest: what it says about itself; the seals of its files are added.
        :param state: its arrays are by section and dtype.
        """
        final = self.path_of(step)
        unfinished = self.folder / (_UNFINISHED + final.name)
        _remove(unfinished)
        with _removed_if_it_fails(unfinished):
            unfinished.mkdir(parents=True)
            files = {
                STATE: write_file(unfinished / STATE, lambda file: file.write(_dumps(state.json))),
                ARRAYS: write_arrays(unfinished / ARRAYS, state.arrays),
            }
            sealed = seal_manifest({**manifest, "files": files})
            write_file(unfinished / MANIFEST, lambda file: file.write(_dumps(sealed)))
            sync_folder(unfinished)
        if final.exists():  # a damaged one that a resumed run has passed again
            _remove(final)
        os.rename(unfinished, final)
        sync_folder(self.folder)

    def clean(self, keep_last: int, newest: int) -> None:
        """Remove what no kept checkpoint needs.

        :param keep_last: how many checkpoints to keep.
        :param newest: environment steps of the one that was just written. There are later ones if the run was
            resumed from an older one, as it is if those are damaged: they do not count.
        """
        for step in [step for step in self.steps() if step <= newest][keep_last:]:
            _remove(self.path_of(step))
        for unfinished in (*self.folder.glob(_UNFINISHED + "*"), *self.rows_folder.glob(_UNFINISHED + "*")):
            _remove(unfinished)
        needed = set()
        for step in self.steps():
            try:
                needed |= {part["name"] for part in read_manifest(self.path_of(step))["rows"]}
            except CheckpointError:
                continue  # damaged; the next one replaces it
        for path in self.rows_folder.glob("*.npz"):
            if path.name not in needed:
                path.unlink()

    def read_rows(self, parts: list[dict[str, Any]]) -> list[dict[str, np.ndarray]]:
        """Read rows of the replay buffer.

        :param parts: how a manifest refers to them.
        :raises CheckpointError: if a file is not what the manifest says.
        """
        return [read_arrays(self._rows_file(part)) for part in parts]

    def has_rows(self, part: dict[str, Any]) -> bool:
        """Whether a file with rows is still there.

        :param part: how a manifest refers to it.
        """
        return self._rows_file(part).is_file()

    def _rows_file(self, part: dict[str, Any]) -> Path:
        name = str(part["name"])
        if Path(name).name != name:
            raise CheckpointError(f"The checkpoint names {name!r} as a file with rows.")
        return self.rows_folder / name

    def read(self, step: int) -> Checkpoint:
        """Read a checkpoint, and check that all its files are whole.

        :param step: environment steps.
        :raises CheckpointError: if one is missing, or not what the manifest says.
        """
        folder = self.path_of(step)
        manifest = read_manifest(folder)
        try:
            for name in (STATE, ARRAYS):
                check_seal(folder / name, manifest["files"][name])
            for part in manifest["rows"]:
                check_seal(self._rows_file(part), part["seal"])
            state = json.loads((folder / STATE).read_bytes())
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise CheckpointError(f"The files in {folder} are not a checkpoint: {error!r}") from error
        return Checkpoint(manifest, Encoded(state, read_arrays(folder / ARRAYS)))

    def read_newest(self) -> Checkpoint:
        """Read the newest checkpoint that is whole, with a warning about every newer one that is not.

        :raises CheckpointError: if there is none.
        """
        reasons = []
        for step in self.steps():
            try:
                checkpoint = self.read(step)
            except CheckpointError as error:
                reasons.append(str(error))
                continue
            for reason in reasons:
                message = f"A damaged checkpoint is passed over: {reason} The one at {step} steps is used."
                warnings.warn(message, stacklevel=4)
            return checkpoint
        if reasons:
            raise CheckpointError(f"No checkpoint in {self.folder} is whole. " + " ".join(reasons))
        raise CheckpointError(f"There is no checkpoint in {self.folder}.")


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read what a checkpoint says about itself.

    :param folder: the checkpoint.
    :raises CheckpointError: if it is not there, not a manifest, or of another format.
    """
    path = folder / MANIFEST
    try:
        if path.stat().st_size > _MAX_MANIFEST:
            raise CheckpointError(f"{path} is too large to be a manifest.")
        manifest = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}.") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        found = manifest.get("format") if isinstance(manifest, dict) else None
        raise CheckpointError(
            f"{path} is of format {found}, this version of sb3-mcbs reads format {FORMAT}. Resume with the "
            "version that wrote it."
        )
    if manifest != seal_manifest(manifest.get("content")):
        raise CheckpointError(f"The content of {path} is not what was written (SHA-256).")
    return manifest["content"]


def seal_manifest(content: Any) -> dict[str, Any]:
    """Put what a manifest says together with its digest.

    :param content: what it says.
    """
    return {"format": FORMAT, "sha256": hashlib.sha256(_dumps(content)).hexdigest(), "content": content}


def check_seal(path: Path, seal: Seal) -> None:
    """Refuse a file that is not what was written.

    :param path: the file.
    :param seal: what it must be.
    :raises CheckpointError: names the file and the difference.
    """
    try:
        with open(path, "rb") as file:
            found = _seal_of(file)
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error}.") from error
    if found != seal:
        raise CheckpointError(f"The content of {path} is not what was written (size, SHA-256).")


def _dumps(data: Any) -> bytes:
    return json.dumps(data, allow_nan=False, separators=(",", ":")).encode()


@contextmanager
def _removed_if_it_fails(path: Path) -> Iterator[None]:
    """Leave nothing half written: on a full disk that room is needed."""
    try:
        yield
    except BaseException:
        _remove(path)
        raise


def _remove(path: Path) -> None:
    """Remove a file or folder; a folder's name first, so that half of it is never taken for a checkpoint."""
    if path.is_dir():
        if not path.name.startswith(_UNFINISHED):
            unfinished = path.with_name(_UNFINISHED + "old-" + path.name)
            shutil.rmtree(unfinished, ignore_errors=True)
            os.rename(path, unfinished)
            path = unfinished
        shutil.rmtree(path, ignore_errors=True)
    elif path.exists():
        path.unlink()
