"""Repeating a run from the files that RL Zoo saved."""

import argparse
import sys
from collections import OrderedDict
from pathlib import Path
from typing import Any

import pytest
import torch as th
import yaml
from rl_zoo3.utils import StoreDict, get_callback_list

from sb3_mcbs import ExactCheckpointCallback, cli
from sb3_mcbs.zoo import repeat as repeating
from sb3_mcbs.zoo.repeat import RunLoader, command_line, load_run, repeat
from tests.zoo_helpers import TINY_SEARCH, monitor_rewards, zoo_train


def test_two_runs_have_equal_monitor_rewards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zoo_train(
        monkeypatch, tmp_path, "mcbs_td3", "-n", "400", "--eval-freq", "-1", "--env-kwargs", "g:9.0",
        "-params", *TINY_SEARCH, "train_freq:(2, 'step')",
    )  # fmt: skip
    first = tmp_path / "logs" / "mcbs_td3" / "Pendulum-v1_1"
    second = first.with_name("Pendulum-v1_2")
    repeat("logs/mcbs_td3/Pendulum-v1_1")
    assert len(monitor_rewards(first)) == 2
    assert monitor_rewards(first) == monitor_rewards(second)
    assert load_run(first)[0] == load_run(second)[0]
    assert load_run(second)[0]["train_freq"] == (2, "step")
    assert load_run(first)[1]["seed"] == load_run(second)[1]["seed"] >= 0

    # A repeated run can be repeated, elsewhere, with something changed.
    repeat(second, ["-f", str(tmp_path / "other"), "--seed", "5"])
    third = tmp_path / "other" / "mcbs_td3" / "Pendulum-v1_1"
    assert load_run(third)[0] == load_run(first)[0]
    assert monitor_rewards(third) != monitor_rewards(first)


def test_reads_all_that_rl_zoo_writes() -> None:
    saved = OrderedDict(
        train_freq=(1, "episode"), policy_kwargs={"activation_fn": th.nn.ReLU, "net_arch": [16]}, gamma=0.9
    )
    text = yaml.dump(saved)
    with pytest.raises(yaml.constructor.ConstructorError):
        yaml.safe_load(text)
    loaded = yaml.load(text, Loader=RunLoader)
    assert loaded == saved
    assert isinstance(loaded, OrderedDict) and isinstance(loaded["train_freq"], tuple)
    assert yaml.load(yaml.dump(OrderedDict()), Loader=RunLoader) == {}


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.system ['true']",
        "!!python/object/new:torch.nn.ReLU []",
        "!!python/name:os.system",
        "!!python/name:torchlike.evil",
        "!!python/module:os",
    ],
)
def test_loads_nothing_that_could_run(text: str) -> None:
    with pytest.raises(yaml.constructor.ConstructorError):
        yaml.load(text, Loader=RunLoader)


def test_loader_leaves_the_safe_loader_alone() -> None:
    with pytest.raises(yaml.constructor.ConstructorError):
        yaml.safe_load("!!python/tuple [1]")


def test_saved_arguments_become_the_same_arguments() -> None:
    args: dict[str, Any] = {
        "algo": "mcbs_td3",
        "env_kwargs": {"g": 9.5, "note": "a:b"},
        "eval_freq": -1,
        "gym_packages": ["json", "csv"],
        "hyperparams": {"beam_width": 3},
        "log_folder": "logs",
        "progress": True,
        "save_replay_buffer": False,
        "tensorboard_log": "",
        "trial_id": None,
        "truncate_last_trajectory": True,
        "wandb_tags": [],
    }
    parser = argparse.ArgumentParser()
    for name in ("algo", "tensorboard-log"):
        parser.add_argument(f"--{name}", default="")
    parser.add_argument("--eval-freq", type=int)
    parser.add_argument("--env-kwargs", nargs="+", action=StoreDict)
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("--wandb-tags", nargs="+", default=[])
    parser.add_argument("--progress", action="store_true")
    parser.add_argument("--save-replay-buffer", action="store_true")
    parser.add_argument("--truncate-last-trajectory", type=bool, default=True)
    parsed = vars(parser.parse_args(command_line(args)))
    assert parsed == {name: args[name] for name in parsed}
    args["truncate_last_trajectory"] = False
    assert parser.parse_args(command_line(args)).truncate_last_trajectory is False


def test_folder_of_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"needs <env>/config.yml and <env>/args.yml"):
        load_run(tmp_path)


def test_missing_agent_to_continue_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = tmp_path / "logs" / "td3" / "Pendulum-v1_1" / "Pendulum-v1"
    files.mkdir(parents=True)
    (files / "config.yml").write_text(yaml.dump(OrderedDict(policy="MlpPolicy")))
    (files / "args.yml").write_text(yaml.dump(OrderedDict(env="Pendulum-v1", trained_agent="gone.zip")))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"gone\.zip"):
        repeat(files.parent)
    monkeypatch.setattr(repeating.train, "main", lambda: None)
    repeat(files.parent, ["-i", "other.zip"])


@pytest.fixture
def saved_run(tmp_path: Path) -> Path:
    """The folder of a run, as far as commands look at it first."""
    files = tmp_path / "logs" / "mcbs_td3" / "Pendulum-v1_1" / "Pendulum-v1"
    files.mkdir(parents=True)
    (files / "config.yml").write_text(yaml.dump(OrderedDict(policy="MlpPolicy")))
    (files / "args.yml").write_text(yaml.dump(OrderedDict(env="Pendulum-v1", algo="mcbs_td3")))
    return files.parent


def line_of(monkeypatch: pytest.MonkeyPatch, *words: str) -> str:
    """What ``sb3-mcbs`` ends with."""
    monkeypatch.setattr(sys, "argv", ["sb3-mcbs", *map(str, words)])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert isinstance(stopped.value.code, str) and "\n" not in stopped.value.code
    return stopped.value.code


@pytest.mark.parametrize("command", ["resume", "repeat"])
def test_wrong_folder_is_one_line(
    command: str, saved_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "needs <env>/config.yml" in line_of(monkeypatch, command, str(tmp_path / "nowhere"))
    (saved_run / "Pendulum-v1" / "args.yml").write_text("!!python/object/apply:os.system ['true']")
    assert "args.yml is not what RL Zoo writes" in line_of(monkeypatch, command, str(saved_run))


def test_run_without_checkpoints_says_how_to_make_them(
    saved_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = line_of(monkeypatch, "resume", str(saved_run))
    assert f"{saved_run} has no exact checkpoints" in line
    # What it says can be used as it is.
    _, words, _ = line.split('"')
    in_file = yaml.safe_load(line.rpartition("hyperparameter file ")[2].removesuffix("."))
    parser = argparse.ArgumentParser()
    parser.add_argument("-params", dest="hyperparams", nargs="+", action=StoreDict)
    for hyperparams in (parser.parse_args(["-params", words]).hyperparams, in_file):
        (callback,) = get_callback_list(hyperparams)
        assert isinstance(callback, ExactCheckpointCallback) and callback.save_freq == 10_000
