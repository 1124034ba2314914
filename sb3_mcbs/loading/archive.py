"""Reads zip files from strangers: named members only, in memory, up to a size."""

import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

MAX_FILE_BYTES = 2**30

#: The other methods decompress whole blocks before a limit can stop them.
_BOUNDED_COMPRESSION = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


class AgentFileError(ValueError):
    """A file is damaged, too large, or not what it should be."""


@contextmanager
def about(path: Path) -> Iterator[None]:
    """Put the name of a file in front of a ``ValueError`` about it."""
    try:
        yield
    except ValueError as reason:
        kind = AgentFileError if isinstance(reason, AgentFileError) else ValueError
        raise kind(f"{path}: {reason}") from reason


@contextmanager
def reading(what: str) -> Iterator[None]:
    """Turn any exception of a file reader into an ``AgentFileError``.

    :param what: the part of the file that is read.
    """
    try:
        yield
    except AgentFileError:
        raise
    except Exception as reason:  # zip, JSON and torch readers fail in too many ways to list
        raise AgentFileError(
            f"{what} cannot be read, the file is damaged or of another kind "
            f"({type(reason).__name__}: {str(reason)[:300]})."
        ) from reason


def read_members(path: Path, limits: Mapping[str, int]) -> tuple[dict[str, bytes], list[str]]:
    """Read members of a zip file into memory; nothing is extracted, so names cannot point anywhere.

    :param path: the zip file.
    :param limits: the exact names to read, and how many bytes each may have.
    :return: the content of those that the file has, and the names of all its members.
    :raises FileNotFoundError: if there is no such file.
    :raises AgentFileError: if the zip file is damaged or names a member twice, or if a member to be read is
        encrypted, compressed in an unusual way or too large.
    """
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise AgentFileError(f"the file has {size} bytes; at most {MAX_FILE_BYTES} are read.")
    with reading("the zip file"), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        names = [info.filename for info in members]
        repeated = [name for name, count in Counter(names).items() if count > 1]
        if repeated:
            raise AgentFileError(
                f"there is more than one member {repeated[0]!r}; readers may differ on which they read."
            )
        contents = {
            info.filename: _read_member(archive, info, limits[info.filename])
            for info in members
            if info.filename in limits
        }
        return contents, names


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, limit: int) -> bytes:
    too_large = AgentFileError(f"member {info.filename!r} has more than {limit} bytes.")
    if info.file_size > limit:
        raise too_large
    if info.flag_bits & 1:
        raise AgentFileError(f"member {info.filename!r} is encrypted.")
    if info.compress_type not in _BOUNDED_COMPRESSION:
        raise AgentFileError(
            f"member {info.filename!r} is compressed with method {info.compress_type}; only stored and "
            "deflated members are read."
        )
    with archive.open(info) as stream:
        content = stream.read(limit + 1)  # the size in the header may be wrong
    if len(content) > limit:
        raise too_large
    return content
