"""The evaluations of a run's two policies, as ``evaluations.npz`` has them."""

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sb3_mcbs.agents.registry import SEARCHING
from sb3_mcbs.zoo.paths import PathError, sibling_folder

ACTOR = "actor alone"
SEARCH = "actor with search"
#: What one array of ``evaluations.npz`` is called here, and how many dimensions it has.
_ARRAYS = {
    "timesteps": ("timesteps", 1),
    "results": ("returns", 2),
    "ep_lengths": ("lengths", 2),
    "simulated_steps": ("simulated_steps", 1),
    "seconds": ("seconds", 1),
}


@dataclass(frozen=True)
class Evaluations:
    """
    The evaluations of one policy during one run.

    :param timesteps: ``[n_evaluations]``
    :param returns: ``[n_evaluations, n_episodes]``
    :param lengths: ``[n_evaluations, n_episodes]``; None: not recorded
    :param simulated_steps: that the search had taken in training, ``[n_evaluations]``; None: not recorded
    :param seconds: that training had taken, ``[n_evaluations]``; None: not recorded
    """

    timesteps: np.ndarray
    returns: np.ndarray
    lengths: np.ndarray | None = None
    simulated_steps: np.ndarray | None = None
    seconds: np.ndarray | None = None

    def costs(self, index: int) -> dict[str, float | None]:
        """
        :param index: of an evaluation
        :return: ``timesteps``, ``simulated_steps`` and ``seconds`` until then; None: not recorded
        """
        return {
            "timesteps": int(self.timesteps[index]),
            "simulated_steps": None if self.simulated_steps is None else int(self.simulated_steps[index]),
            "seconds": None if self.seconds is None else float(self.seconds[index]),
        }

    @property
    def means(self) -> np.ndarray:
        """Mean return of each evaluation."""
        return self.returns.mean(axis=1)


def interquartile_mean(returns: np.ndarray) -> np.ndarray:
    """
    :param returns: ``[n, ...]``, any number of returns
    :return: ``[...]``, their mean without the lowest and the highest quarter (each rounded down); nan where
        one is nan
    """
    ordered = np.sort(returns, axis=0)
    cut = len(ordered) // 4
    # A nan is sorted behind all numbers, and would be cut off as if it were the best.
    return np.where(np.isnan(ordered[-1]), np.nan, ordered[cut : len(ordered) - cut].mean(axis=0))


def load_evaluations(folder: str | Path) -> Evaluations:
    """
    Read the file of an ``EvalCallback``, or of an experiment.

    :param folder: the folder that contains ``evaluations.npz``
    :return: its content
    :raises PathError: if there is no such folder, no evaluation in it, or a return that is no finite number
    """
    path = Path(folder) / "evaluations.npz"
    if not Path(folder).is_dir():
        raise PathError(
            f"There is no folder {folder}. Name that of a run, for example logs/mcbs_td3/HalfCheetah-v5_1."
        )
    if not path.is_file():
        raise PathError(
            f"{path} does not exist. Name the folder of a run, RL Zoo's log folder or that of an experiment; "
            "train with --eval-freq smaller than the run's steps."
        )
    try:
        with np.load(path) as data:
            arrays = {name: np.asarray(data[key]) for key, (name, _) in _ARRAYS.items() if key in data}
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise PathError(f"{path} is not what an EvalCallback writes: {error}") from error
    return checked_evaluations(arrays, path)


def checked_evaluations(arrays: dict[str, np.ndarray], source: str | Path) -> Evaluations:
    """
    :param arrays: attributes of :class:`Evaluations` by name
    :param source: what they were read from
    :return: the same as an object
    :raises PathError: if an array is missing or has the wrong shape, or a return is no finite number
    """
    try:
        _check(arrays)
    except (ValueError, KeyError) as error:
        raise PathError(f"The evaluations in {source} cannot be used: {error}") from error
    found = Evaluations(**arrays)
    broken = np.flatnonzero(~np.isfinite(found.means))
    if broken.size:
        raise PathError(
            f"{source} has returns that are not finite numbers, first after {found.timesteps[broken[0]]} "
            "steps: the run diverged."
        )
    return found


def _check(arrays: dict[str, np.ndarray]) -> None:
    for key, (name, n_dimensions) in _ARRAYS.items():
        if name not in arrays:
            if key in ("timesteps", "results"):
                raise KeyError(key)
        elif arrays[name].ndim != n_dimensions or len(arrays[name]) != len(arrays["timesteps"]):
            raise ValueError(f"{key} has the shape {arrays[name].shape}")
        elif arrays[name].dtype.kind not in "iuf":
            raise ValueError(f"{key} has values of type {arrays[name].dtype}")
    if not arrays["returns"].size:
        raise ValueError("there is no evaluation in it")
    for name in ("timesteps", "simulated_steps", "seconds"):
        if name in arrays and not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} are not recorded, or not finite, in every evaluation")
    if arrays.get("lengths", arrays["returns"]).shape != arrays["returns"].shape:
        raise ValueError("there are not as many lengths as returns")
    if np.any(np.diff(arrays["timesteps"]) <= 0):
        raise ValueError("timesteps do not increase")


def load_policies(run_folder: str | Path) -> dict[str, Evaluations]:
    """
    Read the evaluations of a run's policies.

    :param run_folder: ``LOGS/ALGO/ENV_NUMBER``
    :return: evaluations of ``actor alone`` and of ``actor with search``, if available
    """
    own = load_evaluations(run_folder)
    run_folder = Path(run_folder).absolute()
    if (sibling_folder(run_folder, "actor") / "evaluations.npz").is_file():
        return {ACTOR: load_evaluations(sibling_folder(run_folder, "actor")), SEARCH: own}
    if (sibling_folder(run_folder, "search") / "evaluations.npz").is_file():
        return {ACTOR: own, SEARCH: load_evaluations(sibling_folder(run_folder, "search"))}
    algorithm = run_folder.parent.name
    return {SEARCH if algorithm in SEARCHING or algorithm.endswith("_search") else ACTOR: own}


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
