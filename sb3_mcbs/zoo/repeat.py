"""``python -m sb3_mcbs.zoo.repeat RUN_FOLDER``: repeat an RL Zoo run from its saved files."""

import argparse
import importlib
import os
import sys
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml

from sb3_mcbs.checkpoints import CheckpointError
from sb3_mcbs.zoo import train
from sb3_mcbs.zoo.paths import PathError

#: RL Zoo imports a module of this name for its hyperparameters (``-conf``); it exists in this process only.
CONFIG_MODULE = "sb3_mcbs_repeated_run"
#: Packages whose classes and functions a saved configuration may name.
TRUSTED_PACKAGES = ("torch", "stable_baselines3", "sb3_contrib", "rl_zoo3", "gymnasium", "sb3_mcbs")
#: Arguments that the saved configuration already contains, or that belong to tuning.
NOT_REPEATED = ("hyperparams", "conf_file", "storage", "study_name", "trial_id", "log_folder", "command")

_PYTHON_TAG = "tag:yaml.org,2002:python/"


class RunLoader(yaml.SafeLoader):
    """
    A safe loader that also reads what RL Zoo writes: ordered dictionaries, tuples and names of classes.

    Nothing is called and nothing outside ``TRUSTED_PACKAGES`` is imported.
    """


def _construct_tuple(loader: RunLoader, node: yaml.SequenceNode) -> tuple[Any, ...]:
    return tuple(loader.construct_sequence(node, deep=True))


def _construct_ordered_dict(loader: RunLoader, node: yaml.SequenceNode) -> OrderedDict[str, Any]:
    arguments = loader.construct_sequence(node, deep=True)
    return OrderedDict((key, value) for key, value in (arguments[0] if arguments else []))


def _construct_name(loader: RunLoader, suffix: str, node: yaml.Node) -> Any:
    module_name, _, name = suffix.rpartition(".")
    if module_name.split(".")[0] not in TRUSTED_PACKAGES:
        raise yaml.constructor.ConstructorError(
            None,
            None,
            f"will not import {suffix!r}: only names from {', '.join(TRUSTED_PACKAGES)} are read. "
            'Write the value as text that RL Zoo evaluates (policy_kwargs: "dict(...)") and train again',
            node.start_mark,
        )
    return getattr(importlib.import_module(module_name), name)


RunLoader.add_constructor(f"{_PYTHON_TAG}tuple", _construct_tuple)
RunLoader.add_constructor(f"{_PYTHON_TAG}object/apply:collections.OrderedDict", _construct_ordered_dict)
RunLoader.add_multi_constructor(f"{_PYTHON_TAG}name:", _construct_name)


def load_run(run_folder: str | Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """
    Read a run's saved files.

    :param run_folder: ``LOGS/ALGO/ENV_NUMBER``
    :return: the hyperparameters and the command line arguments of the run
    :raises PathError: if the folder is not that of an RL Zoo run
    """
    found = sorted(Path(run_folder).glob("*/args.yml"))
    if len(found) != 1 or not found[0].with_name("config.yml").is_file():
        raise PathError(
            f"{run_folder} is not the folder of an RL Zoo run: it needs <env>/config.yml and <env>/args.yml. "
            "Name a folder such as logs/mcbs_td3/HalfCheetah-v5_1."
        )
    config, args = (_read_yaml(path) for path in (found[0].with_name("config.yml"), found[0]))
    return config, args


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        return dict(yaml.load(path.read_text(), Loader=RunLoader))
    except (yaml.YAMLError, OSError, ImportError, AttributeError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise PathError(f"{path} is not what RL Zoo writes for a run: {reason}") from error


def command_line(args: dict[str, Any]) -> list[str]:
    """
    Convert saved arguments back to a command line.

    :param args: the content of ``args.yml``
    :return: arguments for ``rl_zoo3.train``, without the hyperparameters
    """
    words: list[str] = []
    for name, value in sorted(args.items()):
        option = f"--{name.replace('_', '-')}"
        if name == "truncate_last_trajectory":
            # Declared with type=bool: every non-empty text is true.
            words += [option, "yes" if value else ""]
        elif name in NOT_REPEATED or value is None or value is False or value == "" or value == []:
            continue
        elif value is True:
            words.append(option)
        elif isinstance(value, dict):
            words += [option, *(f"{key}:{entry!r}" for key, entry in value.items())]
        elif isinstance(value, list):
            words += [option, *map(str, value)]
        else:
            words.append(f"{option}={value}")
    return words


def repeat(run_folder: str | Path, extra: Sequence[str] = ()) -> None:
    """
    Train again with the hyperparameters, the arguments and the seed of a run.

    :param run_folder: the run's folder; the new run's folder is next to it
    :param extra: arguments of ``rl_zoo3.train`` that replace the run's own
    :raises PathError: if the folder is not that of a run, or the agent that the run continued is missing
    """
    config, args = load_run(run_folder)
    agent = args.get("trained_agent")
    if agent and not os.path.isfile(agent) and not {"-i", "--trained-agent"}.intersection(extra):
        raise PathError(
            f"The run continued the agent {agent}, which is not there seen from {os.getcwd()}. "
            "Start from the folder where the run was started, or name the agent with -i FILE."
        )
    module = ModuleType(CONFIG_MODULE)
    module.hyperparams = {args["env"]: config}  # type: ignore[attr-defined]
    sys.modules[CONFIG_MODULE] = module
    log_folder = Path(run_folder).resolve().parents[1]
    sys.argv = [
        "rl_zoo3.train",
        *command_line(args),
        f"--conf-file={CONFIG_MODULE}",
        f"--log-folder={log_folder}",
        *extra,
    ]
    train.main()


def main() -> None:
    """Read the command line and repeat the run."""
    parser = argparse.ArgumentParser(
        prog="sb3-mcbs repeat",
        description="Repeat an RL Zoo run from its folder. Further arguments go to rl_zoo3.train, "
        "for example -f OTHER_LOGS to write elsewhere.",
    )
    parser.add_argument("run_folder", help="a run's folder, for example logs/mcbs_td3/HalfCheetah-v5_1")
    args, extra = parser.parse_known_args()
    try:
        repeat(args.run_folder, extra)
    except (PathError, CheckpointError) as error:
        sys.exit(f"{parser.prog}: {error}")


if __name__ == "__main__":
    main()
