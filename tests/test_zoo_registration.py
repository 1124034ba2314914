"""How our algorithms get into RL Zoo: by the import hook, and explicitly."""

import argparse
import importlib
import os
import runpy
import subprocess
import sys
import types
import warnings
from pathlib import Path

import pytest

import _sb3_mcbs_hook as hook
from sb3_mcbs import MCBS
from sb3_mcbs.agents.registry import SEARCHING as ALGORITHMS
from sb3_mcbs.zoo import register, registration
from tests.conftest import SEARCHING

ROOT = Path(__file__).resolve().parents[1]


def python(code: str, *options: str, **environment: str) -> str:
    result = subprocess.run(
        [sys.executable, *options, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, hook.SWITCH: "0", "PYTHONPATH": str(ROOT), **environment},
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_register_fills_rl_zoos_tables_and_can_be_repeated() -> None:
    register()
    register()
    import rl_zoo3.enjoy
    import rl_zoo3.exp_manager
    import rl_zoo3.hyperparams_opt
    import rl_zoo3.train

    from sb3_mcbs.zoo import sampler
    from sb3_mcbs.zoo.manager import MCBSExperimentManager

    assert {name: rl_zoo3.ALGOS[name] for name in ALGORITHMS} == ALGORITHMS
    assert set(ALGORITHMS.values()) == set(SEARCHING)
    assert rl_zoo3.train.ALGOS is rl_zoo3.ALGOS
    for name in ALGORITHMS:
        sample = rl_zoo3.exp_manager.HYPERPARAMS_SAMPLER[name]
        assert (sample.func, sample.args) == (sampler.sample_mcbs_params, (name.removeprefix("mcbs_"),))
        assert rl_zoo3.hyperparams_opt.HYPERPARAMS_CONVERTER[name] is sampler.convert_mcbs_params
    for module in (rl_zoo3.exp_manager, rl_zoo3.train, rl_zoo3.enjoy):
        assert module.ExperimentManager is MCBSExperimentManager
    assert MCBSExperimentManager.__base__.__module__ == "rl_zoo3.exp_manager"
    assert MCBSExperimentManager.__base__ is not MCBSExperimentManager


def test_register_reaches_commands_that_were_imported_before() -> None:
    register()
    import rl_zoo3.train

    from sb3_mcbs.zoo.manager import MCBSExperimentManager

    rl_zoo3.train.ExperimentManager = MCBSExperimentManager.__base__
    register()
    assert rl_zoo3.train.ExperimentManager is MCBSExperimentManager


def stored(dest: str, *words: str) -> dict[str, object]:
    from rl_zoo3.utils import StoreDict

    parser = argparse.ArgumentParser()
    parser.add_argument("-params", dest=dest, nargs="+", action=StoreDict)
    return vars(parser.parse_args(["-params", *words]))[dest]


def test_values_that_rl_zoo_evaluates_are_what_they_were() -> None:
    register()
    values = {
        "policy": "None",
        "policy_kwargs": "dict(activation_fn=nn.ReLU)",
        "learning_rate": "'lin_0.1'",
        "env_wrapper": "gym.wrappers.FlattenObservation",
        "train_freq": "(1, 'episode')",
        "beam_width": "2 * 3",
    }
    evaluated = stored("hyperparams", *(f"{name}:{value}" for name, value in values.items()))
    import rl_zoo3.utils

    assert evaluated == {name: eval(value, vars(rl_zoo3.utils)) for name, value in values.items()}
    for dest, word in (("hyperparams", "gamma:high"), ("env_kwargs", "preset:strong")):
        with pytest.raises(NameError):
            stored(dest, word)


class Loaded(Exception):
    """Ends a command as soon as it has its agent."""


@pytest.fixture
def saved_run(make_agent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Put an agent where RL Zoo's commands find it, and end them when they load it."""

    def save(algo: str) -> list[str]:
        run = tmp_path / "logs" / algo / "Pendulum-v1_1"
        (run / "Pendulum-v1").mkdir(parents=True)
        (run / "Pendulum-v1" / "config.yml").write_text("{}")
        make_agent(cls=ALGORITHMS[algo]).save(run / "Pendulum-v1.zip")
        return ["--algo", algo, "--env", "Pendulum-v1", "-f", str(tmp_path / "logs"), "--no-render"]

    original = MCBS.load.__func__  # type: ignore[attr-defined]

    def load(cls: type[MCBS], *args, **kwargs):
        raise Loaded(original(cls, *args, **kwargs))

    monkeypatch.setattr(MCBS, "load", classmethod(load))
    return save


@pytest.mark.parametrize(
    ("command", "algo"),
    [
        *(("enjoy", algo) for algo in ALGORITHMS),
        ("record_video", "mcbs_sac"),
        ("push_to_hub", "mcbs_tqc"),
    ],
)
def test_commands_that_show_an_agent_load_it(
    command: str, algo: str, saved_run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As ``python -m``, which runs a module's code without importing it."""
    words = saved_run(algo)
    if command == "push_to_hub":
        words += ["-orga", "nobody"]
        # Of the versions of huggingface_sb3, not all that RL Zoo accepts have what this command imports.
        hub = importlib.import_module("huggingface_sb3.push_to_hub")
        monkeypatch.setattr(hub, "generate_metadata", None, raising=False)
    monkeypatch.delitem(sys.modules, f"rl_zoo3.{command}", raising=False)
    monkeypatch.setattr(sys, "meta_path", [hook.ZooFinder(), *sys.meta_path])
    monkeypatch.setattr(sys, "argv", [command, *words])
    before = sys.excepthook
    monkeypatch.setattr(sys, "excepthook", before)
    with pytest.raises(Loaded) as loaded:
        runpy.run_module(f"rl_zoo3.{command}", run_name="__main__")
    assert sys.excepthook is (hook.name_missing_library if command == "record_video" else before)
    (agent,) = loaded.value.args
    assert type(agent) is ALGORITHMS[algo]


REPORT = """
import sys
{first}
import rl_zoo3.train
import rl_zoo3.exp_manager as e, rl_zoo3.hyperparams_opt as o
print("mcbs_sac" in rl_zoo3.ALGOS, "mcbs_td3" in o.HYPERPARAMS_SAMPLER, "mcbs_td3" in o.HYPERPARAMS_CONVERTER,
      rl_zoo3.train.ExperimentManager.__name__, e.EvalCallback.__name__, e.TrialEvalCallback.__name__)
"""
REGISTERED = "True True True MCBSExperimentManager SearchEvalCallback SearchTrialEvalCallback"


@pytest.mark.parametrize(
    "first",
    [
        "import _sb3_mcbs_hook; assert not any(m.startswith('sb3_mcbs') for m in sys.modules)",
        "import _sb3_mcbs_hook, sb3_mcbs.zoo.manager",
    ],
    ids=["rl_zoo3 first", "our manager first"],
)
def test_hook_registers_in_every_import_order(first: str) -> None:
    assert python(REPORT.format(first=first), "-W", "error::RuntimeWarning") == REGISTERED


def test_hook_can_be_switched_off() -> None:
    code = REPORT.format(first="import _sb3_mcbs_hook")
    expected = "False False False ExperimentManager EvalCallback TrialEvalCallback"
    assert python(code, **{hook.SWITCH: "1"}) == expected


def test_hook_imports_nothing_that_an_interpreter_has_not_loaded() -> None:
    code = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r}); sys.modules.pop('_sb3_mcbs_hook', None);"
        "before = set(sys.modules); import _sb3_mcbs_hook"
    )
    assert python(f"{code}; print(set(sys.modules) - before)", "-I") == "{'_sb3_mcbs_hook'}"


