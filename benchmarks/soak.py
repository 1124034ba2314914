"""An hour of training with everything on: do memory, threads or open files grow?

HalfCheetah-v5 in four worker processes, look-ahead, evaluations and exact checkpoints. Measuring starts when
the replay buffer is full, since NumPy takes its pages only when they are first written to. The time inside
the checkpoint callback is measured as well.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from benchmarks import NETWORKS
from benchmarks.common import parse_args, print_table, write, write_picture
from sb3_mcbs import MCBSTD3, ExactCheckpointCallback, SnapshotEnvWrapper

N_ENVS = 4


class TimedCheckpoints(ExactCheckpointCallback):
    """Adds up the time that checkpoints take."""

    not_checkpointed = ("seconds",)

    def __init__(self, save_freq: int, path: Path) -> None:
        super().__init__(save_freq, path)
        self.seconds = 0.0

    def _on_rollout_start(self) -> None:
        start = time.perf_counter()
        super()._on_rollout_start()
        self.seconds += time.perf_counter() - start


class Watch(BaseCallback):
    """Samples this process and its workers, and stops training in the end.

    :param seconds: to measure, once the replay buffer is full.
    :param every: seconds between two samples.
    :param checkpoints: whose time is noted.
    """

    not_checkpointed = ("seconds", "every", "checkpoints", "samples")

    def __init__(self, seconds: float, every: float, checkpoints: TimedCheckpoints) -> None:
        super().__init__()
        self.seconds, self.every, self.checkpoints = seconds, every, checkpoints
        self.samples: list[dict[str, Any]] = []

    def _on_step(self) -> bool:
        assert isinstance(self.model, MCBSTD3) and self.model.replay_buffer is not None
        if not self.model.replay_buffer.full:
            return True
        now = time.perf_counter()
        if not self.samples or now - self.samples[-1]["clock"] >= self.every:
            self.samples.append(self._sample(now))
            print({name: value for name, value in self.samples[-1].items() if name != "clock"}, flush=True)
        return now - self.samples[0]["clock"] < self.seconds

    def _sample(self, now: float) -> dict[str, Any]:
        base = self.training_env.unwrapped
        assert isinstance(base, SubprocVecEnv)
        return {
            "clock": now,
            "steps": self.num_timesteps,
            "memory": resident(os.getpid()),
            "memory of workers": sum(resident(process.pid or 0) for process in base.processes),
            "threads": len(os.listdir("/proc/self/task")),
            "open files": len(os.listdir("/proc/self/fd")),
            "checkpoint seconds": self.checkpoints.seconds,
        }


def resident(pid: int) -> float:
    """Resident memory of a process in MB.

    :param pid: the process.
    """
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def soak(folder: Path, seconds: float, every: float, buffer_size: int = 20_000) -> list[dict[str, Any]]:
    """Train and watch.

    :param folder: for checkpoints and evaluations.
    :param seconds: to measure.
    :param every: seconds between two samples.
    :param buffer_size: of the replay buffer.
    :return: the samples.
    """
    vec_env = make_vec_env(
        "HalfCheetah-v5",
        N_ENVS,
        seed=0,
        monitor_dir=str(folder / "monitor"),
        vec_env_cls=SubprocVecEnv,
        wrapper_class=SnapshotEnvWrapper,
    )
    agent = MCBSTD3(
        "MlpPolicy",
        vec_env,
        learning_starts=min(10_000, buffer_size // 2),
        buffer_size=buffer_size,
        policy_kwargs=dict(NETWORKS),
        seed=0,
        device="cpu",
    )
    checkpoints = TimedCheckpoints(10_000, folder / "checkpoints")
    evaluation = EvalCallback(
        make_vec_env("HalfCheetah-v5", 1, seed=1000),
        n_eval_episodes=1,
        eval_freq=10_000 // N_ENVS,
        log_path=str(folder),
        best_model_save_path=str(folder),
        verbose=0,
        warn=False,
    )
    watch = Watch(seconds, every, checkpoints)
    agent.learn(10**9, callback=[checkpoints, evaluation, watch])
    vec_env.close()
    return watch.samples


def draw(samples: list[dict[str, Any]]) -> None:
    """Draw memory over time.

    :param samples: from :func:`soak`.
    """
    minutes = [(sample["clock"] - samples[0]["clock"]) / 60 for sample in samples]
    figure, axes = plt.subplots(figsize=(7, 4))
    for name, label in (("memory", "training process"), ("memory of workers", "four workers")):
        axes.plot(minutes, [sample[name] - samples[0][name] for sample in samples], label=label)
    axes.set_xlabel("minutes since the replay buffer is full")
    axes.set_ylabel("growth of resident memory (MB)")
    axes.legend()
    figure.tight_layout()
    write_picture(figure, "soak.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60)
    arguments = parse_args(parser)
    th.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="sb3-mcbs-soak-") as folder:
        samples = soak(Path(folder), arguments.minutes * 60, 30)
    first, last = samples[0], samples[-1]
    rows = [
        [name, first[name], last[name], last[name] - first[name]]
        for name in ("steps", "memory", "memory of workers", "threads", "open files", "checkpoint seconds")
    ]
    print_table(["what", "first", "last", "difference"], rows)
    share = (last["checkpoint seconds"] - first["checkpoint seconds"]) / (last["clock"] - first["clock"])
    print(f"Time inside the checkpoint callback: {100 * share:.2f} % of the wall-clock time")
    write("soak", {"samples": samples, "share of checkpoints": share})
    draw(samples)


if __name__ == "__main__":
    main()
