"""``python -m sb3_mcbs.zoo.resume RUN_FOLDER``: continue an RL Zoo run from its exact checkpoints."""

import argparse
import sys
from pathlib import Path

from sb3_mcbs.checkpoints import CheckpointError
from sb3_mcbs.checkpoints.resume import read_run
from sb3_mcbs.checkpoints.store import Store
from sb3_mcbs.zoo.manager import CHECKPOINTS, MCBSExperimentManager, ResumedRun
from sb3_mcbs.zoo.paths import PathError
from sb3_mcbs.zoo.repeat import load_run, repeat


def resume(run_folder: str | Path) -> None:
    """
    Continue a run in its own folder until its original end.

    :param run_folder: ``LOGS/ALGO/ENV_NUMBER``, of a run with an ``ExactCheckpointCallback``
    :raises PathError: if the folder is not that of a run
    :raises CheckpointError: if it has no intact checkpoint
    """
    folder = Path(run_folder).resolve()
    _, args = load_run(folder)
    if not Store(folder / CHECKPOINTS).steps():
        raise CheckpointError(
            f"{run_folder} has no exact checkpoints, so it cannot be continued. Start runs with them: "
            "-params \"callback:[{'sb3_mcbs.ExactCheckpointCallback': {'save_freq': 10000}}]\", or in the "
            "hyperparameter file callback: [{sb3_mcbs.ExactCheckpointCallback: {save_freq: 10000}}]."
        )
    run = read_run(folder / CHECKPOINTS)
    MCBSExperimentManager.resumed_run = ResumedRun(folder, run, args.get("tensorboard_log") or None)
    monitor_files = {path: path.read_bytes() for path in folder.glob("*.monitor.csv")}
    try:
        repeat(folder)
    finally:
        MCBSExperimentManager.resumed_run = None
        if not run.goes_on:  # RL Zoo empties them before anything is checked
            for path, content in monitor_files.items():
                path.write_bytes(content)


def main() -> None:
    """Read the command line and continue the run."""
    parser = argparse.ArgumentParser(
        prog="sb3-mcbs resume",
        description="Continue an RL Zoo run that was stopped or killed. It must have been started with an "
        "ExactCheckpointCallback: see the documentation of checkpoints.",
    )
    parser.add_argument("run_folder", help="the run's folder, for example logs/mcbs_td3/HalfCheetah-v5_1")
    args = parser.parse_args()
    try:
        resume(args.run_folder)
    except (PathError, CheckpointError) as error:
        sys.exit(f"{parser.prog}: {error}")


if __name__ == "__main__":
    main()
