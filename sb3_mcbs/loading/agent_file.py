"""Reads an SB3 model file without opening its pickles."""

import io
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch as th
from torch import nn

from sb3_mcbs.loading.archive import AgentFileError, about, read_members, reading

MAX_DATA_BYTES = 2**24
MAX_POLICY_BYTES = 2**29


@dataclass(frozen=True)
class AgentFile:
    """The parts of a model file that are data.

    :param path: the file.
    :param data: the JSON entries; an entry that :func:`is_pickled` holds a pickle as text.
    :param tensors: the policy's parameters by name.
    :param unread: the members that were not read.
    """

    path: Path
    data: dict[str, Any]
    tensors: dict[str, th.Tensor]
    unread: list[str]


def is_pickled(entry: Any) -> bool:
    """Whether SB3 stored an entry of the JSON as a pickle, which its own loader would open."""
    return isinstance(entry, dict) and ":serialized:" in entry


def read_agent_file(path: str | Path) -> AgentFile:
    """Read the JSON and the policy's parameters.

    :param path: a zip file that ``save`` of an SB3 algorithm wrote; ``.zip`` may be left out.
    :return: the file's content.
    :raises FileNotFoundError: if there is no such file.
    :raises AgentFileError: if the file is damaged, too large or of another kind.
    """
    path = Path(path)
    if not path.is_file():
        path = path.with_name(f"{path.name}.zip")
    with about(path):
        contents, names = read_members(path, {"data": MAX_DATA_BYTES, "policy.pth": MAX_POLICY_BYTES})
        for name in ("data", "policy.pth"):
            if name not in contents:
                raise AgentFileError(f"this is no SB3 model file: it has no member {name!r}.")
        with reading("'data'"):
            data = json.loads(contents["data"].decode())
        if not isinstance(data, dict):
            raise AgentFileError(f"'data' must be a JSON object, not a {type(data).__name__}.")
        tensors = _read_tensors(contents["policy.pth"])
    return AgentFile(path, data, tensors, [name for name in names if name not in contents])


def _read_tensors(content: bytes) -> dict[str, th.Tensor]:
    with reading("'policy.pth'"):
        if content.startswith(b"PK\x03\x04"):
            # Torch stores its members uncompressed; compressed ones could be larger than the file.
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                if sum(info.file_size for info in archive.infolist()) > len(content):
                    raise AgentFileError("the members of 'policy.pth' are larger than their file.")
        state = th.load(io.BytesIO(content), map_location="cpu", weights_only=True, mmap=False)
    if not isinstance(state, dict):
        raise AgentFileError(f"'policy.pth' must hold tensors by name, not a {type(state).__name__}.")
    n_bytes = 0
    for name, tensor in state.items():
        _check_kind(name, tensor)
        n_bytes += tensor.numel() * tensor.element_size()
        # Tensors may share memory or repeat it, so a small file can claim any size.
        if n_bytes > len(content):
            raise AgentFileError("the tensors of 'policy.pth' are larger than their file.")
    for name, tensor in state.items():
        if not bool(th.isfinite(tensor).all()):
            raise AgentFileError(f"tensor {name!r} has values that are infinite or not a number.")
        if name.endswith(".ra_var") and bool((tensor < 0).any()):
            raise AgentFileError(f"tensor {name!r} has variances below 0.")
    return {name: tensor.detach() for name, tensor in state.items()}


def _check_kind(name: Any, tensor: Any) -> None:
    if not isinstance(name, str) or type(tensor) not in (th.Tensor, nn.Parameter):
        raise AgentFileError(f"'policy.pth' must hold only tensors by name; {str(name)[:80]!r} is not.")
    is_counter = tensor.dtype == th.int64 and tensor.dim() == 0  # of batch renormalization
    is_number = tensor.dtype == th.float32 or is_counter
    if not is_number or tensor.layout != th.strided or tensor.device.type != "cpu":
        raise AgentFileError(
            f"tensor {name[:80]!r} must be dense float32, got {tensor.layout} {tensor.dtype} on "
            f"{tensor.device}."
        )
