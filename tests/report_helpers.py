"""Folders of runs with known numbers, to be reported on."""

import html.parser
import re
from pathlib import Path
from typing import Any

import numpy as np

from sb3_mcbs.experiments.evaluation import write_evaluations
from sb3_mcbs.experiments.plan import Run
from sb3_mcbs.experiments.report.content import Table
from sb3_mcbs.experiments.results import FINISHED, RunFolder
from sb3_mcbs.experiments.spec import Agent, Evaluation
from sb3_mcbs.zoo.paths import sibling_folder

STEPS = 300
SPEC = "arms:\n  td3: {algorithm: td3}\n  mcbs_td3: {algorithm: mcbs_td3}\n"


def add_run(
    folder: Path, arm: str, environment: str, seed: int, agent: Agent | None = None, **params: Any
) -> RunFolder:
    """Plan a run in the folder of an experiment."""
    algorithm = "mcbs_td3" if arm.startswith("mcbs") else "td3"
    if agent is not None:
        algorithm = "actor" if arm == "actor" else "search"
    run = Run(
        name=f"{arm}_{agent.name if agent else environment}_{seed}",
        arm=arm,
        algorithm=algorithm,
        environment=environment,
        seed=seed,
        steps=STEPS,
        evaluation=Evaluation(100, 2),
        checkpoint_every=100,
        params=params,
        agent=agent,
    )
    place = RunFolder(folder / "runs" / run.name)
    place.create(run)
    return place


def evaluate(place: RunFolder, means: list[float], search: list[float] | None = None, falls: int = 0) -> None:
    """Write evaluations of two episodes, one below and one above each mean; the last ones may be short."""
    run = place.run()
    own = place.training(run)
    searches = run.algorithm == "mcbs_td3"
    steps = np.arange(1, len(means) + 1) * 100 if run.agent is None else np.array([0])
    lengths = np.full((len(means), 2), 1000)
    lengths[-1, :falls] = 500
    for policy, values in (("actor", means), ("search", search)):
        if values is not None:
            is_own = run.agent is not None or policy == ("search" if searches else "actor")
            write_evaluations(
                own if is_own else sibling_folder(own, policy),
                {
                    "timesteps": steps,
                    "results": [[value - 1, value + 1] for value in values],
                    "ep_lengths": lengths,
                    "seeds": [0, 1],
                    "simulated_steps": steps * (10 if searches else 0),
                    "seconds": steps * 36.0,
                },
            )
    if len(means) * 100 >= STEPS or run.agent is not None:
        place.status = {"state": FINISHED}


def experiment(folder: Path) -> Path:
    """Two arms, two environments, three seeds; one run is at 200 of 300 steps, one has not begun."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "spec.yml").write_text(SPEC)
    for seed in range(3):
        for environment, scale in (("HalfCheetah-v5", 1000.0), ("Walker2d-v5", 100.0)):
            base = [scale * (1 + seed), scale * (2 + seed), scale * (3 + seed)]
            evaluate(add_run(folder, "td3", environment, seed), base, falls=seed % 2)
            place = add_run(folder, "mcbs_td3", environment, seed)
            if (environment, seed) == ("Walker2d-v5", 2):
                continue
            better = [value + 5 * scale for value in base]
            short = (environment, seed) == ("Walker2d-v5", 1)
            last = 2 if short else 3
            evaluate(place, better[:last], [value + scale for value in better[:last]])
    return folder


def frozen(folder: Path) -> Path:
    """Agents that were trained before, alone and with search of four sizes."""
    agent = Agent("sac", "HalfCheetah-v4", "sac.zip", "0" * 64)
    evaluate(add_run(folder, "actor", "HalfCheetah-v4", 0, agent), [10.0])
    for width in (6, 18):
        for depth in (1, 3):
            sizes = {"beam_width": width, "rollout_depth": depth}
            arm = f"search-beam_width={width}-rollout_depth={depth}"
            evaluate(add_run(folder, arm, "HalfCheetah-v4", 0, agent, **sizes), [10.0 * width + depth])
    return folder


def zoo(folder: Path, algorithm: str = "ppo", runs: int = 2) -> Path:
    """RL Zoo's log folder of an algorithm that this package knows nothing about."""
    for number in range(1, runs + 1):
        run = folder / algorithm / f"Hopper-v5_{number}"
        run.mkdir(parents=True)
        np.savez(
            run / "evaluations.npz",
            timesteps=[50_000, 100_000],
            results=np.array([[1.0, 3.0], [100.0 * number, 100.0 * number]]),
            ep_lengths=np.array([[10, 20], [1000, 300]]),
        )
        (run / "Hopper-v5.zip").touch()
    return folder


class Page(html.parser.HTMLParser):
    """Checks that elements are closed in order, and collects what a page refers to."""

    VOID = ("meta", "br", "link", "img", "hr", "input")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> in {self.open[-3:]}"


def check_page(path: Path) -> str:
    """The text of a page that is well-formed and complete in itself."""
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert not page.open
    ids = [value for _, name, value in page.attributes if name == "id"]
    assert len(ids) == len(set(ids))
    links = [value for _, name, value in page.attributes if name in ("href", "src", "xlink:href")]
    assert links and all(link.startswith("#") and link[1:] in ids for link in links)
    assert set(re.findall(r"url\(#([^)]*)\)", text)) <= set(ids) and "url(http" not in text
    assert "@import" not in text and "<script" not in text
    assert text.count("<figure>") == text.count('role="img"') == text.count("<summary>Numbers")
    return text


def rows_of(table: Table) -> dict[str, dict[str, str]]:
    return {row[0]: dict(zip(table.head, row, strict=True)) for row in table.rows}
