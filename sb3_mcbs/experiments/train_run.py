"""``python -m sb3_mcbs.experiments.train_run RUN_FOLDER``: the process that trains one run."""

import ctypes
import os
import shutil
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sb3_mcbs.experiments.results import RunFolder

#: Of prctl: the signal that a process gets when its parent ends.
_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Train the run in the given folder, from its newest exact checkpoint if there is one."""
    _end_with(int(sys.argv[2]) if len(sys.argv) > 2 else None)
    # Without checkpoints nobody takes over Ctrl-C, and RL Zoo would save a half-trained agent and go on.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    train_run(Path(sys.argv[1]))


def _end_with(parent: int | None) -> None:
    """Let the system kill this process when its parent ends, even if that is killed: on Linux.

    :param parent: the parent's number; None: live on.
    """
    if parent is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it has ended already
        sys.exit("The process that started this one has ended.")


def train_run(path: Path) -> None:
    """
    Train a run to its end, or evaluate its agent.

    :param path: its folder
    """
    # Imported only now: importing takes seconds in which the parent may end.
    from sb3_mcbs.experiments.frozen import evaluate_agent
    from sb3_mcbs.experiments.results import FINISHED, RunFolder
    from sb3_mcbs.zoo.manager import CHECKPOINTS

    folder = RunFolder(path)
    run = folder.run()
    if run.agent is None:
        _train(folder)
    else:
        evaluate_agent(folder)
    # Whoever asks for the state of a run believes this line: it is written when all else is there.
    folder.status = {**folder.status, "state": FINISHED, "ended": time.time()}
    shutil.rmtree(folder.training(run) / CHECKPOINTS, ignore_errors=True)


def _train(folder: "RunFolder") -> None:
    from sb3_mcbs.experiments.manager import RunManager
    from sb3_mcbs.zoo import train
    from sb3_mcbs.zoo.registration import register
    from sb3_mcbs.zoo.resume import resume

    register()
    import rl_zoo3.train

    RunManager.run, RunManager.folder = folder.run(), folder
    rl_zoo3.train.ExperimentManager = RunManager  # type: ignore[misc]
    if folder.has_begun(RunManager.run):
        resume(folder.training(RunManager.run))
    else:
        shutil.rmtree(folder.logs, ignore_errors=True)
        sys.argv = ["rl_zoo3.train", *_arguments(folder)]
        train.main()


def _arguments(folder: "RunFolder") -> list[str]:
    run = folder.run()
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
