"""The documentation: its code runs, its tables and messages are those of the code, its links lead somewhere.

An HTML comment before a block of code, which readers do not see, says how it is tested:

- ``<!-- test: slow -->``: with the slow tests; then so is the whole page;
- ``<!-- test: 100_000 -> 300; 10_000 -> 50 -->``: with other numbers;
- ``<!-- test: needs pybullet -->``: where that module is installed;
- ``<!-- test: skip, it needs a database -->``: not at all;
- ``<!-- test setup``, code, ``-->``: after that code.

The blocks of a page are run one after another in one module. Agents of the hub are replaced by untrained
ones.
"""

import argparse
import ast
import inspect
import re
import runpy
import shlex
import sys
import tomllib
import types
from collections.abc import Iterator
from dataclasses import fields
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import huggingface_hub
import pytest
import yaml
from markdown_it import MarkdownIt

import sb3_mcbs
from sb3_mcbs import MCBS, ExactCheckpointCallback, SearchPolicy, SnapshotEnvWrapper, cli
from sb3_mcbs.agents import EnsembleSettings, ScheduleSettings
from sb3_mcbs.agents.hyperparameters import SETTINGS
from sb3_mcbs.agents.registry import ALGORITHMS
from sb3_mcbs.models import families
from sb3_mcbs.search import PRESETS, BeamSettings, CEMSettings, SearchSettings, TreeSettings
from sb3_mcbs.search.settings import KEYWORDS, STRATEGIES
from tests.agent_files import untrained_agent, untrained_repository

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
BESIDE = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")]
PAGES = [*BESIDE, *sorted(path for path in DOCS.rglob("*.md") if "_build" not in path.parts)]
#: The sub-packages that users import from.
PACKAGES = [
    "agents",
    "checkpoints",
    "experiments",
    "loading",
    "models",
    "search",
    "sharing",
    "snapshot",
    "video",
    "zoo",
]
#: Where absolute links lead to files of the checkout.
ON_GITHUB = (
    "https://github.com/sb3-mcbs/sb3-mcbs/blob/main/",
    "https://raw.githubusercontent.com/sb3-mcbs/sb3-mcbs/main/",
)
COMMAND = re.compile(r"(?:python3? -m [\w.]+|sb3-mcbs [\w-]+|make [\w-]+)(?=\s|$).*")


class Block(NamedTuple):
    """A block of code."""

    language: str
    code: str
    note: str
    line: int

    @property
    def code_to_run(self) -> str:
        code = self.code
        for change in self.note.split(";"):
            if "->" in change:
                old, new = change.split("->")
                assert old.strip() in code, f"line {self.line}: there is no {old.strip()} to replace"
                code = code.replace(old.strip(), new.strip())
        return "\n" * self.line + code  # the line numbers of tracebacks are the page's

    @property
    def runs(self) -> bool:
        needed = re.match(r"needs (\w+)", self.note)
        return not self.note.startswith("skip") and (needed is None or find_spec(needed[1]) is not None)


def blocks_of(path: Path, *languages: str) -> list[Block]:
    found, note = [], ""
    for token in MarkdownIt("commonmark").parse(path.read_text(encoding="utf-8")):
        if token.type == "fence" and token.info.strip() in languages:
            assert token.map is not None
            found.append(Block(token.info.strip(), token.content, note, token.map[0] + 1))
        comment = re.fullmatch(r"<!-- test(: | setup\n)(.*?)( ?-->)\s*", token.content, flags=re.DOTALL)
        note = ""
        if token.type == "html_block" and comment is not None and token.map is not None:
            if comment[1] == ": ":
                note = comment[2]
            elif "python" in languages:
                found.append(Block("python", comment[2], "", token.map[0] + 1))
    return found


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def pages_with(*languages: str) -> list:
    """Pages with blocks of a language; slow ones are marked."""
    found = []
    for path in PAGES:
        if blocks := blocks_of(path, *languages):
            slow = [pytest.mark.slow] if any(block.note.startswith("slow") for block in blocks) else []
            found.append(pytest.param(path, id=name_of(path), marks=slow))
    return found


