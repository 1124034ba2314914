"""``make support-table``: which environments work, what simulates them, and what their users should set.

Each row is what ``sb3-mcbs doctor`` finds out about one environment, in a process of its own. What is not
installed, or cannot be made, is a row as well.
"""

import argparse
import sys
import textwrap
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from benchmarks import common
from sb3_mcbs.agents.hyperparameters import SETTINGS
from sb3_mcbs.doctor.child import Request
from sb3_mcbs.doctor.isolation import examine
from sb3_mcbs.doctor.report import block

#: Seconds that a stage of the examination may take.
LIMIT = 180.0
FACTORIES = f"{Path(__file__).with_name('support_envs.py')}:"
HEADER = ("environment", "adapter", "forward model", "exact", "ms per decision", "set")
#: The lines of the page between which the table stands.
BEGIN, END = "<!-- support table -->", "<!-- end of the support table -->"
#: The adapters' names in the table.
_ADAPTERS = {
    "MjModelAdapter": "MuJoCo",
    "MjDataAdapter": "MuJoCo",
    "PhysicsAdapter": "dm_control",
    "ServerAdapter": "PyBullet",
    "BulletAdapter": "PyBullet",
}


class Row(NamedTuple):
    """An environment.

    :param name: in the table.
    :param environment: for the doctor; the name by default.
    :param package: that it is in; empty: Gymnasium itself, or this repository.
    :param wrappers: around it.
    :param also: a setting that the doctor cannot know.
    """

    name: str
    environment: str = ""
    package: str = ""
    wrappers: tuple[str, ...] = ()
    also: str = ""


_HER = "`HerReplayBuffer`"
ROWS = (
    Row("HalfCheetah-v5"),
    Row("Humanoid-v5"),
    Row("own XML: mocap body, actuator with state, sensors", FACTORIES + "pulled_arm"),
    Row("pure Python", f"{FACTORIES}drone"),
    Row("Pendulum-v1"),
    Row("FetchReach-v4", FACTORIES + "fetch_reach", "gymnasium-robotics", also=_HER),
    Row("FetchPush-v4", FACTORIES + "fetch_push", "gymnasium-robotics", also=_HER),
    Row("HandReach-v3", FACTORIES + "hand_reach", "gymnasium-robotics", also=_HER),
    Row("PointMaze_UMaze-v3", "gymnasium_robotics:PointMaze_UMaze-v3", "gymnasium-robotics", also=_HER),
    Row("AdroitHandDoor-v1", "gymnasium_robotics:AdroitHandDoor-v1", "gymnasium-robotics"),
    Row("dm_control/cheetah-run-v0", "shimmy:dm_control/cheetah-run-v0", "shimmy"),
    Row("dm_control/reacher-easy-v0", "shimmy:dm_control/reacher-easy-v0", "shimmy"),
    Row("Meta-World reach-v3", FACTORIES + "meta_world", "metaworld"),
    Row("HopperBulletEnv-v0", "pybullet_envs_gymnasium:HopperBulletEnv-v0", "pybullet-envs-gymnasium"),
    Row("LunarLanderContinuous-v3", package="Box2D"),
    Row("BipedalWalker-v3", package="Box2D"),
)


def measure(row: Row) -> dict[str, Any]:
    """Examine one environment.

    :param row: the environment.
    :return: what the doctor found, and ``hyperparameters`` from its block; or ``missing``, a package.
    """
    if row.package:
        try:
            version(row.package)
        except PackageNotFoundError:
            return {"missing": row.package}
    name = row.environment or row.name
    request = Request(name, list(row.wrappers), None, None, False, 1, 1.0)
    found = examine(request, LIMIT, lambda stage: print(f"{row.name}: {stage}", file=sys.stderr))
    text = block(found, name, list(row.wrappers))
    entry = {} if text is None else next(iter(yaml.safe_load(text).values()))
    return {**found, "hyperparameters": entry}


class Table:
    """The rows in Markdown. Search settings that several rows share are told once, below, by a letter."""

    def __init__(self) -> None:
        self.rows: list[list[Any]] = [list(HEADER), ["---"] * len(HEADER)]
        self.settings: dict[str, str] = {}

    def add(self, row: Row, found: dict[str, Any]) -> None:
        """Add a line.

        :param row: the environment.
        :param found: from :func:`measure`.
        """
        name = f"`{row.name}`" if "-v" in row.name else row.name
        name += f" ({row.package})" if row.package else ""
        if "missing" in found:
            rest = [None, None, f"not installed: `pip install {row.package}`", None, None]
        elif "snapshot" not in found:
            rest = [None, None, f"no: {found['problem']}", None, self._settings(row, found)]
        else:
            rest = [*_measured(found), self._settings(row, found)]
        self.rows.append([name, *rest])

    def _settings(self, row: Row, found: dict[str, Any]) -> str | None:
        """What an entry for RL Zoo needs besides SB3's usual hyperparameters."""
        entry = found["hyperparameters"]
        search = {key: value for key, value in entry.items() if key in SETTINGS}
        if not search:
            return None
        text = yaml.safe_dump(search, default_flow_style=True, sort_keys=False, width=1000).strip()
        letter = self.settings.setdefault(text, chr(ord("A") + len(self.settings)))
        policy = entry["policy"]
        return ", ".join(filter(None, [letter, "" if policy == "MlpPolicy" else f"`{policy}`", row.also]))

    def lines(self) -> Iterator[str]:
        """The table, and what its letters mean."""
        for row in self.rows:
            yield "| " + " | ".join(map(common.shown, row)) + " |"
        yield ""
        for text, letter in self.settings.items():
            yield textwrap.fill(f"- **{letter}** `{text}`", 120, subsequent_indent="  ")


def _measured(found: dict[str, Any]) -> list[Any]:
    """What captures an environment and simulates it, whether that is exact, and what a decision costs."""
    snapshot, model = found["snapshot"], found["forward_model"]
    classes = [each.split(" ")[0] for each in snapshot["captured_by"]]
    names = sorted({_ADAPTERS.get(each, each) for each in classes})
    adapter = "replay of the episode" if snapshot["replays"] else ", ".join(names) or "Python attributes"
    kind = {"mujoco": "batch", "pool": "copies"}[model["kind"]]
    cost = next(cost for cost in found["costs"] if cost["preset"] == "paper")
    return [
        adapter,
        kind if model["deterministic"] else f"{kind}, random steps",
        f"{snapshot['steps_compared']} steps",
        cost.get("milliseconds", "too slow"),
    ]


def main() -> None:
    """Measure, print the table, and write it into the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--page", type=Path, help="the page whose table is replaced")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="rows; by default all")
    args = common.parse_args(parser)
    rows = [row for row in ROWS if not args.only or row.name in args.only]
    found = {row.name: measure(row) for row in rows}
    table = Table()
    for row in rows:
        table.add(row, found[row.name])
    text = "\n".join(table.lines())
    print(text)
    common.write("support", found)
    if args.page is not None:
        before, _, rest = args.page.read_text().partition(BEGIN)
        _, end, after = rest.partition(END)
        if not end:
            sys.exit(f"{args.page} has no lines {BEGIN} and {END} between which the table belongs.")
        args.page.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}")


if __name__ == "__main__":
    main()
