"""Runs that are killed again and again, against the same runs undisturbed: do they end alike, bit for bit?

Every second SIGKILL hits while a checkpoint is being written, the others at random clocks.
"""

import argparse
import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import parse_args, print_table, read, write
from benchmarks.kill_run import ALGORITHMS, CASES, RESULT, STARTED

STEPS = {"HalfCheetah-v5": 4000, "Ant-v5": 3000, "Walker2d-v5": 6000, "Pendulum-v1": 5000}


def start(algorithm: str, case: str, folder: Path, steps: int, save_freq: int) -> subprocess.Popen:
    """Start a run in a process group of its own.

    :param algorithm: key of ``kill_run.ALGORITHMS``.
    :param case: key of ``kill_run.CASES``.
    :param folder: of the run.
    :param steps: environment steps in all.
    :param save_freq: environment steps between checkpoints.
    """
    (folder / STARTED).unlink(missing_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    arguments = [algorithm, case, str(folder), "--steps", str(steps), "--save-freq", str(save_freq)]
    with open(folder / "output.txt", "a") as output:
        return subprocess.Popen(
            [sys.executable, "-m", "benchmarks.kill_run", *arguments],
            stdout=output,
            stderr=output,
            start_new_session=True,
            cwd=Path(__file__).parent.parent,
        )


def wait_until(happened: Any, process: subprocess.Popen, seconds: float) -> bool:
    """Wait for something, or for the end of a process.

    :param happened: called without arguments.
    :param process: the process.
    :param seconds: at most so long.
    :return: whether it happened.
    """
    end = time.monotonic() + seconds
    while time.monotonic() < end and process.poll() is None:
        if happened():
            return True
        time.sleep(0.0005)
    return False


def kill_once(process: subprocess.Popen, folder: Path, while_writing: bool, seconds: float) -> str | None:
    """Kill a run.

    :param process: the run.
    :param folder: of the run.
    :param while_writing: wait until it writes a checkpoint.
    :param seconds: else, how long it may train.
    :return: where it was hit; None if it had ended.
    """
    if not wait_until((folder / STARTED).exists, process, 300):
        return None
    checkpoints = folder / "checkpoints"

    def is_writing() -> bool:
        return any(checkpoints.glob(".unfinished-*")) or any((checkpoints / "rows").glob(".unfinished-*"))

    hit = while_writing and wait_until(is_writing, process, 60)
    if not hit:
        wait_until(lambda: False, process, seconds)
    if process.poll() is not None:
        return None
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    return "while writing" if hit and is_writing() else "while training"


def run_killed(
    algorithm: str, case: str, folder: Path, steps: int, save_freq: int, kills: int, rng: np.random.Generator
) -> list[str]:
    """Do a run to its end, killing it on the way.

    :return: where it was hit each time.
    """
    hits: list[str] = []
    while not (folder / RESULT).exists():
        process = start(algorithm, case, folder, steps, save_freq)
        if len(hits) < kills:
            hit = kill_once(process, folder, len(hits) % 2 == 1, rng.uniform(0.05, 1.5))
            if hit is not None:
                hits.append(hit)
                continue
        if process.wait() != 0:
            raise RuntimeError(f"A run ended with status {process.returncode}: see {folder / 'output.txt'}")
    return hits


def differences(left: Path, right: Path) -> list[str]:
    """Compare how two runs ended.

    :param left: folder of one run.
    :param right: of the other.
    :return: what differs.
    """
    one, other = np.load(left / RESULT), np.load(right / RESULT)
    if set(one.files) != set(other.files):
        return sorted(set(one.files) ^ set(other.files))
    return [name for name in one.files if not np.array_equal(one[name], other[name])]


def measure(
    algorithm: str, case: str, folder: Path, steps: int, save_freq: int, kills: int, seed: int
) -> dict[str, Any]:
    """Compare a run that is killed with one that is not.

    :return: a row of the table.
    """
    undisturbed, killed = folder / f"{algorithm}-{case}-whole", folder / f"{algorithm}-{case}-killed"
    if start(algorithm, case, undisturbed, steps, save_freq).wait() != 0:
        raise RuntimeError(f"The undisturbed run failed: see {undisturbed / 'output.txt'}")
    hits = run_killed(algorithm, case, killed, steps, save_freq, kills, np.random.default_rng(seed))
    different = differences(undisturbed, killed)
    return {
        "algorithm": algorithm,
        "environment": case,
        "environments": CASES[case].n_envs,
        "steps": steps,
        "kills": len(hits),
        "while writing": hits.count("while writing"),
        "compared": len(np.load(killed / RESULT).files),
        "different": len(different),
        "names": different,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--cases", nargs="+", default=list(STEPS), choices=STEPS)
    parser.add_argument("--algorithms", nargs="+", default=["mcbs_td3"], choices=ALGORITHMS)
    parser.add_argument("--save-freq", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="keep the runs here")
    arguments = parse_args(parser)
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="sb3-mcbs-kill-"))
    rows = []
    for algorithm, case in itertools.product(arguments.algorithms, arguments.cases):
        rows.append(
            measure(
                algorithm, case, folder, STEPS[case], arguments.save_freq, arguments.kills, arguments.seed
            )
        )
        print(rows[-1], flush=True)
    header = [name for name in rows[0] if name != "names"]
    print_table(header, [[row[name] for name in header] for row in rows])
    write("kill", [*_others(rows), *rows])


def _others(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What was measured before of other algorithms and environments."""
    known = {(row["algorithm"], row["environment"]) for row in rows}
    return [row for row in read("kill") if (row["algorithm"], row["environment"]) not in known]


if __name__ == "__main__":
    main()
