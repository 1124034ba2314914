"""The runs of a folder as far as they came: of an experiment, of RL Zoo, or a single one."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import yaml

from sb3_mcbs.experiments.plan import Run
from sb3_mcbs.experiments.results import FINISHED, RunFolder
from sb3_mcbs.zoo.evaluations import ACTOR, SEARCH, Evaluations, load_evaluations, load_policies
from sb3_mcbs.zoo.paths import PathError
from sb3_mcbs.zoo.repeat import load_run

#: What a run's state is called on the page, where it is not finished.
_STATES = {"waiting": "not started", "running": "unfinished", "interrupted": "unfinished"}


class Competitor(NamedTuple):
    """
    What is compared.

    :param arm: the variant
    :param policy: ``actor alone`` or ``actor with search``
    """

    arm: str
    policy: str

    @property
    def label(self) -> str:
        """Its name in pictures and tables."""
        return f"{short(self.arm)}: {self.policy.removeprefix('actor ')}"


@dataclass(frozen=True)
class Result:
    """
    One run.

    :param name: of the run
    :param arm: the arm that it belongs to; of RL Zoo's folders the algorithm
    :param task: what is compared within: the environment, or the trained agent
    :param environment: id
    :param seed: None: nobody recorded it
    :param state: finished, failed, unfinished or not started
    :param folder: RL Zoo's folder of the run, or the file that it was read from
    :param policies: evaluations by policy; empty: there are none yet
    :param settings: hyperparameters that were given for this arm
    :param machines: what it ran on, with the versions of packages
    """

    name: str
    arm: str
    task: str
    environment: str
    seed: int | None
    state: str
    folder: Path
    policies: dict[str, Evaluations]
    settings: dict[str, Any] = field(default_factory=dict)
    machines: list[dict[str, Any]] = field(default_factory=list)

    @property
    def last_step(self) -> int:
        """At which all its policies were evaluated last."""
        return min(int(each.timesteps[-1]) for each in self.policies.values())

    @property
    def time_limit(self) -> int | None:
        """Steps after which an episode ends by itself, where Gymnasium knows."""
        spec = gym.registry.get(self.environment)
        return None if spec is None else spec.max_episode_steps


@dataclass(frozen=True)
class Results:
    """
    All that a report is about.

    :param name: of the folder
    :param runs: in the order of their arms
    :param problems: files that could not be read
    :param frozen: whether agents were evaluated that had been trained before
    :param spec: the experiment's file; None: it is no experiment
    """

    name: str
    runs: list[Result]
    problems: list[str]
    frozen: bool = False
    spec: str | None = None

    @property
    def unit(self) -> str:
        """What a task is."""
        return "agent" if self.frozen else "environment"

    @property
    def evaluated(self) -> list[Result]:
        """The runs that have evaluations."""
        return [run for run in self.runs if run.policies]

    @property
    def tasks(self) -> list[str]:
        """Environments, or trained agents, in which something was evaluated."""
        return list(dict.fromkeys(run.task for run in self.evaluated))

    @property
    def competitors(self) -> list[Competitor]:
        """What is compared: each arm's policies."""
        return list(
            dict.fromkeys(Competitor(run.arm, policy) for run in self.evaluated for policy in run.policies)
        )

    def of(self, task: str, competitor: Competitor | None = None) -> list[Result]:
        """
        :param task: environment or trained agent
        :param competitor: None: all
        :return: evaluated runs
        """
        return [
            run
            for run in self.evaluated
            if run.task == task
            and (competitor is None or (run.arm == competitor.arm and competitor.policy in run.policies))
        ]


def short(arm: str) -> str:
    """
    :param arm: name of an arm
    :return: the same with the paper's letters
    """
    return arm.replace("-beam_width=", " B=").replace("-rollout_depth=", " D=")


def load_folder(folder: Path) -> Results:
    """
    Read what is in a folder.

    :param folder: of an experiment or of one of its runs, RL Zoo's log folder or one of its runs
    :return: its runs; those that cannot be read are named among the problems
    :raises PathError: if nothing in it has been evaluated
    """
    definitions = sorted(folder.glob("runs/*/run.yml")) or sorted(folder.glob("run.yml"))
    evaluated = sorted(folder.glob("*/*_[0-9]*/evaluations.npz"))
    if definitions:
        results = _load_experiment(folder, definitions)
    elif evaluated:
        results = _load_log_folder(folder, [path.parent for path in evaluated])
    else:
        results = Results(folder.absolute().name, [_zoo_run(folder, load_policies(folder), [])], [])
    if not results.evaluated:
        reasons = "\n".join(results.problems) or "Its runs have not come to an evaluation yet."
        raise PathError(f"There is nothing to report in {folder}. {reasons}")
    return results


