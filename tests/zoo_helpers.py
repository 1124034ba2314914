"""RL Zoo's training command inside the test process, where it costs no imports."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.monitor import load_results

TINY = ["learning_starts:100", "policy_kwargs:dict(net_arch=[16])", "batch_size:16"]
TINY_SEARCH = [*TINY, "beam_width:2", "rollout_depth:1", "n_simulations:1", "model_kwargs:dict(n_threads=1)"]


def zoo_train(
    monkeypatch: pytest.MonkeyPatch, folder: Path, algo: str, *words: str, env: str = "Pendulum-v1"
) -> None:
    """Run ``rl_zoo3.train`` in ``folder`` with the given command line."""
    from sb3_mcbs.zoo import train

    folder.mkdir(parents=True, exist_ok=True)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["rl_zoo3.train", "--algo", algo, "--env", env, *words])
    n_threads = th.get_num_threads()
    # Small networks are faster on one thread, most of all where several test processes run.
    th.set_num_threads(1)
    try:
        train.main()
    finally:
        th.set_num_threads(n_threads)


def monitor_rewards(run_folder: Path) -> list[float]:
    """The returns of a run's training episodes."""
    return list(load_results(str(run_folder))["r"])


def evaluations(folder: Path) -> dict[str, Any]:
    """The content of a folder's ``evaluations.npz``."""
    with np.load(folder / "evaluations.npz") as data:
        return {name: data[name] for name in data.files}
