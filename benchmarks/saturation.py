"""The saturation schedule against searching at every step: final returns and simulated steps.

Each seed is trained once with every schedule; both policies of each are evaluated on the same resets.
Results are written after every seed, beside those of seeds that are known already.

    python -m benchmarks.saturation Pendulum-v1
    python -m benchmarks.saturation InvertedDoublePendulum-v5
"""

import argparse
import time
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise

from benchmarks.common import parse_args, print_table, read, write
from sb3_mcbs import MCBSTD3, SearchPolicy, SnapshotEnvWrapper
from sb3_mcbs.search import PRESETS

#: 18 simulated steps where every decision is searched.
SEARCH = PRESETS["efficient"]
#: The schedules, and what they need in ``schedule_kwargs``.
SCHEDULES: dict[str, dict[str, Any]] = {
    "constant": {},
    "saturation": {"final_search_share": 0.1},
}
#: Environment steps, and what they are averaged over; both returns are flat long before the end.
LENGTHS = {"Pendulum-v1": (25_000, 2_000), "InvertedDoublePendulum-v5": (50_000, 2_500)}
EPISODES = 20


def train(env_id: str, schedule: str, seed: int) -> dict[str, Any]:
    """Train one agent and evaluate it.

    :param env_id: the environment.
    :param schedule: one of ``SCHEDULES``.
    :param seed: of the agent and its environment.
    :return: returns and costs.
    """
    steps, window = LENGTHS[env_id]
    env = make_vec_env(env_id, 1, seed=seed, wrapper_class=SnapshotEnvWrapper)
    agent = MCBSTD3(
        "MlpPolicy",
        env,
        learning_starts=1_000,
        gamma=0.98,
        action_noise=NormalActionNoise(np.zeros(1), np.full(1, 0.1)),
        policy_kwargs={"net_arch": [64, 64]},
        model_kwargs=dict(n_threads=1),
        seed=seed,
        device="cpu",
        search_schedule=schedule,
        schedule_kwargs={"saturation_window": window, **SCHEDULES[schedule]},
        **SEARCH,
    )
    start = time.perf_counter()
    agent.learn(steps)
    seconds = time.perf_counter() - start
    evaluation = make_vec_env(env_id, EPISODES, seed=1000, wrapper_class=SnapshotEnvWrapper)
    actor, _ = evaluate_policy(agent, evaluation, EPISODES)
    evaluation.seed(1000)
    search, _ = evaluate_policy(SearchPolicy(agent, evaluation, seed=1000), evaluation, EPISODES)
    assert agent._schedule is not None
    return {
        "schedule": schedule,
        "seed": seed,
        "actor alone": float(np.mean(actor)),
        "actor with search": float(np.mean(search)),
        "environment steps": agent.num_timesteps,
        "simulated steps": agent.n_simulated_steps,
        "seconds": seconds,
        "changes": agent._schedule.saturation.changes,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("env", choices=LENGTHS)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(5)))
    args = parse_args(parser)
    th.set_num_threads(1)
    file, (steps, _) = f"saturation-{args.env}", LENGTHS[args.env]
    rows = [row for row in read(file) if row["environment steps"] == steps]
    for seed in args.seeds:
        found = [train(args.env, schedule, seed) for schedule in SCHEDULES]
        print(*found, sep="\n", flush=True)
        rows = [row for row in rows if row["seed"] != seed] + found
        write(file, rows)
    table = []
    for schedule in SCHEDULES:
        mine = [row for row in rows if row["schedule"] == schedule]
        cells: list[Any] = [schedule, len(mine)]
        for name in ("actor alone", "actor with search"):
            values = [row[name] for row in mine]
            cells.append(f"{np.mean(values):.0f} ({min(values):.0f} to {max(values):.0f})")
        for name in ("simulated steps", "seconds", "changes"):
            cells.append(f"{np.mean([row[name] for row in mine]):.0f}")
        table.append(cells)
    print_table(
        ["schedule", "seeds", "actor alone", "actor with search", "simulated steps", "seconds", "changes"],
        table,
    )


if __name__ == "__main__":
    main()
