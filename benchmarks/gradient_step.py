"""The gradient step against SB3's, for many sizes: ``make bench-gradient_step``."""

import argparse
import itertools
import json
from typing import Any

import numpy as np
import torch as th
from sb3_contrib import CrossQ
from stable_baselines3 import TD3

from benchmarks.common import alternate, machine, parse_args, print_table, timed, write
from sb3_mcbs.networks.crossq_update import CrossQUpdate
from sb3_mcbs.networks.td3_update import TD3Update

NETWORKS = ([32, 32], [64, 64], [256, 256], [400, 300], [512, 512, 512])
BATCHES = (16, 64, 256, 1024)
#: The class, its fast steps, and the policy_delay: the actor is updated once in so many steps.
ALGORITHMS: dict[str, tuple[Any, Any, int]] = {
    "TD3": (TD3, TD3Update, 2),
    "CrossQ": (CrossQ, CrossQUpdate, 3),
    "CrossQ, policy_delay 1": (CrossQ, CrossQUpdate, 1),
}


def measure(name: str, net_arch: list[int], n_threads: int, seconds: float) -> list[dict[str, Any]]:
    """All batch sizes of one architecture, times in milliseconds.

    :param name: in :data:`ALGORITHMS`.
    :param net_arch: hidden layers of actor and critics.
    :param n_threads: torch's threads.
    :param seconds: how long to measure each batch size.
    """
    th.set_num_threads(n_threads)
    algorithm, make_update, delay = ALGORITHMS[name]
    agent = algorithm(
        "MlpPolicy",
        "HalfCheetah-v5",
        buffer_size=5000,
        learning_starts=1000,
        policy_delay=delay,
        policy_kwargs={"net_arch": net_arch},
        seed=0,
        device="cpu",
    )
    agent.learn(1010)
    update = make_update(agent)
    results = []
    for batch in BATCHES:
        calls = {
            "SB3": timed(lambda batch=batch: agent.train(delay, batch)),  # type: ignore[misc]
            "ours": timed(lambda batch=batch: update.train(delay, batch)),  # type: ignore[misc]
        }
        times = alternate(calls, seconds, least=5)
        results.append(
            {
                "algorithm": name,
                "threads": n_threads,
                "networks": str(net_arch),
                "batch": batch,
                "SB3 ms": 1000 / delay * float(np.median(times["SB3"])),
                "ours ms": 1000 / delay * float(np.median(times["ours"])),
                "SB3 / ours": float(np.median(times["SB3"] / times["ours"])),
            }
        )
    return results


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--algorithms", nargs="+", default=list(ALGORITHMS), choices=ALGORITHMS)
    parser.add_argument("--networks", type=json.loads, nargs="+", default=NETWORKS, help="as [256,256]")
    parser.add_argument("--seconds", type=float, default=1.5, help="for each size")
    args = parse_args(parser)
    print(machine())
    results = []
    for name, n_threads, net_arch in itertools.product(args.algorithms, args.threads, args.networks):
        results += measure(name, net_arch, n_threads, args.seconds)
    print_table(list(results[0]), [list(result.values()) for result in results])
    write("gradient_step", results)


if __name__ == "__main__":
    main()
