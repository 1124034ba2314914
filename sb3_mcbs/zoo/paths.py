"""Paths of this package's hyperparameter files and of RL Zoo's runs."""

from pathlib import Path

PACKAGE_ROOT = Path(__file__).resolve().parents[1]


class PathError(FileNotFoundError):
    """A path is not what a command needs; the message says what to pass instead."""


def hyperparams_path(algo: str) -> Path:
    """
    Find the hyperparameter file of an algorithm, in an installed package or in a checkout.

    :param algo: the algorithm's name on RL Zoo's command line, ``mcbs_td3`` or (its baseline) ``td3``
    :return: path of its YAML file
    :raises PathError: if this package has no file for the algorithm
    """
    folders = [PACKAGE_ROOT / "hyperparams", PACKAGE_ROOT.parent / "hyperparams"]
    for folder in folders:
        path = folder / f"{algo}.yml"
        if path.is_file():
            return path
    known = sorted({path.stem for folder in folders for path in folder.glob("*.yml")})
    raise PathError(
        f"sb3-mcbs has no hyperparameters for {algo!r}, only for: {', '.join(known) or 'nothing'}. "
        "Name a file of your own with -conf FILE."
    )


def sibling_folder(run_folder: str | Path, label: str) -> Path:
    """
    The folder of a run's second evaluation: RL Zoo's plots draw one curve per algorithm folder.

    :param run_folder: a run's folder, ``LOGS/ALGO/ENV_NUMBER``
    :param label: the policy of the second evaluation, ``actor`` or ``search``
    :return: ``LOGS/ALGO_LABEL/ENV_NUMBER``
    """
    run_folder = Path(run_folder)
    return run_folder.parent.with_name(f"{run_folder.parent.name}_{label}") / run_folder.name
