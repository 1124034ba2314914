"""What the benchmarks share: the machine in words, fair timing, tables and files."""

import argparse
import json
import platform
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sb3_mcbs.checkpoints.settings import processor_name
from sb3_mcbs.models.mujoco_batch import usable_cores

#: The results in the repository.
COMMITTED = Path(__file__).parent / "results"
#: Where results go unless the command line says otherwise; git ignores it.
DEFAULT_OUTPUT = Path("benchmark-results")


def machine() -> dict[str, str]:
    """Describe where this runs."""
    packages = ("torch", "mujoco", "numba", "gymnasium", "stable-baselines3", "numpy")
    return {
        "processor": processor_name() or platform.machine(),
        "cores": str(usable_cores()),
        "Python": platform.python_version(),
        **{name: version(name) for name in packages},
    }


def alternate(
    calls: dict[str, Callable[[], float]], seconds: float, least: int = 5, most: int = 500
) -> dict[str, np.ndarray]:
    """Run some calls in turn, so that all see the same disturbances.

    :param calls: each returns the seconds that count.
    :param seconds: how long to go on.
    :param least: rounds that are done in any case.
    :param most: rounds after which it is enough.
    :return: the seconds of every round.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    end = time.perf_counter() + seconds
    for number in range(most):
        if number >= least and time.perf_counter() > end:
            break
        for name, call in calls.items():
            times[name].append(call())
    return {name: np.array(values) for name, values in times.items()}


def timed(function: Callable[[], Any]) -> Callable[[], float]:
    """Make a call return its own duration in seconds."""

    def call() -> float:
        start = time.perf_counter()
        function()
        return time.perf_counter() - start

    return call


def print_table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a Markdown table.

    :param header: names of the columns.
    :param rows: floats are shown with three significant digits, ``None`` as a dash.
    """
    print("| " + " | ".join(header) + " |")
    print("|" + "---|" * len(header))
    for row in rows:
        print("| " + " | ".join(shown(value) for value in row) + " |", flush=True)


def shown(value: Any) -> str:
    """A cell of a table.

    :param value: floats are shown with three significant digits, ``None`` as a dash.
    """
    if value is None:
        return "-"
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


#: Where this process writes; set by :func:`parse_args`.
output_folder = DEFAULT_OUTPUT


def parse_args(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Read the command line of a benchmark that writes results, with ``--output`` besides its own options.

    :param parser: with the benchmark's own options.
    :return: the values of those.
    """
    global output_folder
    parser.add_argument(
        "--output",
        type=Path,
        default=DEFAULT_OUTPUT,
        metavar="FOLDER",
        help=f"write here (default: {DEFAULT_OUTPUT}); benchmarks/results replaces the committed results",
    )
    args = parser.parse_args()
    output_folder = args.output
    del args.output  # some benchmarks write their own options into the results
    return args


def output_path(name: str) -> Path:
    """Where a result is written; its folder is made.

    :param name: of the file.
    """
    output_folder.mkdir(parents=True, exist_ok=True)
    return output_folder / name


def known_path(name: str) -> Path:
    """The file of results that a benchmark goes on from: what it wrote before, else what is committed.

    :param name: of the file, without its ending.
    """
    path = output_folder / f"{name}.json"
    return path if path.exists() else COMMITTED / path.name


def read(name: str) -> list[dict[str, Any]]:
    """Read rows that :func:`write` wrote.

    :param name: of the file, without its ending.
    :return: the rows of :func:`known_path`; none if there is no such file.
    """
    path = known_path(name)
    return json.loads(path.read_text())["results"] if path.exists() else []


def write(name: str, results: Any) -> Path:
    """Write results with the machine's description.

    :param name: of the file, without its ending.
    :param results: whatever JSON can hold.
    :return: the file.
    """
    path = output_path(f"{name}.json")
    path.write_text(json.dumps({"machine": machine(), "results": results}, indent=1) + "\n")
    print(f"Written: {path}")
    return path


def write_picture(figure: Any, name: str, dpi: int = 120) -> None:
    """Write a picture beside the results.

    :param figure: of matplotlib.
    :param name: of the file.
    :param dpi: pixels per inch.
    """
    path = output_path(name)
    figure.savefig(path, dpi=dpi)
    print(f"Written: {path}")
