"""What an experiment consists of, read from a YAML file and checked."""

import hashlib
import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from sb3_mcbs.experiments.algorithms import check_params, check_search, known_algorithms, known_environments
from sb3_mcbs.experiments.document import Document, Place, SpecError, read_document

SPECS = Path(__file__).parent / "specs"
#: What may be in the name of an arm, which becomes part of a folder's name.
_NAME = re.compile(r"[A-Za-z0-9][\w.+=-]*")
_REQUIRED = ("environments", "seeds", "steps", "evaluation")
_OPTIONAL = ("description", "algorithms", "arms", "hyperparameters", "checkpoint_every")
#: Of a spec that trains nothing.
_REQUIRED_FROZEN = ("agents", "arms", "seeds", "evaluation")
_POLICIES = ("actor", "search")


@dataclass(frozen=True)
class Evaluation:
    """
    How all runs are evaluated.

    :param every: environment steps between two evaluations; 0 where nothing is trained
    :param episodes: of each policy in each evaluation
    :param first_seed: the first episode is reset with this seed, the next with the one after it, and so on:
        in every evaluation of every run
    """

    every: int
    episodes: int
    first_seed: int = 10_000

    @property
    def seeds(self) -> list[int]:
        """Of the episodes."""
        return list(range(self.first_seed, self.first_seed + self.episodes))


@dataclass(frozen=True)
class Arm:
    """
    A variant of an algorithm, or of the search around a trained agent.

    :param name: its name in tables and folders
    :param algorithm: RL Zoo's name of the algorithm; of a trained agent ``actor`` or ``search``
    :param params: hyperparameters that replace those of the file, as RL Zoo's ``-params``, or settings of
        ``SearchPolicy``
    """

    name: str
    algorithm: str
    params: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Agent:
    """
    A trained agent.

    :param name: its name in tables and folders
    :param environment: id
    :param file: as ``save`` wrote it
    :param sha256: of the file
    :param statistics: of its observations, as ``save_statistics`` wrote them; None: none
    """

    name: str
    environment: str
    file: str
    sha256: str
    statistics: str | None = None


