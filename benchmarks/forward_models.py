"""What a look-ahead costs on each forward model: ``python benchmarks/forward_models.py``.

Environments that the batch does not know are simulated by the pool alone.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_mcbs import SnapshotEnvWrapper
from sb3_mcbs.models import ForwardModelError, LocalEnvironments, make_forward_model

COLUMNS = ("read root", "set roots", "copy rows", "step", "per row", "env.step")


def quickest(call: Callable[[], Any], repetitions: int) -> float:
    """Seconds of the quickest of many calls, which other processes disturbed least."""
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def measure(env_id: str, kind: str, rows: int, n_threads: int, repetitions: int) -> list[float]:
    """Microseconds for each of :data:`COLUMNS`.

    :raises ForwardModelError: if this kind of model cannot simulate the environment.
    """
    env = SnapshotEnvWrapper(gym.make(env_id))
    env.reset(seed=0)
    model = make_forward_model(LocalEnvironments([env]), kind, n_threads)
    rng = np.random.default_rng(0)
    env.action_space.seed(0)
    actions = np.stack([env.action_space.sample() for _ in range(rows)])
    root, index = model.read_roots([0]), np.zeros(rows, dtype=int)
    half = np.repeat(np.arange(rows // 2), 2)

    def fresh_step() -> float:
        model.set_roots(root, index, rng)
        start = time.perf_counter()
        model.step(actions)
        return time.perf_counter() - start

    step = sorted(fresh_step() for _ in range(repetitions))[0]
    seconds = [
        quickest(lambda: model.read_roots([0]), repetitions),
        quickest(lambda: model.set_roots(root, index, rng), repetitions),
        quickest(lambda: model.select(half), repetitions),
        step,
        step / rows,
        quickest(lambda: env.step(actions[0]), repetitions),
    ]
    model.close()
    return [second * 1e6 for second in seconds]


def main() -> None:
    """Print one line per environment and model."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--env", nargs="+", default=["HalfCheetah-v5", "Walker2d-v5", "Ant-v5", "Humanoid-v5"]
    )
    parser.add_argument("--rows", type=int, default=18, help="even number of simulated states")
    parser.add_argument("--n-threads", type=int, default=0)
    parser.add_argument("--repetitions", type=int, default=100)
    args = parser.parse_args()
    title = f"{args.rows} rows, microseconds"
    print(f"{title:<34}" + "".join(f"{name:>11}" for name in COLUMNS))
    for env_id in args.env:
        for kind in ("mujoco", "pool"):
            try:
                values = measure(env_id, kind, args.rows, args.n_threads, args.repetitions)
                cells = "".join(f"{value:11.1f}" for value in values)
            except ForwardModelError as reason:
                cells = f" cannot: {reason}"
            print(f"{env_id:<26}{kind:<8}{cells}", flush=True)


if __name__ == "__main__":
    main()
