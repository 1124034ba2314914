"""Whether gradient steps in CUDA graphs are right and fast on this machine's GPU: ``make check-gpu``.

Runs ``tests/test_gpu.py``, then measures gradient steps and whole trainings on HalfCheetah-v5. Takes less
than six minutes. It needs this package with its tests, and pytest.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from benchmarks.common import parse_args, print_table, write
from benchmarks.training_worker import RECIPE, SIZES, settings
from sb3_mcbs import MCBSDDPG, MCBSSAC, MCBSTD3, MCBSTQC, MCBSCrossQ

ENV = "HalfCheetah-v5"
TESTS = Path(__file__).parents[1] / "tests" / "test_gpu.py"
#: An agent of SB3, and ours.
AGENTS: dict[str, tuple[type[OffPolicyAlgorithm], type[OffPolicyAlgorithm]]] = {
    "TD3": (TD3, MCBSTD3),
    "DDPG": (DDPG, MCBSDDPG),
    "SAC": (SAC, MCBSSAC),
    "TQC": (TQC, MCBSTQC),
    "CrossQ": (CrossQ, MCBSCrossQ),
}
_SIZE = dict(zip(("beam_width", "rollout_depth", "n_simulations"), SIZES["MCBSTD3 (6,3,5)"], strict=True))
#: Trainings: the class, and its settings.
TRAININGS: dict[str, tuple[type[OffPolicyAlgorithm], dict[str, Any]]] = {
    "SB3 TD3": (TD3, {}),
    "MCBSTD3 without search": (MCBSTD3, {"search_share": 0.0}),
    "the same without CUDA graphs": (MCBSTD3, {"search_share": 0.0, "cuda_graphs": False}),
    "Algorithm 1 (6,3,5)": (MCBSTD3, _SIZE),
    "HalfCheetah's entry": (MCBSTD3, RECIPE),
}


class Outcomes:
    """Notes the outcome of every test."""

    def __init__(self) -> None:
        self.outcomes: dict[str, str] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Called by pytest after each phase of a test."""
        name = report.nodeid.partition("::")[2]
        if report.when == "call" or report.outcome != "passed":
            self.outcomes[name] = report.outcome


class StopAfter(BaseCallback):
    """Stops a training after some seconds.

    :param seconds: how long.
    """

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self._end = time.perf_counter() + seconds

    def _on_step(self) -> bool:
        return time.perf_counter() < self._end


def wait(device: str) -> None:
    """Wait until the GPU has done what it was told to do."""
    if device != "cpu":
        th.cuda.synchronize()


def make_agent(cls: type[OffPolicyAlgorithm], device: str, **kwargs: Any) -> OffPolicyAlgorithm:
    """An agent with RL Zoo's settings of TD3 for MuJoCo, after its first gradient steps."""
    own = dict(settings(1))
    if cls in AGENTS["CrossQ"]:
        del own["policy_kwargs"]  # CrossQ's default networks are part of the method
    agent = cls("MlpPolicy", make_vec_env(ENV, 1, seed=0), device=device, **own, **kwargs)
    agent.learn(own["learning_starts"] + 100)
    return agent


def gradient_step(name: str, seconds: float, device: str) -> dict[str, Any]:
    """Microseconds of a gradient step, SB3's and captured, in turn."""
    own = {"search_share": 0.0}
    theirs, ours = (
        make_agent(cls, device, **kwargs) for cls, kwargs in zip(AGENTS[name], ({}, own), strict=True)
    )
    times: dict[str, list[float]] = {"SB3": [], "graphs": []}
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(times["SB3"]) < 3:
        for arm, agent in (("SB3", theirs), ("graphs", ours)):
            wait(device)
            start = time.perf_counter()
            for _ in range(20):
                agent.train(1, 256)
            wait(device)
            times[arm].append(1e6 * (time.perf_counter() - start) / 20)
    found = {arm: float(np.median(values)) for arm, values in times.items()}
    return {"gradient step": name, "SB3 us": found["SB3"], "graphs us": found["graphs"]} | {
        "SB3 / graphs": found["SB3"] / found["graphs"]
    }


def training(name: str, seconds: float, device: str) -> dict[str, Any]:
    """Steps per second of a training."""
    cls, kwargs = TRAININGS[name]
    agent = make_agent(cls, device, **kwargs)
    before, start = agent.num_timesteps, time.perf_counter()
    agent.learn(10**9, callback=StopAfter(seconds), reset_num_timesteps=False)
    wait(device)
    steps = agent.num_timesteps - before
    return {"training": name, "steps": steps, "steps/s": steps / (time.perf_counter() - start)}


def main() -> None:
    """Check, measure, print, write.

    :raises SystemExit: if there is no GPU, or a check failed.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="for each training")
    args = parse_args(parser)
    if not th.cuda.is_available():
        raise SystemExit("There is no GPU that torch can use: torch.cuda.is_available() is False.")
    gpu = {"GPU": th.cuda.get_device_name(), "CUDA": str(th.version.cuda)}
    print(gpu)
    outcomes = Outcomes()
    pytest.main([str(TESTS), "-q", "-p", "no:cacheprovider"], plugins=[outcomes])
    print_table(["check", "outcome"], list(outcomes.outcomes.items()))

    steps = [gradient_step(name, args.seconds / 10, "cuda") for name in AGENTS]
    print_table(list(steps[0]), [list(row.values()) for row in steps])
    trainings = [training(name, args.seconds, "cuda") for name in TRAININGS]
    for row in trainings:
        row["of SB3's"] = row["steps/s"] / trainings[0]["steps/s"]
    print_table(list(trainings[0]), [list(row.values()) for row in trainings])
    write(
        "check_gpu",
        {**gpu, "checks": outcomes.outcomes, "gradient steps": steps, "trainings": trainings},
    )
    failed = [name for name, outcome in outcomes.outcomes.items() if outcome != "passed"]
    if failed or not outcomes.outcomes:
        sys.exit(f"Not passed: {', '.join(failed) or 'no test ran'}")


if __name__ == "__main__":
    main()