@dataclass(frozen=True)
class Spec:
    """
    An experiment: every arm in every environment, or with every trained agent, with every seed.

    :param name: of the experiment
    :param text: the file as it was read
    :param environments: ids
    :param seeds: of the training, or of the search
    :param steps: environment steps of each run
    :param evaluation: how the runs are evaluated
    :param arms: what is compared
    :param hyperparameters: the file of an algorithm, where it is not the usual one
    :param checkpoint_every: environment steps between two exact checkpoints
    :param agents: trained agents that are evaluated; nothing is trained if there are any
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
    agents: list[Agent] = field(default_factory=list)


def read_spec(name: str | Path) -> Spec:
    """
    Read and check a spec.

    :param name: path of a YAML file, or the name of a spec that this package ships
    :return: what it says
    :raises SpecError: if there is no such file, or something in it is wrong
    """
    path = Path(name) if Path(name).suffix else SPECS / f"{name}.yml"
    if not path.is_file():
        shipped = ", ".join(sorted(spec.stem for spec in SPECS.glob("*.yml")))
        raise SpecError(f"There is no file {name}, and no shipped spec of this name; shipped are {shipped}.")
    document = read_document(path)
    if isinstance(document.data, dict) and "agents" in document.data:
        return _frozen_spec(document, path)
    top = document.keys((), document.data, {*_REQUIRED, *_OPTIONAL}, _REQUIRED)
    steps = document.integer(("steps",), top["steps"], 1)
    return Spec(
        name=path.stem,
        text=document.text,
        environments=_environments(document, top["environments"]),
        seeds=_seeds(document, top["seeds"]),
        steps=steps,
        evaluation=_evaluation(document, top["evaluation"], steps),
        arms=_arms(document, top),
        hyperparameters=_hyperparameters(document, top.get("hyperparameters", {}), path.parent),
        checkpoint_every=document.integer(("checkpoint_every",), top.get("checkpoint_every", 10_000), 1),
    )


def _frozen_spec(document: Document, path: Path) -> Spec:
    top = document.keys((), document.data, {"description", *_REQUIRED_FROZEN}, _REQUIRED_FROZEN)
    evaluation = document.keys(("evaluation",), top["evaluation"], ("episodes", "first_seed"), ("episodes",))
    arms = [
        arm
        for name, value in document.mapping(("arms",), top["arms"]).items()
        for arm in _arm(document, ("arms", name), name, value, "policy")
    ]
    agents = [
        _agent(document, ("agents", name), name, value, path.parent)
        for name, value in document.mapping(("agents",), top["agents"]).items()
    ]
    return Spec(
        name=path.stem,
        text=document.text,
        environments=[],
        seeds=_seeds(document, top["seeds"]),
        steps=0,
        evaluation=_checked_evaluation(document, {"every": 0, **evaluation}),
        arms=arms,
        hyperparameters={},
        checkpoint_every=0,
        agents=agents,
    )


def _agent(document: Document, place: Place, name: str, value: Any, folder: Path) -> Agent:
    _check_name(document, place, name)
    keys = document.keys(place, value, ("file", "environment", "statistics"), ("file", "environment"))
    environment = document.choice(
        (*place, "environment"), keys["environment"], known_environments(), "environment"
    )
    file = _find(document, (*place, "file"), keys["file"], folder)
    statistics = None
    if "statistics" in keys:
        statistics = str(_find(document, (*place, "statistics"), keys["statistics"], folder).resolve())
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    return Agent(name, environment, str(file.resolve()), digest, statistics)


def _find(document: Document, place: Place, name: Any, folder: Path) -> Path:
    """A file that the spec names, seen from its own folder or else from the present one."""
    for path in (folder / str(name), Path(str(name))):
        if isinstance(name, str) and path.is_file():
            return path
    raise document.error(place, f"{name!r} is not a file, seen from {folder.resolve()} or from {Path.cwd()}.")


def _seeds(document: Document, value: Any) -> list[int]:
    seeds = document.sequence(("seeds",), value)
    return [document.integer(("seeds", index), seed, 0) for index, seed in enumerate(seeds)]


def _environments(document: Document, value: Any) -> list[str]:
    known = known_environments()
    return [
        document.choice(("environments", index), env, known, "environment")
        for index, env in enumerate(document.sequence(("environments",), value))
    ]


def _evaluation(document: Document, value: Any, steps: int) -> Evaluation:
    place: Place = ("evaluation",)
    settings = document.keys(place, value, ("every", "episodes", "first_seed"), ("every", "episodes"))
    document.integer((*place, "every"), settings["every"], 1)
    evaluation = _checked_evaluation(document, settings)
    if steps % evaluation.every:
        raise document.error(
            (*place, "every"),
            f"{steps} steps are no multiple of {evaluation.every}: the trained agent would not be evaluated.",
        )
    return evaluation


def _checked_evaluation(document: Document, settings: dict[str, Any]) -> Evaluation:
    for name, number in settings.items():
        document.integer(("evaluation", name), number, 1 if name == "episodes" else 0)
    return Evaluation(**settings)


def _arms(document: Document, top: dict[str, Any]) -> list[Arm]:
    algorithms = document.sequence(("algorithms",), top["algorithms"]) if "algorithms" in top else []
    arms = [
        Arm(document.choice(("algorithms", index), algorithm, known_algorithms(), "algorithm"), algorithm)
        for index, algorithm in enumerate(algorithms)
    ]
    for name, value in document.mapping(("arms",), top.get("arms", {})).items():
        for arm in _arm(document, ("arms", name), name, value, "algorithm"):
            if any(arm.name == other.name for other in arms):
                raise document.error(("arms", name), f"there are two arms of the name {arm.name}.")
            arms.append(arm)
    if not arms:
        raise document.error((), "there is nothing to train: it needs algorithms, or arms, or both.")
    return arms


def _check_name(document: Document, place: Place, name: str) -> None:
    if not _NAME.fullmatch(name):
        raise document.error(place, "is no name for this: letters, digits and any of _ . + = - are.")


def _arm(document: Document, place: Place, name: str, value: Any, kind: str) -> list[Arm]:
    """
    :param kind: the key that says what it is a variant of: ``algorithm``, or of a trained agent ``policy``.
    """
    _check_name(document, place, name)
    settings = document.keys(place, value, (kind, "params", "grid"), (kind,))
    known = known_algorithms() if kind == "algorithm" else _POLICIES
    algorithm = document.choice((*place, kind), settings[kind], known, kind)
    check: Callable[..., None] = check_search
    if kind == "algorithm":
        check = partial(check_params, algorithm=algorithm)
    params = document.mapping((*place, "params"), settings.get("params", {}))
    grid = document.mapping((*place, "grid"), settings.get("grid", {}))
    if algorithm == "actor" and (params or grid):
        raise document.error(place, "the actor alone has no settings: remove its params and grid.")
    check(document, (*place, "params"), params=params)
    for key, values in grid.items():
        if key in params:
            raise document.error((*place, "grid", key), "is in params as well.")
        for index, item in enumerate(document.sequence((*place, "grid", key), values)):
            check(document, (*place, "grid"), params={key: item}, index=(index,))
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
        files[algorithm] = _find(document, place, name, folder)
    return files
