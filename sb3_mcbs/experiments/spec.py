"""What an experiment consists of, read from a YAML file and checked."""

import itertools
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sb3_mcbs.experiments.algorithms import check_params, known_algorithms, known_environments
from sb3_mcbs.experiments.document import Document, Place, SpecError, read_document

SPECS = Path(__file__).parent / "specs"
#: What may be in the name of an arm, which becomes part of a folder's name.
_NAME = re.compile(r"[A-Za-z0-9][\w.+=-]*")
_REQUIRED = ("environments", "seeds", "steps", "evaluation")
_OPTIONAL = ("description", "algorithms", "arms", "hyperparameters", "checkpoint_every")


@dataclass(frozen=True)
class Evaluation:
    """
    How all runs are evaluated.

    :param every: environment steps between two evaluations
    :param episodes: of each policy in each evaluation
    :param first_seed: the first episode is reset with this seed, the next with the one after it, and so on:
        in every evaluation of every run
    """

    every: int
    episodes: int
    first_seed: int = 10_000


@dataclass(frozen=True)
class Arm:
    """
    A variant of an algorithm.

    :param name: its name in tables and folders
    :param algorithm: RL Zoo's name of the algorithm
    :param params: hyperparameters that replace those of the file, as RL Zoo's ``-params``
    """

    name: str
    algorithm: str
    params: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Spec:
    """
    An experiment: every arm in every environment with every seed.

    :param name: of the experiment
    :param text: the file as it was read
    :param environments: ids
    :param seeds: of the training
    :param steps: environment steps of each run
    :param evaluation: how the runs are evaluated
    :param arms: what is compared
    :param hyperparameters: the file of an algorithm, where it is not the usual one
    :param checkpoint_every: environment steps between two exact checkpoints
    """

    name: str
    text: str
    environments: list[str]
    seeds: list[int]
    steps: int
    evaluation: Evaluation
    arms: list[Arm]
    hyperparameters: dict[str, Path]
    checkpoint_every: int


def read_spec(name: str | Path) -> Spec:
    """
    Read and check a spec.

    :param name: path of a YAML file, or the name of a spec that this package ships
    :return: what it says
    :raises SpecError: if there is no such file, or something in it is wrong
    """
    path = Path(name)
    if not path.is_file():
        path = SPECS / f"{name}.yml"
    if not path.is_file() or (path.parent != SPECS and not path.suffix):
        shipped = ", ".join(sorted(spec.stem for spec in SPECS.glob("*.yml")))
        raise SpecError(f"There is no file {name}, and no shipped spec of this name; shipped are {shipped}.")
    document = read_document(path)
    top = document.keys((), document.data, {*_REQUIRED, *_OPTIONAL}, _REQUIRED)
    steps = document.integer(("steps",), top["steps"], 1)
    return Spec(
        name=path.stem,
        text=document.text,
        environments=_environments(document, top["environments"]),
        seeds=[
            document.integer(("seeds", index), seed, 0)
            for index, seed in enumerate(document.sequence(("seeds",), top["seeds"]))
        ],
        steps=steps,
        evaluation=_evaluation(document, top["evaluation"], steps),
        arms=_arms(document, top),
        hyperparameters=_hyperparameters(document, top.get("hyperparameters", {}), path.parent),
        checkpoint_every=document.integer(("checkpoint_every",), top.get("checkpoint_every", 10_000), 1),
    )


def _environments(document: Document, value: Any) -> list[str]:
    known = known_environments()
    return [
        document.choice(("environments", index), env, known, "environment")
        for index, env in enumerate(document.sequence(("environments",), value))
    ]


def _evaluation(document: Document, value: Any, steps: int) -> Evaluation:
    place: Place = ("evaluation",)
    settings = document.keys(place, value, ("every", "episodes", "first_seed"), ("every", "episodes"))
    for name, number in settings.items():
        document.integer((*place, name), number, 0 if name == "first_seed" else 1)
    evaluation = Evaluation(**settings)
    if steps % evaluation.every:
        raise document.error(
            (*place, "every"),
            f"{steps} steps are no multiple of {evaluation.every}: the trained agent would not be evaluated.",
        )
    return evaluation


def _arms(document: Document, top: dict[str, Any]) -> list[Arm]:
    algorithms = document.sequence(("algorithms",), top["algorithms"]) if "algorithms" in top else []
    arms = [
        Arm(document.choice(("algorithms", index), algorithm, known_algorithms(), "algorithm"), algorithm)
        for index, algorithm in enumerate(algorithms)
    ]
    for name, value in document.mapping(("arms",), top.get("arms", {})).items():
        for arm in _arm(document, ("arms", name), name, value):
            if any(arm.name == other.name for other in arms):
                raise document.error(("arms", name), f"there are two arms of the name {arm.name}.")
            arms.append(arm)
    if not arms:
        raise document.error((), "there is nothing to train: it needs algorithms, or arms, or both.")
    return arms


def _arm(document: Document, place: Place, name: str, value: Any) -> list[Arm]:
    if not _NAME.fullmatch(name):
        raise document.error(place, "is no name for an arm: letters, digits and any of _ . + = - are.")
    settings = document.keys(place, value, ("algorithm", "params", "grid"), ("algorithm",))
    algorithm = document.choice((*place, "algorithm"), settings["algorithm"], known_algorithms(), "algorithm")
    params = document.mapping((*place, "params"), settings.get("params", {}))
    check_params(document, (*place, "params"), algorithm, params)
    grid = document.mapping((*place, "grid"), settings.get("grid", {}))
    for key, values in grid.items():
        if key in params:
            raise document.error((*place, "grid", key), "is in params as well.")
        for index, item in enumerate(document.sequence((*place, "grid", key), values)):
            check_params(document, (*place, "grid"), algorithm, {key: item}, (index,))
    arms = []
    for combination in itertools.product(*grid.values()):
        chosen = dict(zip(grid, combination, strict=True))
        full_name = "-".join([name, *(f"{key}={_short(item)}" for key, item in chosen.items())])
        if not _NAME.fullmatch(full_name):
            raise document.error(
                (*place, "grid"), f"makes the name {full_name!r}: a grid is of numbers and plain names."
            )
        arms.append(Arm(full_name, algorithm, {**params, **chosen}))
    return arms


def _short(value: Any) -> str:
    return "none" if value is None else str(value)


def _hyperparameters(document: Document, value: Any, folder: Path) -> dict[str, Path]:
    files = {}
    for algorithm, name in document.mapping(("hyperparameters",), value).items():
        place = ("hyperparameters", algorithm)
        document.choice(place, algorithm, known_algorithms(), "algorithm")
        if not isinstance(name, str) or not (folder / name).is_file():
            raise document.error(place, f"{name!r} is not a file (seen from {folder.resolve()}).")
        files[algorithm] = folder / name
    return files