def _load_experiment(folder: Path, definitions: list[Path]) -> Results:
    spec = folder / "spec.yml"
    text = spec.read_text(encoding="utf-8", errors="replace") if spec.is_file() else None
    problems: list[str] = []
    found = []
    for path in definitions:
        place = RunFolder(path.parent)
        try:
            run = place.run()
        except (OSError, ValueError, TypeError, KeyError, AttributeError, yaml.YAMLError) as error:
            problems.append(f"{path} cannot be read: {_line(error)}")
            continue
        found.append((run, _experiment_run(place, run, problems)))
    order = _order_of_arms(text)
    found.sort(key=lambda each: (*order(each[0].arm), each[1].task, each[0].seed))
    frozen = any(run.agent is not None for run, _ in found)
    return Results(folder.absolute().name, [result for _, result in found], problems, frozen, text)


def _experiment_run(place: RunFolder, run: Run, problems: list[str]) -> Result:
    policies = {}
    folder = place.training(run)
    try:
        if (folder / "evaluations.npz").is_file():
            if run.agent is None:
                policies = load_policies(folder)
            else:
                policies = {ACTOR if run.algorithm == "actor" else SEARCH: load_evaluations(folder)}
    except PathError as error:
        problems.append(_line(error))
    state = place.status["state"]
    return Result(
        name=run.name,
        arm=run.arm,
        task=run.environment if run.agent is None else run.agent.name,
        environment=run.environment,
        seed=run.seed,
        state=_STATES.get(state, state),
        folder=folder,
        policies=policies,
        settings={"algorithm": run.algorithm, **run.params},
        machines=place.machines,
    )


def _load_log_folder(folder: Path, run_folders: list[Path]) -> Results:
    problems: list[str] = []
    runs = []
    for path in run_folders:
        algorithm = path.parent.name
        base = re.sub("_(actor|search)$", "", algorithm)
        if base != algorithm and path.parent.with_name(base) / path.name in run_folders:
            continue  # the other policy of that run
        policies = {}
        try:
            policies = load_policies(path)
        except PathError as error:
            problems.append(_line(error))
        runs.append(_zoo_run(path, policies, problems))
    return Results(folder.absolute().name, _tell_apart(runs), problems)


def _tell_apart(runs: list[Result]) -> list[Result]:
    """Runs of one algorithm with different settings are no seeds of one another, but different arms."""
    told = []
    for run in runs:
        others = [each for each in runs if (each.arm, each.task) == (run.arm, run.task) and each.settings]
        differing = [
            name
            for name in run.settings
            if any(each.settings.get(name) != run.settings[name] for each in others)
        ]
        arm = "-".join([run.arm, *(f"{name}={run.settings[name]}" for name in differing)])
        told.append(replace(run, arm=arm))
    return sorted(
        told,
        key=lambda run: (
            _natural(run.arm),
            run.task,
            run.seed is None,
            run.seed or 0,
            _natural(run.name),
        ),
    )


def _zoo_run(path: Path, policies: dict[str, Evaluations], problems: list[str]) -> Result:
    path = path.absolute()
    environment, _, number = path.name.rpartition("_")
    settings: dict[str, Any] = {}
    args: dict[str, Any] = {}
    if list(path.glob("*/args.yml")):
        try:
            settings, args = load_run(path)
            settings.pop("n_timesteps", None)  # how long it trains does not make it another arm
        except PathError as error:
            problems.append(_line(error))
    environment = str(args.get("env") or environment or path.name)
    finished = (path / f"{environment.replace('/', '-')}.zip").is_file() or (
        path / f"{environment}.zip"
    ).is_file()
    return Result(
        name=f"{path.parent.name}_{environment}_{number}",
        arm=path.parent.name,
        task=environment,
        environment=environment,
        seed=args.get("seed"),
        state=FINISHED if finished else "unfinished",
        folder=path,
        policies=policies,
        settings=settings,
    )


def _order_of_arms(spec: str | None) -> Any:
    """From an arm's name, a key for sorting: as the spec has the arms, and grids by their numbers."""
    names: list[str] = []
    if spec is not None:
        try:
            content = yaml.safe_load(spec)
            names = [*content.get("algorithms", []), *content.get("arms", {})]
        except (yaml.YAMLError, AttributeError, TypeError):
            names = []  # the order of the alphabet, then

    def key(arm: str) -> tuple[int, list[Any]]:
        of_arm = [name for name in names if arm == name or arm.startswith(f"{name}-")]
        place = names.index(max(of_arm, key=len)) if of_arm else len(names)
        return place, _natural(arm)

    return key


def _natural(name: str) -> list[Any]:
    """A key for sorting in which numbers are numbers."""
    parts = re.split(r"(\d+)", name)
    return [(0, float(part), "") if part.isdigit() else (1, 0.0, part) for part in parts]


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


def at(evaluations: Evaluations, step: int) -> int | None:
    """
    :param evaluations: of one policy of a run
    :param step: environment steps
    :return: which evaluation is the last one until then; None: all are later
    """
    n_until = int(np.searchsorted(evaluations.timesteps, step, side="right"))
    return n_until - 1 if n_until else None
