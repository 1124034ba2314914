"""The runs of an experiment, each complete in itself."""

import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import yaml

from sb3_mcbs.experiments.algorithms import check_together
from sb3_mcbs.experiments.spec import Agent, Arm, Evaluation, Spec, SpecError
from sb3_mcbs.zoo.paths import PathError, hyperparams_path

_VERSION = re.compile(r"(.+)-v(\d+)")


@dataclass(frozen=True)
class Run:
    """
    One training, or one evaluation of a trained agent, with all that decides about it.

    :param name: of the run, and of its folder
    :param arm: the arm that it belongs to
    :param algorithm: RL Zoo's name of the algorithm; of a trained agent ``actor`` or ``search``
    :param environment: id
    :param seed: of the training, or of the search
    :param steps: environment steps; of a trained agent, episodes
    :param evaluation: how it is evaluated
    :param checkpoint_every: environment steps between two exact checkpoints
    :param params: hyperparameters that replace those of the file, or settings of the search
    :param source: which entry of which file the hyperparameters are
    :param hyperparameters: that entry
    :param agent: that is evaluated; None: one is trained
    """

    name: str
    arm: str
    algorithm: str
    environment: str
    seed: int
    steps: int
    evaluation: Evaluation
    checkpoint_every: int
    params: dict[str, Any]
    source: str = ""
    hyperparameters: dict[str, Any] = field(default_factory=dict)
    agent: Agent | None = None

    @property
    def unit(self) -> str:
        """What ``steps`` counts."""
        return "steps" if self.agent is None else "episodes"

    def as_yaml(self) -> str:
        """
        :return: the run, to be read by :func:`from_yaml`
        """
        return yaml.safe_dump(asdict(self), sort_keys=False, allow_unicode=True)


def from_yaml(text: str) -> Run:
    """
    :param text: from :meth:`Run.as_yaml`
    :return: the run
    """
    content = yaml.safe_load(text)
    agent = content.get("agent") and Agent(**content["agent"])
    return Run(**{**content, "evaluation": Evaluation(**content["evaluation"]), "agent": agent})


def expand(spec: Spec) -> list[Run]:
    """
    List the runs of an experiment: first all with the first seed, to have something to compare early.

    :param spec: the experiment
    :return: its runs
    :raises SpecError: if there are no hyperparameters for one of them
    """
    files = {arm.algorithm: _read_file(spec, arm.algorithm) for arm in spec.arms if spec.environments}
    runs = [
        _run(spec, arm, environment, seed, files[arm.algorithm])
        for seed in spec.seeds
        for environment in spec.environments
        for arm in spec.arms
    ]
    runs += [
        _frozen_run(spec, arm, agent, seed)
        for seed in spec.seeds
        for agent in spec.agents
        for arm in spec.arms
    ]
    names = [run.name for run in runs]
    for name in names:
        if names.count(name) > 1:
            raise SpecError(f"{spec.name}: two runs have the name {name}. Give one of the arms another name.")
    return runs


def _run(spec: Spec, arm: Arm, environment: str, seed: int, file: tuple[Path, dict[str, Any]]) -> Run:
    path, entries = file
    entry, hyperparameters = _entry_for(environment, path, entries)
    _check(spec, arm, {**hyperparameters, **arm.params}, f", {path.name}: {entry}")
    return Run(
        name=f"{arm.name}_{environment.replace('/', '-')}_{seed}",
        arm=arm.name,
        algorithm=arm.algorithm,
        environment=environment,
        seed=seed,
        steps=spec.steps,
        evaluation=spec.evaluation,
        checkpoint_every=spec.checkpoint_every,
        params=arm.params,
        source=f"{path.name}: {entry}",
        hyperparameters=hyperparameters,
    )


def _check(spec: Spec, arm: Arm, hyperparameters: dict[str, Any], where: str = "") -> None:
    try:
        check_together(arm.algorithm, hyperparameters)
    except (TypeError, ValueError) as error:
        raise SpecError(f"{spec.name}: arm {arm.name}{where}: {error}") from error


def _frozen_run(spec: Spec, arm: Arm, agent: Agent, seed: int) -> Run:
    _check(spec, arm, arm.params)
    return Run(
        name=f"{arm.name}_{agent.name}_{seed}",
        arm=arm.name,
        algorithm=arm.algorithm,
        environment=agent.environment,
        seed=seed,
        steps=spec.evaluation.episodes,
        evaluation=spec.evaluation,
        checkpoint_every=0,
        params=arm.params,
        agent=agent,
    )


def _usual_file(algorithm: str) -> Path:
    """This package's file for an algorithm, or RL Zoo's."""
    try:
        return hyperparams_path(algorithm)
    except PathError:
        import rl_zoo3

        return Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algorithm}.yml"


def _read_file(spec: Spec, algorithm: str) -> tuple[Path, dict[str, Any]]:
    """The file with an algorithm's hyperparameters, and what it says by environment."""
    path = spec.hyperparameters.get(algorithm) or _usual_file(algorithm)
    try:
        entries = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise SpecError(f"No hyperparameters for {algorithm}: {path} cannot be read: {error}.") from error
    if not isinstance(entries, dict):
        raise SpecError(f"{path} must be a mapping of environments to hyperparameters.")
    return path, entries


def _entry_for(environment: str, path: Path, entries: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """The hyperparameters for an environment, or else for another version of it, or else the default ones.

    RL Zoo's files know MuJoCo's environments by their v4 names only, and for another name it takes the
    default without a word.
    """
    found = _VERSION.fullmatch(environment)
    versions = [
        (int(match[2]), name)
        for name in entries
        if found and (match := _VERSION.fullmatch(name)) and match[1] == found[1]
    ]
    for name in (environment, max(versions, default=(0, ""))[1], "default"):
        if isinstance(entries.get(name), dict):
            return name, entries[name]
    raise SpecError(
        f"{path} has no hyperparameters for {environment}: add an entry of this name, or default."
    )
