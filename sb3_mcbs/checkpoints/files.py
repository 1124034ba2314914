"""The files that a run writes line by line: Monitor's, and those of the logger."""

import io
import os
import sys
import tempfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HumanOutputFormat,
    JSONOutputFormat,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor

from sb3_mcbs.checkpoints.errors import CheckpointError

#: Kind of a log file -> what writes it, and how its name ends.
_FILE_FORMATS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "log": (HumanOutputFormat, (".txt", ".log")),
    "json": (JSONOutputFormat, (".json", ".jsonl")),
    "csv": (CSVOutputFormat, (".csv",)),
}


class Unopened(io.StringIO):
    """Takes the place of a log file until the run goes on: what is written until then is dropped.

    Opening it would empty it, also for a run that is then refused or never continued.

    :param path: the file.
    """

    def __init__(self, path: str) -> None:
        super().__init__()
        self.name = path


def read_written(handle: IO[Any] | None) -> np.ndarray | None:
    """Return what a file that is open for writing holds so far.

    :param handle: the open file, if there is one.
    :return: its bytes, ``[size]`` uint8.
    """
    if handle is None:
        return None
    if isinstance(handle, Unopened):
        return np.empty(0, np.uint8)
    handle.flush()
    return np.fromfile(handle.name, np.uint8)


def write_again(handle: Any, content: np.ndarray | None) -> None:
    """Make a file that is open for writing hold what it held, and go on from there.

    :param handle: the open file, if there is one.
    :param content: from :func:`read_written`.
    """
    if handle is None or content is None:
        return
    text = content.tobytes().decode(handle.encoding)
    handle.seek(0)
    handle.truncate()
    handle.write(text)
    handle.flush()


def describe_format(output_format: Any) -> tuple[str, str | None]:
    """Say what an output format of the logger writes.

    :param output_format: one of SB3's.
    :return: its kind, and the file or folder.
    :raises CheckpointError: if it is of another class.
    """
    if type(output_format) is TensorBoardOutputFormat:
        return "tensorboard", os.path.abspath(output_format.writer.log_dir)
    for kind, (cls, _) in _FILE_FORMATS.items():
        if type(output_format) is cls:
            if kind == "log" and not output_format.own_file:
                return "stdout", None
            return kind, os.path.abspath(output_format.file.name)
    raise CheckpointError(
        f"The logger writes to a {type(output_format).__name__}, whose position in its output is not known. "
        "Use SB3's output formats."
    )


def file_of(part: Any) -> IO[Any] | None:
    """Return the file that a part of a run writes line by line, if it does.

    :param part: an output format of the logger, a ``Monitor`` or ``VecMonitor``, or anything else.
    """
    if isinstance(part, Monitor | VecMonitor):
        return None if part.results_writer is None else part.results_writer.file_handler
    if not isinstance(part, KVWriter):
        return None
    kind, path = describe_format(part)
    return part.file if path is not None and kind != "tensorboard" else None  # type: ignore[attr-defined]


def make_logger(
    folder: str | None, formats: list[tuple[str, str | None]], purge_step: int, roots: list[Path]
) -> Logger:
    """Make a logger that goes on where another one was, once :func:`open_log_files` has opened its files.

    :param folder: the logger's folder; another one takes its place if it is in none of the roots.
    :param formats: from :func:`describe_format`.
    :param purge_step: TensorBoard forgets what was logged at this step and later.
    :param roots: folders that files may be in.
    :raises CheckpointError: if a file is in none of them.
    """
    if folder is not None and not _is_below(folder, roots):
        folder = tempfile.gettempdir()  # within which SB3 has it by default
    return Logger(folder, [_make_format(kind, path, purge_step, roots) for kind, path in formats])


def open_log_files(logger: Logger) -> None:
    """Open the files of a logger that :func:`make_logger` made. They are empty then.

    :param logger: any logger; what is open stays as it is.
    """
    for output_format in logger.output_formats:
        file = getattr(output_format, "file", None)
        if isinstance(file, Unopened):
            Path(file.name).parent.mkdir(parents=True, exist_ok=True)
            output_format.file = open(file.name, "w+")  # type: ignore[attr-defined]  # noqa: SIM115


def _make_format(kind: str, path: str | None, purge_step: int, roots: list[Path]) -> KVWriter:
    if kind == "stdout" or path is None:
        return HumanOutputFormat(sys.stdout)
    check_below(path, roots)
    if kind == "tensorboard":
        output_format = TensorBoardOutputFormat.__new__(TensorBoardOutputFormat)
        output_format.writer = _make_writer(path, purge_step)
        output_format._is_closed = False
        return output_format
    make, suffixes = _FILE_FORMATS.get(kind, (None, ()))
    if not path.endswith(suffixes):
        raise CheckpointError(f"The checkpoint names {path!r} as a log file of kind {kind!r}.")
    output_format = make(os.devnull)
    output_format.file.close()
    output_format.file = Unopened(path)
    return output_format


def _make_writer(folder: str, purge_step: int) -> Any:
    from torch.utils.tensorboard import SummaryWriter

    class LateWriter(SummaryWriter):
        """Makes its file, which hides what was logged later, with the first value that is logged."""

        is_made = False

        def _get_file_writer(self) -> Any:
            return super()._get_file_writer() if self.is_made else None

    writer = LateWriter(log_dir=folder, purge_step=purge_step)
    writer.is_made = True
    return writer


def check_below(path: str, roots: list[Path]) -> None:
    """Refuse a file elsewhere: a checkpoint from a stranger could name any.

    :param path: where a run wrote to.
    :param roots: folders that it may be in.
    :raises CheckpointError: if it is in none of them.
    """
    if not _is_below(path, roots):
        raise CheckpointError(
            f"The run logged to {Path(path).resolve()}, which is neither below the present folder nor "
            "beside its checkpoints. If you want it to go on writing there, pass log_folder= with a folder "
            "above it."
        )


def _is_below(path: str, roots: list[Path]) -> bool:
    resolved = Path(path).resolve()
    return any(resolved.is_relative_to(root.resolve()) for root in roots)
