"""``python -m sb3_mcbs.zoo.report``: returns and learning curves of a run's two policies."""

import argparse
import sys
import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_mcbs.zoo.paths import PathError, sibling_folder

ACTOR = "actor alone"
SEARCH = "actor with search"


class Evaluations(NamedTuple):
    """
    The evaluations of one policy during one run.

    :param timesteps: ``[n_evaluations]``
    :param returns: ``[n_evaluations, n_episodes]``
    """

    timesteps: np.ndarray
    returns: np.ndarray


def load_evaluations(folder: str | Path) -> Evaluations:
    """
    Read an ``EvalCallback``'s file.

    :param folder: the folder that contains ``evaluations.npz``
    :return: its content
    :raises PathError: if there is no such folder, or no evaluation in it
    """
    path = Path(folder) / "evaluations.npz"
    if not Path(folder).is_dir():
        raise PathError(
            f"There is no folder {folder}. Name that of a run, for example logs/mcbs_td3/HalfCheetah-v5_1."
        )
    if not path.is_file():
        raise PathError(f"{path} does not exist: train with --eval-freq smaller than the run's steps.")
    try:
        with np.load(path) as data:
            return Evaluations(data["timesteps"], data["results"])
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise PathError(f"{path} is not what an EvalCallback writes: {error}") from error


def load_policies(run_folder: str | Path) -> dict[str, Evaluations]:
    """
    Read the evaluations of a run's policies.

    :param run_folder: ``LOGS/ALGO/ENV_NUMBER``
    :return: evaluations of ``actor alone`` and of ``actor with search``, if available
    """
    own = load_evaluations(run_folder)
    if (sibling_folder(run_folder, "actor") / "evaluations.npz").is_file():
        return {ACTOR: load_evaluations(sibling_folder(run_folder, "actor")), SEARCH: own}
    if (sibling_folder(run_folder, "search") / "evaluations.npz").is_file():
        return {ACTOR: own, SEARCH: load_evaluations(sibling_folder(run_folder, "search"))}
    return {ACTOR: own}


def newest_run(log_folder: str | Path, algo: str, env_id: str) -> Path:
    """
    Find the most recently evaluated run.

    :param log_folder: RL Zoo's log folder
    :param algo: the algorithm's name on RL Zoo's command line
    :param env_id: the environment
    :return: the run's folder
    :raises PathError: if there is none
    """
    runs = list((Path(log_folder) / algo).glob(f"{env_id}_[0-9]*/evaluations.npz"))
    if not runs:
        raise PathError(
            f"No evaluated run of {algo} on {env_id} in {log_folder}. Train one first: "
            f"python -m rl_zoo3.train --algo {algo} --env {env_id} --eval-freq 5000 -f {log_folder}"
        )
    return max(runs, key=lambda path: path.stat().st_mtime).parent


def draw(policies: dict[str, Evaluations], title: str, path: Path) -> None:
    """
    Draw learning curves: mean and range over the episodes of each evaluation.

    :param policies: evaluations by name
    :param title: title of the plot
    :param path: the PNG file to write
    """
    # Without pyplot, which would choose a backend for the whole process, perhaps one with windows.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for name, (timesteps, returns) in policies.items():
        (line,) = axes.plot(timesteps, returns.mean(axis=1), marker="o", label=name)
        axes.fill_between(
            timesteps, returns.min(axis=1), returns.max(axis=1), color=line.get_color(), alpha=0.2
        )
    axes.set(title=title, xlabel="environment steps", ylabel="return")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def report(run_folder: str | Path) -> list[str]:
    """
    Plot a run's learning curves in its folder and summarise its results.

    :param run_folder: ``LOGS/ALGO/ENV_NUMBER``
    :return: the lines to print
    """
    run_folder = Path(run_folder)
    policies = load_policies(run_folder)
    picture = run_folder / "learning_curve.png"
    draw(policies, f"{run_folder.parent.name} {run_folder.name}", picture)
    lines = []
    for name, (timesteps, returns) in policies.items():
        lines.append(
            f"Mean return of the {name}: {returns[-1].mean():.1f} "
            f"({returns.shape[1]} episodes after {timesteps[-1]} steps)"
        )
    models = sorted(
        run_folder.glob("*.zip"), key=lambda path: path.name.startswith(("best_model", "rl_model"))
    )
    lines.append(f"Model:          {models[0] if models else 'none, training did not end'}")
    lines.append(f"Logs:           {run_folder}")
    lines.append(f"Learning curve: {picture}")
    return lines


def main() -> None:
    """Read the command line, draw and print."""
    parser = argparse.ArgumentParser(
        prog="sb3-mcbs report", description="Returns and learning curve of the policies of a run."
    )
    parser.add_argument("run_folder", nargs="?", help="a run's folder; without it, the newest run")
    parser.add_argument("--algo", default="mcbs_td3", help="algorithm of the newest run")
    parser.add_argument("--env", default="HalfCheetah-v5", help="environment of the newest run")
    parser.add_argument("-f", "--log-folder", default="logs", help="where RL Zoo logs")
    args = parser.parse_args()
    try:
        folder = args.run_folder or newest_run(args.log_folder, args.algo, args.env)
        print("\n".join(report(folder)))
    except OSError as error:
        sys.exit(f"{parser.prog}: {error}")


if __name__ == "__main__":
    main()
