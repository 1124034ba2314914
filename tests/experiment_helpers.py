"""Experiments that are over in seconds, and their results."""

import contextlib
import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_mcbs.experiments import command
from sb3_mcbs.experiments.results import RunFolder

REPOSITORY = Path(__file__).resolve().parents[1]
TD3 = "td3_Pendulum-v1_0"
MCBS = "mcbs_td3_Pendulum-v1_0"
TINY = {"learning_starts": 100, "policy_kwargs": {"net_arch": [16]}, "batch_size": 16}
TINY_SEARCH = {**TINY, "beam_width": 2, "rollout_depth": 1, "n_simulations": 1}
SPEC: dict[str, Any] = {
    "environments": ["Pendulum-v1"],
    "seeds": [0],
    "steps": 400,
    "evaluation": {"every": 200, "episodes": 2},
    "checkpoint_every": 100,
    "arms": {
        "td3": {"algorithm": "td3", "params": TINY},
        "mcbs_td3": {"algorithm": "mcbs_td3", "params": TINY_SEARCH},
    },
}


def spec_file(folder: Path, **changes: Any) -> Path:
    """A spec of two short runs, changed."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "tiny.yml"
    path.write_text(yaml.safe_dump({**SPEC, **changes}, sort_keys=False))
    return path


def begin(spec: Path, output: Path, *words: str) -> subprocess.Popen:
    """Start the command in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "sb3_mcbs.cli", "experiment", str(spec), "-o", str(output), *words],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def run(spec: Path, output: Path, *words: str) -> tuple[int, str]:
    """Run the command to its end, in this process, which saves the imports."""
    text = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(text):
        patch.setattr(sys, "argv", ["sb3-mcbs experiment", str(spec), "-o", str(output), *words])
        try:
            command.main()
        except SystemExit as stopped:
            return int(stopped.code or 0), text.getvalue()
    raise AssertionError("the command ends with a status")


def read_until(process: subprocess.Popen, words: str) -> str:
    """What a process prints until it prints these words."""
    assert process.stdout is not None
    text = ""
    while words not in text:
        line = process.stdout.readline()
        assert line, text
        text += line
    return text


def wait_for(what: Callable[[], Any], seconds: float = 120) -> Any:
    """What a condition becomes once it is true."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        value = what()
        if value:
            return value
        time.sleep(0.02)
    raise AssertionError("waited in vain")


def folder_of(output: Path, name: str) -> RunFolder:
    return RunFolder(output / "runs" / name)


def trainers_of(folder: RunFolder) -> list[int]:
    """The numbers of the processes that train a run."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().split(b"\0")
        except OSError:
            continue
        if b"sb3_mcbs.experiments.train_run" in words and str(folder.path).encode() in words:
            found.append(int(path.parent.name))
    return found


def kill(folder: RunFolder) -> None:
    for pid in trainers_of(folder):
        os.kill(pid, signal.SIGKILL)


def final(folder: RunFolder) -> dict[str, Any]:
    """What a finished run leaves: networks, evaluations without their times, training returns."""
    definition = folder.run()
    training = folder.training(definition)
    _, networks, _ = load_from_zip_file(training / f"{definition.environment}.zip", device="cpu")
    found: dict[str, Any] = {
        f"{part}.{name}": value.numpy()
        for part, values in networks.items()
        if part == "policy"
        for name, value in values.items()
        if isinstance(value, th.Tensor)
    }
    for place in folder.evaluations(definition):
        if (place / "evaluations.npz").is_file():
            with np.load(place / "evaluations.npz") as data:
                found |= {f"{place.parent.name}.{name}": data[name] for name in data if name != "seconds"}
    lines = (training / "0.monitor.csv").read_text().splitlines()[2:]
    found["returns"] = np.array([line.split(",")[:2] for line in lines])
    return found


def assert_equal(one: RunFolder, other: RunFolder) -> None:
    left, right = final(one), final(other)
    assert left.keys() == right.keys() and len(left) > 10
    for name in left:
        np.testing.assert_array_equal(left[name], right[name], err_msg=name)
