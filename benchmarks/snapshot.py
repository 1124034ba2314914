"""What snapshots cost: ``python benchmarks/snapshot.py [environment ids]`` prints a table."""

import argparse
import time
import warnings
from collections.abc import Callable

import gymnasium as gym
import mujoco
import numpy as np

from sb3_mcbs.snapshot import SnapshotEnvWrapper

IDS = (
    "HalfCheetah-v5",
    "Walker2d-v5",
    "Swimmer-v5",
    "Hopper-v5",
    "Ant-v5",
    "Humanoid-v5",
    "Pendulum-v1",
    "MountainCarContinuous-v0",
)


def microseconds(function: Callable[[], object], seconds: float = 0.1, rounds: int = 5) -> float:
    """Time a call: the best of several rounds, as other programs only ever make it slower.

    :param function: what to call.
    :param seconds: how long a round lasts, about.
    :param rounds: number of rounds.
    :return: microseconds per call.
    """
    start = time.perf_counter()
    function()
    calls = max(1, int(seconds / (time.perf_counter() - start)))
    best = float("inf")
    for _ in range(rounds):
        start = time.perf_counter()
        for _ in range(calls):
            function()
        best = min(best, (time.perf_counter() - start) / calls)
    return 1e6 * best


def state_reader(env: SnapshotEnvWrapper) -> Callable[[], object] | None:
    """Return what a decision reads from a live MuJoCo environment: the integration state and the observation.

    :param env: the environment.
    :return: the call to time, None without MuJoCo.
    """
    inner = env.unwrapped
    model, data = getattr(inner, "model", None), getattr(inner, "data", None)
    if model is None or data is None:
        return None
    spec = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(model, spec))

    def read() -> object:
        mujoco.mj_getState(model, data, state, spec)
        return env.last_observation

    return read


def measure(name: str) -> list[str]:
    """Measure one environment.

    :param name: its id.
    :return: the cells of its row.
    """
    env = SnapshotEnvWrapper(gym.make(name))
    env.reset(seed=0)
    action = env.action_space.sample()
    for _ in range(20):
        env.step(action)
    state = env.snapshot()
    read = state_reader(env)
    times = [
        microseconds(env.snapshot),
        microseconds(lambda: env.restore(state)),
        microseconds(env.clone),
        float("nan") if read is None else microseconds(read),
        microseconds(lambda: env.step(action)),
    ]
    return [name, *("-" if np.isnan(value) else f"{value:.1f}" for value in times)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ids", nargs="*", default=IDS, help="environments to measure")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    print("microseconds per call, best of 5 rounds")
    header = ["environment", "snapshot", "restore", "clone", "state read", "env.step"]
    print("".join(f"{cell:>26}" if place == 0 else f"{cell:>12}" for place, cell in enumerate(header)))
    for name in arguments.ids:
        cells = measure(name)
        print("".join(f"{cell:>26}" if place == 0 else f"{cell:>12}" for place, cell in enumerate(cells)))


if __name__ == "__main__":
    main()
