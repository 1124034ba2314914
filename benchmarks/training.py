"""Environment steps per second in training: ``make bench-training``.

Every arm trains in a process of its own; they take turns, few steps each as the machine's speed drifts,
while the others wait. ``--sbx-python`` names an interpreter that has ``sbx-rl`` for the arm ``SBX TD3``.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib import pyplot

from benchmarks.common import machine, parse_args, print_table, write, write_picture

ARMS = (
    "SB3 TD3",
    "SB3 TD3, our update",
    "SBX TD3",
    "MCBSTD3 (6,3,1)",
    "MCBSTD3 (6,3,5)",
    "MCBSTD3 (6,3,5), medium",
    "MCBSTD3 (18,6,5)",
    "MCBSTD3, HalfCheetah's entry",
    "the usual way (6,3,5)",
)
#: Arms that are also run with several environments.
MANY = ("SB3 TD3", "MCBSTD3 (6,3,5)")
ROOT = Path(__file__).parent.parent


class Worker:
    """A training process.

    :param arm: one of :data:`ARMS`.
    :param env_id: the environment.
    :param n_envs: number of environments.
    :param sbx_python: interpreter with ``sbx-rl``.
    """

    def __init__(self, arm: str, env_id: str, n_envs: int, sbx_python: str | None) -> None:
        python = sbx_python if arm == "SBX TD3" and sbx_python else sys.executable
        command = [python, "-m", "benchmarks.training_worker", arm, env_id, str(n_envs)]
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.rates: list[float] = []
        self.parts: list[dict[str, float]] = []
        if self._read() != "ready":
            raise RuntimeError(f"{arm} did not start: {' '.join(command)}")

    def _read(self) -> str:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith(("ready", "{")):
                return line.strip()
        return ""

    def train(self, steps: int) -> None:
        """Train for some steps and note the rate."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{steps}\n")
        self.process.stdin.flush()
        answer = json.loads(self._read())
        self.rates.append(steps / answer["seconds"])
        parts = {name: 1e3 * seconds / steps for name, seconds in answer["parts"].items()}
        parts["rest"] = 1e3 * answer["seconds"] / steps - sum(parts.values())
        self.parts.append(parts)

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def measure(
    env_id: str, arms: tuple[str, ...], n_envs: int, rounds: int, steps: int, sbx_python: str | None
) -> list[dict[str, Any]]:
    """Let the arms of one environment take turns."""
    workers = {
        arm: Worker(arm, env_id, n_envs, sbx_python)
        for arm in arms
        if arm != "SBX TD3" or sbx_python is not None
    }
    for number in range(rounds):
        order = list(workers.values())
        for worker in order if number % 2 == 0 else order[::-1]:
            worker.train(steps)

    def seconds(arm: str) -> float:
        return float(np.sum(1 / np.array(workers[arm].rates)))

    results = []
    for arm, worker in workers.items():
        rates = np.array(worker.rates)
        result = {
            "env": env_id,
            "n_envs": n_envs,
            "arm": arm,
            "steps/s": float(np.median(rates)),
            "lowest": float(rates.min()),
            "highest": float(rates.max()),
            "/ SB3 TD3": seconds("SB3 TD3") / seconds(arm),
        }
        if "SBX TD3" in workers:
            result["/ SBX TD3"] = seconds("SBX TD3") / seconds(arm)
        names = sorted({name for parts in worker.parts for name in parts})
        result["ms per step"] = {
            name: round(float(np.median([parts.get(name, 0.0) for parts in worker.parts])), 3)
            for name in names
        }
        results.append(result)
        worker.close()
    return results


def draw(results: list[dict[str, Any]]) -> None:
    """Where the time of a step goes, per arm and environment."""
    names = (
        "rollouts",
        "networks outside of rollouts",
        "rest of choosing actions",
        "gradient",
        "environment",
        "rest",
    )
    envs = list(dict.fromkeys((r["env"], r["n_envs"]) for r in results))
    figure, all_axes = pyplot.subplots(len(envs), 1, figsize=(8, 1 + 1.8 * len(envs)), squeeze=False)
    for axes, (env_id, n_envs) in zip(all_axes[:, 0], envs, strict=True):
        shown = [r for r in results if (r["env"], r["n_envs"]) == (env_id, n_envs)][::-1]
        left = np.zeros(len(shown))
        for name in names:
            width = np.array([r["ms per step"].get(name, 0.0) for r in shown])
            axes.barh([r["arm"] for r in shown], width, left=left, label=name)
            left += width
        axes.set_title(f"{env_id}, {n_envs} environment{'s' if n_envs > 1 else ''}", fontsize=9)
        axes.tick_params(labelsize=7)
        axes.set_xlabel("ms per environment step", fontsize=8)
    all_axes[0, 0].legend(fontsize=7)
    figure.tight_layout()
    write_picture(figure, "training.png")


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", nargs="+", default=["HalfCheetah-v5", "Walker2d-v5"])
    parser.add_argument("--many", type=int, nargs="*", default=[4, 8], help="also as many environments")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--steps", type=int, default=30, help="in a round, of each arm")
    parser.add_argument("--sbx-python", default=None, help="interpreter that has sbx-rl")
    args = parse_args(parser)
    matplotlib.use("agg")
    print(machine())
    results: list[dict[str, Any]] = []
    for env_id in args.env:
        results += measure(env_id, ARMS, 1, args.rounds, args.steps, args.sbx_python)
    for n_envs in args.many:
        results += measure(args.env[0], MANY, n_envs, args.rounds, args.steps, None)
    header = ["env", "n_envs", "arm", "steps/s", "lowest", "highest", "/ SB3 TD3", "/ SBX TD3", "ms per step"]
    print_table(header, [[result.get(name, "") for name in header] for result in results])
    write("training", results)
    draw(results)


if __name__ == "__main__":
    main()
