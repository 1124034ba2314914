"""Whether memory grows: ``make bench-memory``.

Resident memory over many decisions, and over training steps with a replay buffer whose pages were
touched before (NumPy pages a fresh buffer in as it is filled, which looks like a leak).
"""

import argparse
import os
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib import pyplot

from benchmarks.common import machine, parse_args, print_table, write, write_picture
from sb3_mcbs import MCBSTD3

SIZE: dict[str, Any] = {"beam_width": 6, "rollout_depth": 3, "n_simulations": 5}


def resident_mb() -> float:
    """Resident memory of this process (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def make_agent(env_id: str) -> MCBSTD3:
    """A small agent whose replay buffer is in memory already."""
    agent = MCBSTD3(
        "MlpPolicy",
        env_id,
        learning_starts=200,
        buffer_size=25_000,
        batch_size=64,
        policy_kwargs={"net_arch": [64, 64]},
        seed=0,
        device="cpu",
        **SIZE,
    )
    buffer: Any = agent.replay_buffer
    for array in vars(buffer).values():
        if isinstance(array, np.ndarray):
            array[...] = 0
    agent.learn(1_000)
    return agent


def over_decisions(agent: MCBSTD3, total: int, every: int) -> list[float]:
    """Memory while deciding, with a step of the environment in between."""
    assert agent.planner is not None and agent.search_rng is not None and agent.env is not None
    observations: Any = agent._last_obs
    seen = []
    for number in range(total + 1):
        if number % every == 0:
            seen.append(resident_mb())
        result = agent.planner.plan(observations, agent.search_rng)
        observations, *_ = agent.env.step(agent.policy.unscale_action(result.actions))
    agent._last_obs = observations
    return seen


def over_training(agent: MCBSTD3, total: int, every: int) -> list[float]:
    """Memory while training."""
    seen = [resident_mb()]
    for _ in range(total // every):
        agent.learn(every, reset_num_timesteps=False)
        seen.append(resident_mb())
    return seen


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--decisions", type=int, default=100_000)
    parser.add_argument("--steps", type=int, default=20_000)
    args = parse_args(parser)
    matplotlib.use("agg")
    print(machine())
    agent = make_agent(args.env)
    curves = {
        "decisions": (args.decisions, over_decisions(agent, args.decisions, max(1, args.decisions // 20))),
        "training steps": (args.steps, over_training(agent, args.steps, max(1, args.steps // 20))),
    }
    figure, both = pyplot.subplots(1, 2, figsize=(9, 3.5))
    rows = []
    for axes, (name, (total, seen)) in zip(both, curves.items(), strict=True):
        rows.append([name, total, seen[0], seen[-1], seen[-1] - seen[0], max(seen) - seen[0]])
        axes.plot(np.linspace(0, total, len(seen)), seen, "o-")
        axes.set_xlabel(name)
        axes.set_ylabel("resident memory [MB]")
        axes.set_ylim(min(seen) - 10, max(seen) + 10)
    figure.tight_layout()
    header = ["over", "number", "first MB", "last MB", "growth MB", "most MB above first"]
    print_table(header, rows)
    write("memory", [dict(zip(header, row, strict=True)) for row in rows])
    write_picture(figure, "memory.png")


if __name__ == "__main__":
    main()
