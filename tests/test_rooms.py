"""Which folder may import which: the arrows point one way."""

import ast
from pathlib import Path

import pytest

import sb3_mcbs

PACKAGE = Path(sb3_mcbs.__file__).parent
#: A room may import itself and these.
MAY_IMPORT = {
    "types": [],
    "snapshot": [],
    "models": ["types", "snapshot"],
    "search": ["types"],
    "networks": ["types"],
    "agents": ["types", "snapshot", "models", "search", "networks"],
    "loading": ["types", "snapshot", "models", "search", "networks", "agents"],
    "checkpoints": ["types", "snapshot", "models", "search", "networks", "agents"],
    "video": ["types", "snapshot", "models", "search", "networks", "agents"],
    "sharing": ["types", "snapshot", "models", "search", "networks", "agents", "loading"],
    "zoo": [
        "types",
        "snapshot",
        "models",
        "search",
        "networks",
        "agents",
        "loading",
        "checkpoints",
        "video",
        "sharing",
    ],
}
MAY_IMPORT["experiments"] = [*MAY_IMPORT["zoo"], "zoo"]
MAY_IMPORT["doctor"] = [*MAY_IMPORT["zoo"], "zoo"]
MAY_IMPORT["cli"] = [*MAY_IMPORT["experiments"], "experiments", "doctor"]


def imported_rooms(path: Path) -> set[str]:
    """The rooms that a module imports, also within its functions."""
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            names.append(f"{node.module}.")
        elif isinstance(node, ast.Import):
            names += [f"{alias.name}." for alias in node.names]
    return {name.split(".")[1] for name in names if name.startswith("sb3_mcbs.")} - {""}


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_rooms_import_only_those_below(room: str) -> None:
    files = [*PACKAGE.glob(f"{room}/**/*.py"), *PACKAGE.glob(f"{room}.py")]
    wrong = {file.name: imported_rooms(file) - {room, *MAY_IMPORT[room]} for file in files}
    assert files and not {name: rooms for name, rooms in wrong.items() if rooms}


def test_every_module_is_in_a_room() -> None:
    assert {path.stem for path in PACKAGE.iterdir() if path.name[0] not in "_p"} == MAY_IMPORT.keys()
