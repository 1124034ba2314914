"""Whether a search with a time budget keeps it: ``make bench-deadline``."""

import argparse
import time
from typing import Any

import numpy as np
from stable_baselines3.common.env_util import make_vec_env

from benchmarks import NETWORKS
from benchmarks.common import machine, parse_args, print_table, write
from sb3_mcbs import MCBSTD3, SearchPolicy


def measure(env_id: str, budget: float, decisions: int) -> dict[str, Any]:
    """Act with one budget, in an environment that goes on.

    :param env_id: the environment.
    :param budget: seconds.
    :param decisions: how many are timed, after a tenth as many that are not.
    """
    env = make_vec_env(env_id, 1, seed=0)
    agent = MCBSTD3("MlpPolicy", env, policy_kwargs=NETWORKS, seed=0, device="cpu", buffer_size=1000)
    policy = SearchPolicy(agent, env, seed=0, search_kwargs=dict(time_budget=budget, max_beam_width=1000))
    observations: Any = env.reset()
    seconds, rounds, candidates = [], [], []
    for number in range(decisions + decisions // 10):
        start = time.perf_counter()
        actions, _ = policy.predict(observations)
        if number >= decisions // 10:
            seconds.append(time.perf_counter() - start)
            assert policy.last_result is not None
            rounds.append(policy.last_result.rounds)
            candidates.append(policy.last_result.values.shape[1])
        observations, *_ = env.step(actions)
    policy.close()
    spent = np.array(seconds) / budget
    return {
        "env": env_id,
        "budget ms": 1e3 * budget,
        "median / budget": float(np.median(spent)),
        "p99 / budget": float(np.percentile(spent, 99)),
        "most / budget": float(spent.max()),
        "rounds": float(np.mean(rounds)),
        "candidates": float(np.mean(candidates)),
        "without a round": f"{100 * np.mean(np.array(rounds) == 0):.1f} %",
    }


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="Walker2d-v5")
    parser.add_argument("--ms", type=float, nargs="+", default=[2, 5, 20])
    parser.add_argument("--decisions", type=int, default=1000)
    args = parse_args(parser)
    print(machine())
    results = [measure(args.env, ms / 1e3, args.decisions) for ms in args.ms]
    print_table(list(results[0]), [list(result.values()) for result in results])
    write("deadline", results)


if __name__ == "__main__":
    main()
