"""
TD3 against MCBS-TD3 on one environment, both agents evaluated as bare actor and with search.

Runs RL Zoo's own commands, one lane per algorithm side by side, each with one torch thread and one simulation
thread, then summarises: learning curves of four arms, a table with the mean and the range over seeds, and the
difference between the two configurations. Finished runs are not repeated, so it can be interrupted.

    python benchmarks/first_evidence.py
    python benchmarks/first_evidence.py --summary-only
"""

import argparse
import csv
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_mcbs.zoo.evaluations import ACTOR, SEARCH, load_policies
from sb3_mcbs.zoo.repeat import load_run

SEARCH_SETTINGS = {
    "beam_width": 6,
    "rollout_depth": 3,
    "n_simulations": 5,
    "beam_noise": 0.1,
    "model_kwargs": {"n_threads": 1},
}
HYPERPARAMS = {
    "td3": [f"search_evaluation:{SEARCH_SETTINGS}"],
    "mcbs_td3": ["preset:'paper'", "model_kwargs:dict(n_threads=1)"],
}
LABELS = {"td3": "TD3", "mcbs_td3": "MCBS-TD3"}
COLORS = {
    ("td3", ACTOR): "tab:blue",
    ("td3", SEARCH): "tab:cyan",
    ("mcbs_td3", ACTOR): "tab:red",
    ("mcbs_td3", SEARCH): "tab:orange",
}


class Run(NamedTuple):
    """A run on the disk."""

    algo: str
    seed: int
    folder: Path
    finished: bool


def command(args: argparse.Namespace, algo: str, seed: int) -> list[str]:
    """
    :param args: the command line
    :param algo: algorithm to train
    :param seed: its seed
    :return: RL Zoo's command
    """
    return [
        *(sys.executable, "-m", "rl_zoo3.train", "--algo", algo, "--env", args.env, "--seed", str(seed)),
        *("-conf", "sb3_mcbs", "-n", str(args.steps), "--eval-freq", str(args.eval_freq)),
        *("--eval-episodes", str(args.eval_episodes), "--num-threads", "1", "-f", args.log_folder),
        *("-params", *HYPERPARAMS[algo], *args.params),
    ]


def command_of(args: argparse.Namespace, run: Run) -> str:
    """
    :param args: the command line
    :param run: a run on the disk
    :return: the command that makes it again, with the evaluations that it had
    """
    _, saved = load_run(run.folder)
    own = {name: saved[name] for name in ("eval_freq", "eval_episodes")}
    words = command(argparse.Namespace(**{**vars(args), **own}), run.algo, run.seed)
    return subprocess.list2cmdline(["python", *words[1:]])


def find_runs(args: argparse.Namespace) -> list[Run]:
    """
    :param args: the command line
    :return: the runs of this comparison that are in the log folder, by algorithm and seed
    """
    runs = []
    for algo in LABELS:
        for folder in sorted((Path(args.log_folder) / algo).glob(f"{args.env}_[0-9]*")):
            if (folder / args.env / "args.yml").is_file():
                _, saved = load_run(folder)
                runs.append(Run(algo, saved["seed"], folder, (folder / f"{args.env}.zip").is_file()))
    return sorted(runs)


def train_lane(args: argparse.Namespace, algo: str) -> None:
    """
    Train one algorithm with all seeds, one after the other: two runs of one algorithm that start at once
    would take the same folder.

    :param args: the command line
    :param algo: algorithm to train
    :raises RuntimeError: if a run fails
    """
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    done = {run.seed for run in find_runs(args) if run.algo == algo and run.finished}
    for seed in args.seeds:
        if seed in done:
            print(f"{algo}, seed {seed}: done before", flush=True)
            continue
        words = command(args, algo, seed)
        log = Path(args.log_folder) / f"{algo}_seed_{seed}.log"
        print(f"{algo}, seed {seed}: {subprocess.list2cmdline(words)} > {log}", flush=True)
        with log.open("w") as output:
            status = subprocess.run(
                words, stdout=output, stderr=subprocess.STDOUT, env=environment
            ).returncode
        if status != 0:
            raise RuntimeError(f"{algo} with seed {seed} ended with status {status}; see {log}")
        print(f"{algo}, seed {seed}: finished", flush=True)


def collect(runs: list[Run]) -> list[dict[str, Any]]:
    """
    :param runs: finished runs
    :return: one row per algorithm, seed, policy and evaluation
    """
    rows = []
    for run in runs:
        for policy, evaluations in load_policies(run.folder).items():
            for step, episodes in zip(evaluations.timesteps, evaluations.returns, strict=True):
                rows.append(
                    {
                        "algo": run.algo,
                        "seed": run.seed,
                        "policy": policy,
                        "timesteps": int(step),
                        "mean_return": float(episodes.mean()),
                        "min_return": float(episodes.min()),
                        "max_return": float(episodes.max()),
                        "n_episodes": len(episodes),
                    }
                )
    return rows


