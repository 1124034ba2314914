"""How our algorithms get into RL Zoo: by the import hook, and explicitly."""

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
from sb3_mcbs.zoo import register, registration
from sb3_mcbs.zoo.registration import ALGORITHMS
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


class Loaded(Exception):
    """Ends a command as soon as it has its agent."""


@pytest.fixture
def saved_run(make_agent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Put an agent with a large buffer where RL Zoo's commands find it, and end them when they load it."""

    def save(algo: str) -> list[str]:
        run = tmp_path / "logs" / algo / "Pendulum-v1_1"
        (run / "Pendulum-v1").mkdir(parents=True)
        (run / "Pendulum-v1" / "config.yml").write_text("{}")
        make_agent(cls=ALGORITHMS[algo], buffer_size=50_000).save(run / "Pendulum-v1.zip")
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
def test_commands_that_show_an_agent_load_no_replay_buffer(
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
    with pytest.raises(Loaded) as loaded:
        runpy.run_module(f"rl_zoo3.{command}", run_name="__main__")
    (agent,) = loaded.value.args
    assert type(agent) is ALGORITHMS[algo]
    assert agent.replay_buffer.buffer_size == agent.replay_buffer.observations.shape[0] == 1


def test_imported_enjoy_loads_no_replay_buffer_without_the_hook(
    saved_run, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = saved_run("mcbs_td3")
    monkeypatch.delitem(sys.modules, "rl_zoo3.enjoy", raising=False)
    monkeypatch.setattr(sys, "meta_path", [f for f in sys.meta_path if type(f).__name__ != "ZooFinder"])
    monkeypatch.setattr(sys, "argv", ["enjoy", *words])
    enjoy = importlib.import_module("rl_zoo3.enjoy")
    for n_rows in (50_000, 1):
        with pytest.raises(Loaded) as loaded:
            enjoy.enjoy()
        assert loaded.value.args[0].replay_buffer.buffer_size == n_rows
        register()
    code = enjoy.enjoy.__code__
    assert registration.with_our_off_policy_names(code) == code
    assert {"dqn", "her", *ALGORITHMS} <= {
        name for names in code.co_consts if isinstance(names, tuple) for name in names
    }


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


def test_other_modules_are_left_alone() -> None:
    assert hook.ZooFinder().find_spec("json") is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        registration.after_import(types.ModuleType("rl_zoo3.wrappers"))