def test_hook_is_put_in_place_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "meta_path", [])
    monkeypatch.delenv(hook.SWITCH, raising=False)
    hook.install()
    hook.install()
    assert len(sys.meta_path) == 1
    monkeypatch.setattr(sys, "meta_path", [])
    monkeypatch.setenv(hook.SWITCH, "1")
    hook.install()
    assert sys.meta_path == []


@pytest.fixture
def watched_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "watched_by_the_hook.py").write_text("value = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(hook, "WATCHED", ("watched_by_the_hook",))
    monkeypatch.setattr(sys, "meta_path", [hook.ZooFinder(), *sys.meta_path])
    monkeypatch.delitem(sys.modules, "watched_by_the_hook", raising=False)
    return "watched_by_the_hook"


def test_hook_announces_a_module_after_it_ran(watched_module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    monkeypatch.setattr(registration, "after_import", lambda module: seen.append(module.value))
    module = __import__(watched_module)
    assert seen == [1]
    # Other tools still get what they ask of a module's loader.
    assert module.__loader__.get_source(watched_module) == "value = 1\n"


def test_failing_registration_warns_with_the_cause_and_rl_zoo_still_imports(
    watched_module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(module: types.ModuleType) -> None:
        raise ImportError("libmujoco is missing")

    monkeypatch.setattr(registration, "after_import", fail)
    with pytest.warns(RuntimeWarning, match=rf"ImportError: libmujoco is missing.*{hook.SWITCH}=1"):
        module = __import__(watched_module)
    assert module.value == 1


@pytest.mark.parametrize("words", [["--algo", "mcbs_td3"], ["--env", "Ant-v5", "--algo=mcbs_sac"]])
def test_failing_registration_ends_a_command_that_asks_for_our_algorithms(
    words: list[str], watched_module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(module: types.ModuleType) -> None:
        raise ImportError("libmujoco is missing")

    monkeypatch.setattr(registration, "after_import", fail)
    monkeypatch.setattr(sys, "argv", ["-m", *words])
    with pytest.raises(SystemExit, match=r"ImportError: libmujoco is missing.*force-reinstall"):
        __import__(watched_module)


@pytest.mark.parametrize(("backend", "library"), [("osmesa", "libosmesa6"), ("egl", "libegl1")])
def test_missing_renderer_is_named(backend: str, library: str, tmp_path: Path) -> None:
    """PyOpenGL fails with an AttributeError where the library is missing, and MuJoCo's import with it."""
    (tmp_path / "OpenGL.py").write_text("None.glGetError\n")
    code = "import _sb3_mcbs_hook, runpy; runpy.run_module('rl_zoo3.record_video', run_name='__main__')"
    result = subprocess.run(
        [sys.executable, "-c", code, "--algo", "mcbs_td3", "--env", "HalfCheetah-v5"],
        capture_output=True,
        text=True,
        env={
            **os.environ,
            hook.SWITCH: "0",
            "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)]),
            "MUJOCO_GL": backend,
            "PYOPENGL_PLATFORM": backend,
        },
        check=False,
    )
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert f"MUJOCO_GL={backend} needs the system library {library}" in line


@pytest.mark.parametrize("module", ["gymnasium.envs.mujoco.mujoco_rendering", "elsewhere"])
def test_failing_renderer_is_one_line_that_names_the_libraries(
    module: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    try:
        exec("raise ValueError('no context')", {"__name__": module})
    except ValueError:
        hook.name_missing_library(*sys.exc_info())
    errors = capsys.readouterr().err
    if module == "elsewhere":
        assert errors.startswith("Traceback")
    else:
        (line,) = errors.splitlines()
        assert "(ValueError: no context). MUJOCO_GL is unset." in line
        assert "libosmesa6 and set MUJOCO_GL=osmesa, or libegl1 and MUJOCO_GL=egl" in line


def test_other_modules_are_left_alone() -> None:
    assert hook.ZooFinder().find_spec("json") is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        registration.after_import(types.ModuleType("rl_zoo3.wrappers"))
