"""Returns of a trained SAC or TQC agent with soft and with truncated values, on the same reset seeds.

The agent's file is read by ``load_agent``, its entropy coefficient included.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from sb3_contrib import TQC
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.common import print_table, write
from benchmarks.strategies import run_episode
from sb3_mcbs import load_agent
from sb3_mcbs.algorithms.networks import entropy_coefficient

PRESETS = ("paper", "efficient")
VALUES: dict[str, dict[str, Any]] = {
    "": {},
    "entropy_bonus": {"entropy_bonus": True},
    "truncated": {"tqc_value": "truncated"},
    "truncated, entropy_bonus": {"tqc_value": "truncated", "entropy_bonus": True},
}


def arms_of(agent: Any) -> dict[str, dict[str, Any] | None]:
    """What is compared.

    :param agent: the trained agent.
    :return: settings of the search by the arms' names; None acts without.
    """
    arms: dict[str, dict[str, Any] | None] = {"actor alone": None}
    for preset in PRESETS:
        for name, settings in VALUES.items():
            if "tqc_value" not in settings or isinstance(agent, TQC):
                arms[f"{preset}, {name}".removesuffix(", ")] = {"preset": preset, **settings}
    return arms


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("agent", type=Path, help="zip of a SAC or TQC agent")
    parser.add_argument("env", help="its environment, for example HalfCheetah-v4")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(200, 205)))
    arguments = parser.parse_args()
    th.set_num_threads(1)
    agent = load_agent(arguments.agent, make_vec_env(arguments.env, 1), device="cpu")
    arms, rows = arms_of(agent), []
    for seed in arguments.seeds:
        for arm, settings in arms.items():
            result = run_episode(agent, arguments.env, seed, settings)
            rows.append({"arm": arm, "seed": seed, **result})
            print(rows[-1], flush=True)
        coefficient = entropy_coefficient(agent)
        found = {"environment": arguments.env, "entropy coefficient": coefficient, "rows": rows}
        write(f"values-{arguments.agent.stem}", found)
    table = []
    for arm in arms:
        returns = [row["return"] for row in rows if row["arm"] == arm]
        table.append([arm, len(returns), float(np.mean(returns)), min(returns), max(returns)])
    print_table(["", "episodes", "return", "least", "most"], table)


if __name__ == "__main__":
    main()
