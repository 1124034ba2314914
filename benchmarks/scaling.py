"""How the cost of a decision grows: ``make bench-scaling``.

One of beam width, depth, simulations, environments and threads is varied at a time. The exponent is
that of a power law fitted to the medians: 1 is linear, less is better.
"""

import argparse
import functools
from typing import Any

import matplotlib
import numpy as np
from matplotlib import pyplot
from stable_baselines3.common.env_util import make_vec_env

from benchmarks import NETWORKS
from benchmarks.common import (
    alternate,
    machine,
    parse_args,
    print_table,
    timed,
    write,
    write_picture,
)
from sb3_mcbs import MCBSTD3

VARIED: dict[str, tuple[int, ...]] = {
    "beam_width": (3, 6, 12, 24, 48),
    "rollout_depth": (1, 2, 4, 8, 16),
    "n_simulations": (1, 2, 5, 10, 20),
    "n_envs": (1, 2, 4, 8),
    "n_threads": (1, 2, 4),
}
BASE = {"beam_width": 6, "rollout_depth": 3, "n_simulations": 5, "n_envs": 1, "n_threads": 0}


def searching(env_id: str, settings: dict[str, int]) -> MCBSTD3:
    """An agent in the middle of an episode."""
    search: dict[str, Any] = {**settings, "model_kwargs": {"n_threads": settings["n_threads"]}}
    del search["n_envs"], search["n_threads"]
    env = make_vec_env(env_id, settings["n_envs"], seed=0)
    common: dict[str, Any] = {"policy_kwargs": NETWORKS, "seed": 0, "device": "cpu", "buffer_size": 1000}
    agent = MCBSTD3("MlpPolicy", env, learning_starts=10**6, **common, **search)
    agent.learn(50 * settings["n_envs"])
    return agent


def measure(env_id: str, name: str, seconds: float) -> list[dict[str, Any]]:
    """The cost for each value of one setting, all values in turn."""
    agents = {value: searching(env_id, {**BASE, name: value}) for value in VARIED[name]}
    rng = np.random.default_rng(0)

    def decide(agent: Any) -> Any:
        return agent.planner.plan(agent._last_obs, rng)

    calls = {str(value): timed(functools.partial(decide, agent)) for value, agent in agents.items()}
    times = alternate(calls, seconds, least=10)
    results = []
    for value, agent in agents.items():
        steps = decide(agent).simulated_steps
        milliseconds = 1e3 * float(np.median(times[str(value)]))
        results.append(
            {
                "varied": name,
                "value": value,
                "simulated steps": steps,
                "ms": milliseconds,
                "us per simulated step": 1e3 * milliseconds / steps,
            }
        )
    return results


def exponent(results: list[dict[str, Any]]) -> float:
    """The power law's, fitted to the logarithms."""
    values = np.log([[r["value"], r["ms"]] for r in results])
    return float(np.polyfit(values[:, 0], values[:, 1], 1)[0])


def draw(env_id: str, results: list[dict[str, Any]]) -> None:
    """One small picture for each setting that was varied."""
    names = list(dict.fromkeys(r["varied"] for r in results))
    figure, all_axes = pyplot.subplots(1, len(names), figsize=(3 * len(names), 3.2), squeeze=False)
    for axes, name in zip(all_axes[0], names, strict=True):
        shown = [r for r in results if r["varied"] == name]
        values = [r["value"] for r in shown]
        axes.loglog(values, [r["ms"] for r in shown], "o-")
        axes.set_title(f"exponent {shown[0]['exponent']:.2f}", fontsize=9)
        axes.set_xlabel(name)
        axes.set_xticks(values, [str(value) for value in values])
        axes.set_yticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
        axes.minorticks_off()
    all_axes[0, 0].set_ylabel("ms per decision")
    figure.suptitle(f"{env_id}, varied around (6, 3, 5)", fontsize=10)
    figure.tight_layout()
    write_picture(figure, "scaling.png")


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--seconds", type=float, default=12, help="for each setting")
    args = parse_args(parser)
    matplotlib.use("agg")
    print(machine())
    results: list[dict[str, Any]] = []
    for name in VARIED:
        found = measure(args.env, name, args.seconds)
        results += [{**result, "exponent": exponent(found)} for result in found]
    print_table(list(results[0]), [list(result.values()) for result in results])
    write("scaling", results)
    draw(args.env, results)


if __name__ == "__main__":
    main()
