"""Model files for the tests, with parts replaced as a stranger could replace them."""

import base64
import io
import json
import pickle
import struct
import zipfile
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3 import TD3

from sb3_mcbs.agents.registry import ALGORITHMS


def save_agent(make_agent, folder: Path, cls: type = TD3, **settings):
    """Make an agent and save it.

    :return: the agent, and the path of its file
    """
    agent = make_agent(cls=cls, **settings)
    path = folder / f"{cls.__name__}.zip"
    agent.save(path)
    return agent, path


def untrained_agent(repo: str, filename: str) -> str:
    """Write the file of an untrained agent in place of one from the hub."""
    algo, _, env_id = repo.removeprefix("sb3/").partition("-")
    ALGORITHMS[algo]("MlpPolicy", env_id.replace("-v3", "-v4"), buffer_size=10, device="cpu").save(filename)
    return filename


def assert_same_agent(loaded, other, n=64):
    """Actions and values are equal to the bit."""
    space = other.observation_space
    rng = np.random.default_rng(0)
    observations = rng.normal(scale=2, size=(n, *space.shape)).astype(space.dtype)
    actions, _ = other.predict(observations, deterministic=True)
    np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], actions)
    with th.no_grad():
        inputs = th.as_tensor(observations).float(), th.as_tensor(actions)
        for left, right in zip(loaded.critic(*inputs), other.critic(*inputs), strict=True):
            assert th.equal(left, right)
    assert loaded.gamma == other.gamma


class Payload:
    """A pickle that writes a file when it is opened."""

    def __init__(self, flag: Path) -> None:
        self.flag = flag

    def __reduce__(self):
        return Path.write_text, (self.flag, "executed")


def payload_entry(flag: Path, **readable) -> dict:
    """An entry of the JSON as SB3 writes what is not JSON, whose pickle is a payload."""
    return {":serialized:": base64.b64encode(pickle.dumps(Payload(flag))).decode(), **readable}


def members_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write(path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def with_data(path: Path, target: Path, **entries) -> Path:
    """Copy a model file with other entries in its JSON; Ellipsis removes one."""
    members = members_of(path)
    data = json.loads(members["data"]) | entries
    members["data"] = json.dumps({key: value for key, value in data.items() if value is not ...}).encode()
    return write(target, members)


def tensors_of(path: Path) -> dict[str, th.Tensor]:
    return th.load(io.BytesIO(members_of(path)["policy.pth"]), weights_only=True)


def with_policy(path: Path, target: Path, state, **save_kwargs) -> Path:
    """Copy a model file with another ``policy.pth``."""
    stream = io.BytesIO()
    th.save(state, stream, **save_kwargs)
    return write(target, {**members_of(path), "policy.pth": stream.getvalue()})


def _change_headers(content: bytes, name: str, field_at: int, value: bytes) -> bytes:
    """Rewrite a field of a member's two headers in a zip file; in the directory's it lies two bytes later."""
    changed = bytearray(content)
    for signature, name_at, later in ((b"PK\x01\x02", 46, 2), (b"PK\x03\x04", 30, 0)):
        at = -1
        while (at := content.find(signature, at + 1)) >= 0:
            if content[at + name_at :].startswith(name.encode()):
                changed[at + field_at + later : at + field_at + later + len(value)] = value
    return bytes(changed)


def claim_size(content: bytes, name: str, size: int) -> bytes:
    """Rewrite the uncompressed size that a zip file claims for a member."""
    return _change_headers(content, name, 22, struct.pack("<I", size))


def claim_encryption(content: bytes, name: str) -> bytes:
    """Set the flag that says that a member is encrypted."""
    return _change_headers(content, name, 6, struct.pack("<H", 1))
