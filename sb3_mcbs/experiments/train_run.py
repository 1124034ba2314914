"""``python -m sb3_mcbs.experiments.train_run RUN_FOLDER``: the process that trains one run."""

import shutil
import signal
import sys
import time
from pathlib import Path

import rl_zoo3.train

from sb3_mcbs.experiments.frozen import evaluate_agent
from sb3_mcbs.experiments.machine import describe_machine
from sb3_mcbs.experiments.manager import RunManager
from sb3_mcbs.experiments.plan import Run
from sb3_mcbs.experiments.results import FINISHED, RunFolder
from sb3_mcbs.zoo import register, train
from sb3_mcbs.zoo.resume import resume


def main() -> None:
    """Train the run in the given folder, from its newest exact checkpoint if there is one."""
    # Without checkpoints nobody takes over Ctrl-C, and RL Zoo would save a half-trained agent and go on.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    train_run(Path(sys.argv[1]))


def train_run(path: Path) -> None:
    """
    Train a run to its end, or evaluate its agent.

    :param path: its folder
    """
    folder = RunFolder(path)
    run = folder.run()
    folder.note_machine(describe_machine())
    if run.agent is None:
        _train(folder, run)
    else:
        evaluate_agent(folder)
    # Whoever asks for the state of a run believes this line: it is written when all else is there.
    folder.status = {**folder.status, "state": FINISHED, "ended": time.time()}
    shutil.rmtree(folder.checkpoints(run).folder, ignore_errors=True)


def _train(folder: RunFolder, run: Run) -> None:
    register()
    RunManager.run, RunManager.folder = run, folder
    rl_zoo3.train.ExperimentManager = RunManager  # type: ignore[misc]
    if folder.newest_checkpoint(run) is not None:
        resume(folder.training(run))
    else:
        shutil.rmtree(folder.logs, ignore_errors=True)
        sys.argv = ["rl_zoo3.train", *_arguments(folder, run)]
        train.main()


def _arguments(folder: RunFolder, run: Run) -> list[str]:
    words = [
        *("--algo", run.algorithm, "--env", run.environment, "--seed", str(run.seed)),
        *("-n", str(run.steps), "--eval-freq", "-1", "--num-threads", "1"),
        *("-conf", str(folder.hyperparameters), "-f", str(folder.logs)),
    ]
    if run.params:
        words += ["-params", *(f"{name}:{value!r}" for name, value in run.params.items())]
    return words


if __name__ == "__main__":
    main()
