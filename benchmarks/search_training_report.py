"""Tables and a figure of what ``benchmarks.search_training`` found.

    python -m benchmarks.search_training_report

Runs in the folder are added to those in ``benchmarks/results/search_training.json``, one of every
environment, arm and seed; all of them are reported, and written where ``--output`` says.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from scipy.stats import trim_mean

from benchmarks.common import known_path, output_path, parse_args, print_table, write_picture
from benchmarks.search_training_arms import ARMS

FILE = "search_training"
POLICIES = {"actor": "actor alone", "search": "actor with search"}
#: Evaluations in this last part of a run are averaged.
LAST_PART = 0.25

Run = dict[str, Any]


def final_return(run: Run, policy: str) -> float:
    """The mean return of the last quarter of a run.

    :param run: as ``benchmarks.search_training`` wrote it.
    :param policy: "actor" or "search".
    """
    evaluations = run["evaluations"]
    first = (1 - LAST_PART) * run["steps"]
    return float(np.mean([np.mean(each[policy]) for each in evaluations if each["step"] >= first]))


def interquartile_mean(values: list[float]) -> float:
    """The mean without the lowest and the highest quarter of the values.

    :param values: of the seeds.
    """
    return float(trim_mean(values, 0.25))


def add_runs(folder: Path) -> list[Run]:
    """Add the finished runs of a folder to those that are known, and write them all.

    :param folder: of ``benchmarks.search_training``.
    :return: all of them, by environment, arm and seed.
    """
    known = json.loads(known_path(FILE).read_text())
    found = [json.loads(file.read_text()) for file in sorted(folder.glob("*.json"))]
    finished = [run for run in found if run["evaluations"][-1]["step"] >= run["steps"]]
    runs = {(run["env"], list(ARMS).index(run["arm"]), run["seed"]): run for run in known + finished}
    ordered = [runs[key] for key in sorted(runs)]
    path = output_path(f"{FILE}.json")
    path.write_text("[\n" + ",\n".join(json.dumps(run) for run in ordered) + "\n]\n")
    print(f"Written: {path}, with {len(finished)} runs of {folder}")
    return ordered


def print_environment(env_id: str, runs: list[Run]) -> None:
    """Print every run of an environment, and every arm.

    :param env_id: the environment.
    :param runs: those in it.
    """
    print(f"\n{env_id}: mean of the evaluations in the last quarter of {runs[0]['steps']} steps\n")
    rows, arms = [], dict.fromkeys(run["arm"] for run in runs)
    for arm in arms:
        mine = [run for run in runs if run["arm"] == arm]
        cells: list[Any] = [arm, ", ".join(str(run["seed"]) for run in mine)]
        for policy in POLICIES:
            values = [final_return(run, policy) for run in mine]
            cells += [", ".join(f"{value:.0f}" for value in values), interquartile_mean(values)]
        last = [run["evaluations"][-1] for run in mine]
        cells += [_mean(last, "simulated_steps", 1e6, ".2f"), _mean(last, "training_seconds", 60, ".0f")]
        rows.append(cells)
    header = ["arm", "seeds"]
    for name in POLICIES.values():
        header += [name, "IQM"]
    print_table([*header, "simulated steps, millions", "minutes of training"], rows)


def _mean(evaluations: list[dict[str, Any]], name: str, unit: float, form: str) -> str:
    known = [each[name] for each in evaluations if each[name] is not None]
    return f"{np.mean(known) / unit:{form}}" if known else "?"


def draw(env_id: str, runs: list[Run], arms: list[str]) -> None:
    """Draw the learning curves of some arms, both policies beside one another.

    :param env_id: the environment.
    :param runs: those in it.
    :param arms: which to draw.
    """
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, both_axes = plt.subplots(1, 2, figsize=(10, 4), sharey=True)
    for axes, (policy, name) in zip(both_axes, POLICIES.items(), strict=True):
        for number, arm in enumerate(arms):
            mine = [run for run in runs if run["arm"] == arm]
            steps = [each["step"] for each in mine[0]["evaluations"]]
            curves = np.array([[np.mean(each[policy]) for each in run["evaluations"]] for run in mine])
            for curve in curves:
                axes.plot(steps, curve, color=f"C{number}", alpha=0.25, linewidth=1)
            middle = trim_mean(curves, 0.25, axis=0)
            label = f"{arm} ({len(mine)} seeds)"
            axes.plot(steps, middle, color=f"C{number}", linewidth=2, label=label)
        axes.set(title=f"{env_id}, {name}", xlabel="environment steps")
    both_axes[0].set_ylabel("return (thick: interquartile mean)")
    both_axes[0].legend(loc="upper left")
    figure.tight_layout()
    write_picture(figure, f"search_training-{env_id}.png", dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=Path("logs/search_training"))
    parser.add_argument("--draw", nargs="+", choices=ARMS, default=["td3", "algorithm1"])
    args = parse_args(parser)
    runs = add_runs(args.folder)
    for env_id in dict.fromkeys(run["env"] for run in runs):
        mine = [run for run in runs if run["env"] == env_id]
        print_environment(env_id, mine)
        drawn = [arm for arm in args.draw if any(run["arm"] == arm for run in mine)]
        if drawn:
            draw(env_id, mine, drawn)


if __name__ == "__main__":
    main()
