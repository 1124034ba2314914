"""What is installed, and what an installation does to an interpreter."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import pytest
import yaml

import _sb3_mcbs_build as build

ROOT = Path(__file__).resolve().parents[1]
METADATA = tomllib.loads((ROOT / "pyproject.toml").read_text())
#: What RL Zoo's commands import without declaring it.
UNDECLARED_BY_RL_ZOO = {"moviepy", "pandas", "requests", "rich", "tensorboard", "tqdm"}


def normalised(requirement: str) -> str:
    name = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert name is not None, requirement
    return re.sub(r"[-_.]+", "-", name[0]).lower()


@pytest.fixture(scope="module")
def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    entries = [line for line in lines if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][0-9A-Za-z.]*", entry) for entry in entries), entries
    return {normalised(entry): entry.partition("==")[2] for entry in entries}


def test_every_dependency_is_open_in_the_metadata_and_pinned_in_the_constraints(pins: dict[str, str]) -> None:
    project = METADATA["project"]
    extras = chain(*project["optional-dependencies"].values())
    requirements = [*project["dependencies"], *(each for each in extras if not each.startswith("sb3-mcbs["))]
    assert not [requirement for requirement in requirements if "==" in requirement or "<" in requirement]
    assert {normalised(requirement) for requirement in requirements} <= set(pins)
    assert pins["torch"] == "2.13.0"


def test_continuous_integration_tries_the_oldest_versions() -> None:
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"]
    tried = {each["name"]: each["versions"] for each in jobs["versions"]["strategy"]["matrix"]["include"]}
    project = METADATA["project"]
    bounds = {
        normalised(entry): entry.partition(">=")[2]
        for entry in [*project["dependencies"], *project["optional-dependencies"]["zoo"]]
        if ">=" in entry
    }
    pins = {normalised(entry): entry.partition("==")[2] for entry in tried["oldest"].split()}
    assert pins.keys() == bounds.keys()
    assert all(pins[name] in (bound, f"{bound}.0") for name, bound in bounds.items()), (pins, bounds)
    pythons = jobs["check"]["strategy"]["matrix"]["python-version"]
    named = [entry.rpartition(" ")[2] for entry in project["classifiers"] if re.search(r":: 3\.\d+$", entry)]
    assert pythons == named


def test_page_of_versions_names_the_bounds_and_the_pins(pins: dict[str, str]) -> None:
    page = (ROOT / "docs" / "versions.md").read_text()
    rows = [[cell.strip() for cell in line.split("|")[1:4]] for line in page.splitlines() if "|" in line]
    cells = {name: (oldest, pinned) for name, oldest, pinned in rows}
    project = METADATA["project"]
    needed = " ".join([*project["dependencies"], *project["optional-dependencies"]["zoo"]])
    for name, distribution in {
        "PyTorch": "torch",
        "Stable-Baselines3, SB3-Contrib": "stable-baselines3",
        "Gymnasium": "gymnasium",
        "MuJoCo": "mujoco",
        "NumPy": "numpy",
        "Numba": "numba",
        "RL Zoo (extra `zoo`)": "rl-zoo3",
        "Optuna (extra `zoo`)": "optuna",
    }.items():
        oldest, pinned = cells[name]
        bound = re.search(rf"(?:^| ){distribution}(?:\[\w+\])?>=(\S+)", needed)
        assert oldest.removesuffix(".0") == (bound[1] if bound else ""), name
        assert pinned == pins[distribution], name


def test_commands_of_rl_zoo_find_what_they_import() -> None:
    zoo = {normalised(entry) for entry in METADATA["project"]["optional-dependencies"]["zoo"]}
    plain = {normalised(entry) for entry in METADATA["project"]["dependencies"]}
    assert zoo | plain >= UNDECLARED_BY_RL_ZOO and not zoo & plain
    plots = {normalised(entry) for entry in METADATA["project"]["optional-dependencies"]["plots"]}
    assert plots >= {"rliable", "scipy", "seaborn"}


def without_rl_zoo() -> str:
    """Code after which nothing of the extra ``zoo`` can be imported."""
    zoo = [
        normalised(entry).replace("-", "_") for entry in METADATA["project"]["optional-dependencies"]["zoo"]
    ]
    hidden = {*zoo, "huggingface_hub", "huggingface_sb3"} - {"jinja2"}  # torch brings its own jinja2
    return f"import sys; sys.modules.update(dict.fromkeys({sorted(hidden)}))\n"


@pytest.mark.parametrize("name", ["check_gpu", "support_table"])
def test_measurements_for_other_machines_need_no_rl_zoo(name: str) -> None:
    code = f"{without_rl_zoo()}import benchmarks.{name}"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_without_rl_zoo_its_commands_say_what_to_install_and_the_others_work(tmp_path: Path) -> None:
    code = (
        f"{without_rl_zoo()}"
        "from sb3_mcbs import cli\n"
        "for words in sys.argv[1:]:\n"
        "    sys.argv = ['sb3-mcbs', *words.split()]\n"
        "    try:\n"
        "        cli.main()\n"
        "    except SystemExit as end:\n"
        "        print(end)"
    )
    works = ("doctor", "evaluate", "watch", "convert-statistics")
    needs = ("train", "experiment", "resume", "report")
    words = ["--version", *(f"{command} --help" for command in works), *needs]
    done = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.stdout.startswith("sb3-mcbs "), done.stdout + done.stderr
    for command in works:
        assert f"usage: sb3-mcbs {command}" in done.stdout
    for command in needs:
        assert re.search(
            rf"^sb3-mcbs {command}: .*: pip install 'sb3-mcbs\[zoo\]'$", done.stdout, re.MULTILINE
        )


def test_pth_line_survives_whatever_goes_wrong(tmp_path: Path) -> None:
    (tmp_path / "_sb3_mcbs_hook.py").write_text("raise RuntimeError('broken')\n")
    assert build.PTH_LINE.count("\n") == 1 and build.PTH_LINE.startswith("import ")
    for path in (tmp_path, tmp_path / "nowhere"):
        code = f"import sys; sys.path[:0] = [{str(path)!r}]\n{build.PTH_LINE}print('alive')"
        done = subprocess.run(
            [sys.executable, "-I", "-S", "-c", code], capture_output=True, text=True, check=True
        )
        assert (done.stdout, done.stderr) == ("alive\n", "")


def test_files_added_to_a_wheel_are_recorded(tmp_path: Path) -> None:
    wheel = tmp_path / "a-1-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("a.py", "x = 1\n")
        archive.writestr("a-1.dist-info/RECORD", "a.py,,\na-1.dist-info/RECORD,,\n")
    build.add_to_wheel(wheel, {"a.pth": b"import a\n"})
    with zipfile.ZipFile(wheel) as archive:
        assert sorted(archive.namelist()) == ["a-1.dist-info/RECORD", "a.pth", "a.py"]
        assert archive.read("a.pth") == b"import a\n"
        assert archive.read("a.py") == b"x = 1\n"
        # sha256 of the nine bytes, URL-safe base64 without padding.
        record = archive.read("a-1.dist-info/RECORD").decode().splitlines()
        assert "a.pth,sha256=BrJAlXgrDEe7igFhXyMQkumY_81HoRQgLOdTAVv42f4,9" in record
    assert list(tmp_path.iterdir()) == [wheel]


def test_type_checkers_find_what_make_installed(tmp_path: Path) -> None:
    """They look for folders on the import path, and do not run the import hooks of editable packages."""
    code = "from importlib.machinery import PathFinder; print(PathFinder.find_spec('sb3_mcbs').origin)"
    alone = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False, env=alone
    )
    assert done.returncode == 0 and Path(done.stdout.strip()).with_name("py.typed").is_file(), done.stderr


class Environment:
    """A virtual environment that sees the packages of the present one, but not this project."""

    def __init__(self, folder: Path) -> None:
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
        self.python = folder / "bin" / "python"
        self.site_packages = next(folder.glob("lib/python*/site-packages"))
        base = next(path for path in map(Path, sys.path) if (path / "stable_baselines3").is_dir())
        # The present environment's .pth files are not processed this way, this project's hook included.
        (self.site_packages / "base.pth").write_text(f"{base}\n")

    def run(self, *words: str, cwd: Path | None = None, **environment: str) -> str:
        done = subprocess.run(
            [self.python, *words],
            cwd=cwd or self.python.parent,
            capture_output=True,
            text=True,
            check=False,
            env={**{k: v for k, v in os.environ.items() if k != "PYTHONPATH"}, **environment},
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def pip(self, *words: str) -> str:
        return self.run("-m", "pip", *words)


@pytest.fixture(scope="module", params=["wheel", "editable"])
def installed(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Environment]:
    """This project, installed from a copy, so that building leaves nothing in the checkout."""
    folder = tmp_path_factory.mktemp(request.param)
    source = folder / "source"
    source.mkdir()
    for name in ("sb3_mcbs", "hyperparams", *(path.name for path in ROOT.glob("*.*"))):
        if not name.endswith(".egg-info"):
            subprocess.run(["cp", "-r", ROOT / name, source], check=True)
    for name in ("LICENSE", "README.md"):
        (source / name).write_text((ROOT / name).read_text() if (ROOT / name).is_file() else "")
    environment = Environment(folder / "environment")
    target = ["-e", str(source)] if request.param == "editable" else [str(source)]
    environment.pip("install", "--quiet", "--no-deps", "--no-build-isolation", *target)
    yield environment
    environment.pip("uninstall", "--yes", "--quiet", "sb3-mcbs")
    left = [
        path.name
        for path in environment.site_packages.iterdir()
        if path.name not in ("base.pth", "__pycache__")
    ]
    assert left == []
    assert environment.run("-c", "import sys; print([m for m in sys.modules if 'mcbs' in m])").strip() == "[]"


@pytest.mark.slow
@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="compares with what git tracks")
def test_distributions_hold_what_git_tracks(tmp_path: Path) -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    tracked = {name for name in listed.stdout.splitlines() if (ROOT / name).is_file()}
    source = tmp_path / "source"
    for name in tracked:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, source / name)
    words = [
        "-m",
        "build",
        "--no-isolation",
        "--outdir",
        tmp_path,
        source,
    ]  # the wheel from the source archive
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    assert tracked - packed == {".gitignore"}
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        installed = set(wheel.namelist())
    ours = {name for name in tracked if name.startswith("sb3_mcbs/")}
    ours |= {f"sb3_mcbs/{name}" for name in tracked if name.startswith("hyperparams/")}
    ours |= {"_sb3_mcbs_hook.py", build.PTH_NAME}
    assert {name for name in installed if ".dist-info/" not in name} == ours


@pytest.mark.slow
def test_installation_registers_in_any_folder(installed: Environment, tmp_path: Path) -> None:
    code = (
        "import sys; assert not [m for m in sys.modules if m.startswith(('sb3_mcbs', 'rl_zoo3', 'torch'))];"
        "import rl_zoo3.train as t; print('mcbs_td3' in t.ALGOS, t.ExperimentManager.__name__);"
        "from sb3_mcbs.zoo.paths import *\n"
        "print(hyperparams_path('mcbs_tqc'), (PACKAGE_ROOT / 'py.typed').is_file())"
    )
    added, manager, file, typed = installed.run("-c", code, cwd=tmp_path).split()
    assert (added, manager, typed) == ("True", "MCBSExperimentManager", "True")
    assert Path(file).is_file() and ROOT not in Path(file).parents
    off = "import rl_zoo3; print('mcbs_td3' in rl_zoo3.ALGOS)"
    assert installed.run("-c", off, cwd=tmp_path, SB3_MCBS_NO_ZOO_HOOK="1").strip() == "False"


@pytest.mark.slow
def test_scripts_of_users_are_type_checked(installed: Environment, tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(
        "import gymnasium as gym\n"
        "from sb3_mcbs import MCBSTD3, SearchPolicy\n"
        "def search(policy: SearchPolicy) -> None:\n"
        "    reveal_type(policy.beam_width)\n"
        "    reveal_type(policy.predict)\n"
        'agent = MCBSTD3("MlpPolicy", "Pendulum-v1", preset="efficient", strategy="cem")\n'
        'MCBSTD3("MlpPolicy", "Pendulum-v1", strategy="beem")\n'
        'SearchPolicy(agent, gym.make("Pendulum-v1"), preset="balance")\n'
    )
    words = [sys.executable, "-m", "mypy", "--python-executable", installed.python, "script.py"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert 'script.py:4: note: Revealed type is "int"' in done.stdout, done.stdout + done.stderr
    assert 'script.py:5: note: Revealed type is "def (observation' in done.stdout
    assert 'script.py:7: error: Argument "strategy" to "MCBSTD3" has incompatible type' in done.stdout
    assert 'script.py:8: error: Argument "preset" to "SearchPolicy" has incompatible type' in done.stdout
    assert "Found 2 errors" in done.stdout


@pytest.mark.slow
def test_rl_zoos_own_commands_work_in_any_folder(installed: Environment, tmp_path: Path) -> None:
    words = ["--algo", "mcbs_td3", "--env", "Pendulum-v1", "-f", "logs"]
    tiny = ["learning_starts:100", "batch_size:16", "beam_width:2", "n_simulations:1"]
    short = ["-n", "240", "--eval-freq", "120", "--eval-episodes", "2", "-params", *tiny]
    output = installed.run("-m", "rl_zoo3.train", *words, *short, cwd=tmp_path)
    assert "Evaluating with search" in output and "Eval of the actor alone" in output
    output = installed.run("-m", "rl_zoo3.enjoy", *words, "--no-render", "-n", "200", cwd=tmp_path)
    assert "1 Episodes" in output
    plots = ["-a", "mcbs_td3", "mcbs_td3_actor", "-e", "Pendulum-v1", "-f", "logs", "--no-display"]
    output = installed.run("-m", "rl_zoo3.plots.all_plots", *plots, cwd=tmp_path, MPLBACKEND="agg")
    assert "MCBS_TD3_ACTOR" in output and "Eval not found" not in output
    report = installed.run("-m", "sb3_mcbs.cli", "report", "--env", "Pendulum-v1", cwd=tmp_path)
    assert "Mean return of the actor alone" in report and "Mean return of the actor with search" in report
    runs = installed.run("-m", "sb3_mcbs.cli", "experiment", "smoke", "--check", cwd=tmp_path)
    assert "mcbs_td3_Pendulum-v1_0: mcbs_td3, 3000 steps" in runs