@pytest.fixture
def nothing_stays_registered(own_adapters: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(families, "_FAMILIES", dict(families._FAMILIES))


@pytest.mark.parametrize("path", pages_with("python"))
def test_the_code_of_a_page_runs(
    path: Path, tmp_path: Path, nothing_stays_registered: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", untrained_agent)
    monkeypatch.setattr(huggingface_hub, "snapshot_download", untrained_repository)
    module = types.ModuleType(re.sub(r"\W", "_", f"page_{name_of(path)}"))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    for block in blocks_of(path, "python"):
        if block.runs:
            exec(compile(block.code_to_run, str(path), "exec"), vars(module))


class Parsed(Exception):
    """A command line was understood."""


@pytest.fixture
def only_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands end where they have parsed their arguments."""
    parse = argparse.ArgumentParser.parse_known_args

    def parse_all(self, args=None, namespace=None):
        _, rest = parse(self, args, namespace)
        if rest:
            self.error(f"unrecognized arguments: {' '.join(rest)}")
        raise Parsed

    def parse_known(self, args=None, namespace=None):
        parse(self, args, namespace)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_all)
    monkeypatch.setattr(argparse.ArgumentParser, "parse_known_args", parse_known)


def commands_of(path: Path) -> Iterator[list[str]]:
    """Commands of this package, of RL Zoo and of the Makefile in a page, as words."""
    for block in blocks_of(path, "bash", "console"):
        lines = [] if block.note.startswith("skip") else block.code.replace("\\\n", " ").splitlines()
        if any(line.startswith("$ ") for line in lines):  # the others are what the commands print
            lines = [line for line in lines if line.startswith("$ ")]
        for line in lines:
            if found := COMMAND.search(line):
                text = re.sub(r"\$\w+|\$\{\w+\}", "1", found[0])
                yield [word for word in shlex.split(text, comments=True) if word != "&"]


@pytest.mark.parametrize("path", [path for path in PAGES if any(commands_of(path))], ids=name_of)
def test_commands_have_the_arguments_that_a_page_gives_them(
    path: Path, only_parsed: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    targets = set(re.findall(r"^([\w-]+(?: [\w-]+)*):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    targets = {target for line in targets for target in line.split()}
    for words in commands_of(path):
        if words[0] == "make":
            assert words[1] in targets, words
            continue
        module = words[2] if words[0].startswith("python") else ""
        module = module.replace("rl_zoo3.train", "sb3_mcbs.zoo.train")  # which needs no hook
        monkeypatch.setattr(sys, "argv", ["sb3-mcbs", *words[1:]] if not module else [module, *words[3:]])
        with pytest.raises(Parsed):
            runpy.run_module(module, run_name="__main__") if module else cli.main()


@pytest.mark.parametrize("path", pages_with("yaml"))
def test_yaml_can_be_read(path: Path) -> None:
    for block in blocks_of(path, "yaml"):
        assert yaml.safe_load(block.code), f"line {block.line}"


def anchors_of(path: Path) -> set[str]:
    """Headings as GitHub names them in links."""
    tokens = MarkdownIt("commonmark").parse(path.read_text(encoding="utf-8"))
    headings = [tokens[i + 1].content for i, token in enumerate(tokens) if token.type == "heading_open"]
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading) for heading in headings]
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("path", PAGES, ids=name_of)
def test_links_lead_somewhere(path: Path) -> None:
    text = re.sub(r"(```|~~~).*?\1|`[^`\n]*`", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    for pair in re.findall(r"\]\(([^)\s]+)\)|^\[[^\]]+\]: (\S+)", text, flags=re.MULTILINE):
        target, folder = "".join(pair), path.parent
        for address in ON_GITHUB:
            if target.startswith(address):
                target, folder = target.removeprefix(address), ROOT
        name, _, anchor = target.partition("#")
        if "://" not in target and not target.startswith("mailto:"):
            file = (folder / name).resolve() if name else path
            assert file.exists(), target
            assert not anchor or anchor in anchors_of(file), target


def test_links_of_the_readme_are_absolute_as_pypi_needs_them() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)\s]+)\)|^\[[^\]]+\]: (\S+)", text, flags=re.MULTILINE)
    assert not [pair for pair in links if not "".join(pair).startswith("https://")]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert ON_GITHUB[0].startswith(project["urls"]["Source"])


def texts_of_the_code() -> str:
    """All texts in the package, with ``...`` for what is filled in."""
    found = []
    for path in (ROOT / "sb3_mcbs").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [part.value if isinstance(part, ast.Constant) else "..." for part in node.values]
                found.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return "\n".join(found)


def test_messages_are_those_of_the_code() -> None:
    text = texts_of_the_code()
    messages = re.findall(
        r"^#+ `(.*)`$", (DOCS / "errors.md").read_text(encoding="utf-8"), flags=re.MULTILINE
    )
    assert len(messages) > 20
    for message in messages:
        for part in message.split("..."):
            assert part.strip() in text, message


def table_of(heading: str) -> dict[str, list[str]]:
    """A table of the page of settings, by name."""
    text = (DOCS / "settings.md").read_text(encoding="utf-8")
    section = re.split(r"^## ", text.partition(f"\n## {heading}\n")[2], flags=re.MULTILINE)[0]
    rows = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("| `")]
    return {
        ast.literal_eval(name.strip().strip("`")) if '"' in name else name.strip().strip("`"): [
            cell.strip() for cell in rest
        ]
        for name, *rest in rows
    }


def defaults_of(table: dict[str, list[str]]) -> dict[str, object]:
    return {name: ast.literal_eval(cells[0].strip("`")) for name, cells in table.items()}


def known_by(table: dict[str, list[str]], choice: str) -> set[str]:
    return {name for name, cells in table.items() if choice in cells[-1].split(", ")}


def field_defaults(*classes: type) -> dict[str, object]:
    return {
        field.name: field.default for cls in classes for field in fields(cls) if field.name in cls.in_group()
    }


def test_the_results_are_those_of_their_csv_files() -> None:
    tables = runpy.run_path(str(DOCS / "results" / "tables.py"))
    data = tables["read"]()
    pages = [page.read_text() for page in tables["PAGES"]]
    for name in (*tables["TABLES"], "reached"):
        assert sum(f"<!-- {name} -->" in page for page in pages) == 1
    assert [tables["with_tables"](page, data) for page in pages] == pages


def test_the_page_of_settings_has_all_with_their_defaults() -> None:
    search, training = table_of("The search"), table_of("While training")
    assert defaults_of(search) | defaults_of(training) == {
        **SETTINGS,
        "fast_update": True,
        "cuda_graphs": True,
    }
    assert set(search) == {*KEYWORDS, "preset"}
    assert set(inspect.signature(SearchPolicy).parameters) >= set(search)
    assert defaults_of(table_of("search_kwargs")) == field_defaults(BeamSettings, TreeSettings, CEMSettings)
    assert defaults_of(table_of("schedule_kwargs")) == field_defaults(ScheduleSettings)
    assert defaults_of(table_of("model_kwargs")) == {"n_threads": 0, **field_defaults(EnsembleSettings)}


def test_the_page_of_settings_says_who_knows_them() -> None:
    search = table_of("search_kwargs")
    for name, cls in STRATEGIES.items():
        assert known_by(search, name) == set(cls.in_group())
    training = table_of("While training")
    for cls in ALGORITHMS.values():
        if issubclass(cls, MCBS):
            parameters = set(inspect.signature(cls).parameters)
            expected = known_by(training, "agents") | known_by(training, f"`{cls.__name__}`")
            assert expected == (parameters & set(training))
            assert parameters >= set(table_of("The search"))
    models = table_of("model_kwargs")
    assert known_by(models, "ensemble") == set(EnsembleSettings.in_group())


def test_the_page_of_settings_has_the_presets() -> None:
    table = table_of("Presets")
    assert {name: eval(f"dict({cells[0].strip('`')})") for name, cells in table.items()} == PRESETS
    steps = {name: SearchSettings.preset(name).simulated_steps() for name in PRESETS}
    assert {name: int(cells[1]) for name, cells in table.items()} == steps


def test_the_page_of_settings_has_defaults_of_other_objects() -> None:
    for cls in (SearchPolicy, SnapshotEnvWrapper, ExactCheckpointCallback):
        parameters = inspect.signature(cls).parameters
        table = table_of("What else has settings")
        theirs = known_by(table, f"`{cls.__name__}`")
        assert theirs
        assert {name: parameters[name].default for name in theirs} == {
            name: default for name, default in defaults_of(table).items() if name in theirs
        }


def test_the_api_pages_have_all_public_names() -> None:
    pages = {path.stem: path.read_text(encoding="utf-8") for path in (DOCS / "api").glob("*.rst")}
    named = set(
        re.findall(r"^\.\. \w+:: sb3_mcbs\.(?:\w+\.)?(\w+)$", "\n".join(pages.values()), flags=re.MULTILINE)
    )
    assert named >= set(sb3_mcbs.__all__) - {"__version__"}
    for name in PACKAGES:
        assert f".. automodule:: sb3_mcbs.{name}\n   :members:" in pages[name]
        left_out = re.search(r":exclude-members: (.*)", pages[name])
        assert left_out is None or set(left_out[1].split(", ")) <= named
