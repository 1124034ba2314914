"""Returns of a trained agent under every preset and a tree, on the same reset seeds.

The agent's file is read by ``load_agent``. Results are written after every seed, so that all have been run
with equally many.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from benchmarks.common import print_table, write
from sb3_mcbs import SearchPolicy, SnapshotEnvWrapper, load_agent
from sb3_mcbs.search import PRESETS

TREE = {"strategy": "tree", "n_simulations": 1, "one_node_per_root": True, "rollout_noise": 0.05}
ARMS: dict[str, dict[str, Any] | None] = {"actor alone": None, **PRESETS, "tree": TREE}


def run_episode(agent: OffPolicyAlgorithm, env_id: str, seed: int, settings: Any) -> dict[str, float]:
    """Act for one episode.

    :param agent: the trained agent.
    :param env_id: its environment.
    :param seed: of the environment's reset and of the search.
    :param settings: of the search; None acts without.
    :return: the return, its cost per decision, and how many decisions there were.
    """
    env = make_vec_env(env_id, 1, seed=seed, wrapper_class=SnapshotEnvWrapper)
    policy: Any = agent if settings is None else SearchPolicy(agent, env, seed=seed, n_threads=1, **settings)
    observations, totals, done, n_decisions = env.reset(), np.zeros(4), False, 0
    while not done:
        start = time.perf_counter()
        actions, _ = policy.predict(observations, deterministic=True)
        seconds = time.perf_counter() - start
        result = getattr(policy, "last_result", None)
        simulated = 0 if result is None else result.simulated_steps
        evaluated = 0 if result is None else result.critic_evaluations
        observations, rewards, dones, _ = env.step(actions)
        totals += float(rewards[0]), simulated, evaluated, 1000 * seconds
        done, n_decisions = bool(dones[0]), n_decisions + 1
    env.close()
    mean = totals[1:] / n_decisions
    return {
        "return": float(totals[0]),
        "simulated steps": float(mean[0]),
        "critic evaluations": float(mean[1]),
        "ms": float(mean[2]),
        "decisions": n_decisions,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("agent", type=Path, help="zip of a TD3, DDPG, SAC or TQC agent")
    parser.add_argument("env", help="its environment, for example HalfCheetah-v4")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(200, 210)))
    arguments = parser.parse_args()
    th.set_num_threads(1)
    agent = load_agent(arguments.agent, make_vec_env(arguments.env, 1), device="cpu")
    rows: list[dict[str, Any]] = []
    for seed in arguments.seeds:
        for arm, settings in ARMS.items():
            result = run_episode(agent, arguments.env, seed, settings)
            rows.append({"arm": arm, "seed": seed, **result})
            print(rows[-1], flush=True)
        write(f"strategies-{arguments.agent.stem}", {"environment": arguments.env, "rows": rows})
    table = []
    for arm in ARMS:
        mine = [row for row in rows if row["arm"] == arm]
        returns = [row["return"] for row in mine]
        costs = [
            np.mean([row[name] for row in mine]) for name in ("simulated steps", "critic evaluations", "ms")
        ]
        table.append(
            [arm, len(mine), float(np.mean(returns)), min(returns), max(returns), *map(float, costs)]
        )
    header = ["", "episodes", "return", "least", "most", "simulated steps", "critic evaluations", "ms"]
    print_table(header, table)


if __name__ == "__main__":
    main()