def summarise_arms(runs: list[Run], rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """
    :param runs: finished runs
    :param rows: their evaluations
    :return: one entry per arm: the last evaluation of each seed, the mean and the range over seeds
    """
    arms = []
    for algo in LABELS:
        training = {run.seed: _training_return(run.folder) for run in runs if run.algo == algo}
        if training:
            arms.append(_arm(algo, "while training, last 10 episodes", training))
        for policy in (ACTOR, SEARCH):
            last: dict[int, float] = {}
            for row in rows:
                if row["algo"] == algo and row["policy"] == policy:
                    last[row["seed"]] = row["mean_return"]
            if last:
                arms.append(_arm(algo, policy, last))
    return arms


def _training_return(folder: Path) -> float:
    return float(load_results(str(folder))["r"].tail(10).mean())


def _arm(algo: str, policy: str, by_seed: dict[int, float]) -> dict[str, Any]:
    values = list(by_seed.values())
    return {
        "algo": algo,
        "policy": policy,
        "mean": float(np.mean(values)),
        "min": min(values),
        "max": max(values),
        "seeds": by_seed,
    }


def training_costs(args: argparse.Namespace, runs: list[Run]) -> list[dict[str, Any]]:
    """
    :param args: the command line
    :param runs: finished runs
    :return: what the training of each run cost; the wall-clock time includes its evaluations
    """
    costs = []
    for run in runs:
        episodes = load_results(str(run.folder))
        final, _, _ = load_from_zip_file(run.folder / f"{args.env}.zip", device="cpu")
        assert final is not None
        costs.append(
            {
                "algo": run.algo,
                "seed": run.seed,
                "environment_steps": int(final["num_timesteps"]),
                "simulated_steps": int(final.get("n_simulated_steps", 0)),
                "wall_clock_minutes": float(episodes["t"].iloc[-1]) / 60,
            }
        )
    return costs


def configuration_difference(runs: list[Run]) -> list[str]:
    """
    :param runs: finished runs
    :return: every hyperparameter in which the two algorithms' first runs differ
    """
    configs = {run.algo: load_run(run.folder)[0] for run in reversed(runs)}
    if len(configs) < 2:
        return []
    td3, mcbs = configs["td3"], configs["mcbs_td3"]
    missing = "(absent)"
    return [
        f"{key}: {td3.get(key, missing)} | {mcbs.get(key, missing)}"
        for key in sorted({*td3, *mcbs})
        if td3.get(key, missing) != mcbs.get(key, missing)
    ]


def draw(rows: list[dict[str, Any]], title: str, path: Path) -> None:
    """
    Draw the learning curves of all arms: every seed, and their mean.

    :param rows: the evaluations
    :param title: title of the picture
    :param path: the PNG file to write
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for (algo, policy), color in COLORS.items():
        curves: dict[int, dict[int, float]] = {}
        for row in rows:
            if (row["algo"], row["policy"]) == (algo, policy):
                curves.setdefault(row["seed"], {})[row["timesteps"]] = row["mean_return"]
        if not curves:
            continue
        for curve in curves.values():
            axes.plot(list(curve), list(curve.values()), color=color, alpha=0.3, linewidth=1)
        common = sorted(set.intersection(*(set(curve) for curve in curves.values())))
        mean = [np.mean([curve[step] for curve in curves.values()]) for step in common]
        axes.plot(
            common, mean, color=color, linewidth=2.5, label=f"{LABELS[algo]}, {policy} (n={len(curves)})"
        )
    axes.set(title=title, xlabel="environment steps", ylabel="return")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def summarise(args: argparse.Namespace) -> None:
    """
    Write and print what the finished runs say.

    :param args: the command line
    """
    found = find_runs(args)
    runs = [run for run in found if run.finished and run.seed in args.seeds]
    for run in found:
        if not run.finished:
            print(f"left out, training did not end: {run.folder}")
    if not runs:
        sys.exit(f"No finished run of {' or '.join(LABELS)} on {args.env} in {args.log_folder}.")
    folder = Path(args.log_folder)
    rows = collect(runs)
    arms = summarise_arms(runs, rows)
    difference = configuration_difference(runs)
    with (folder / "evaluations.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    commands = [command_of(args, run) for run in runs]
    costs = training_costs(args, runs)
    summary = {"commands": commands, "difference": difference, "arms": arms, "costs": costs}
    (folder / "summary.json").write_text(json.dumps(summary, indent=2))
    draw(rows, f"{args.env}: mean over seeds, thin lines are single seeds", folder / "learning_curves.png")

    print(f"\nConfiguration (TD3 | MCBS-TD3), {args.env}:")
    print("\n".join(f"  {line}" for line in difference))
    print("\n| agent | policy | mean | range | seeds |\n|---|---|---|---|---|")
    for arm in arms:
        seeds = ", ".join(f"{seed}: {value:.0f}" for seed, value in arm["seeds"].items())
        span = f"{arm['min']:.0f} to {arm['max']:.0f}"
        print(f"| {LABELS[arm['algo']]} | {arm['policy']} | {arm['mean']:.0f} | {span} | {seeds} |")
    print("\n| agent | seed | environment steps | simulated steps | minutes, evaluations included |")
    print("|---|---|---|---|---|")
    for cost in costs:
        print(
            f"| {LABELS[cost['algo']]} | {cost['seed']} | {cost['environment_steps']} "
            f"| {cost['simulated_steps']} | {cost['wall_clock_minutes']:.1f} |"
        )
    print(f"\nWritten: {folder}/evaluations.csv, summary.json, learning_curves.png")


def parse_args() -> argparse.Namespace:
    """
    :return: the command line
    """
    parser = argparse.ArgumentParser(description="TD3 against MCBS-TD3, both policies of each evaluated.")
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--steps", type=int, default=60_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--eval-freq", type=int, default=5_000)
    parser.add_argument("--eval-episodes", type=int, default=5)
    parser.add_argument("--log-folder", default="logs/first_evidence")
    parser.add_argument(
        "--params", nargs="*", default=[], help="hyperparameters to change in both algorithms"
    )
    parser.add_argument("--summary-only", action="store_true", help="train nothing, summarise what is there")
    return parser.parse_args()


def main() -> None:
    """Train what is missing, then summarise."""
    args = parse_args()
    Path(args.log_folder).mkdir(parents=True, exist_ok=True)
    if not args.summary_only:
        with ThreadPoolExecutor(len(LABELS)) as lanes:
            list(lanes.map(lambda algo: train_lane(args, algo), LABELS))
    summarise(args)


if __name__ == "__main__":
    main()
