"""The hyperparameter files that this package ships."""

import inspect
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import yaml

from sb3_mcbs.agents.hyperparameters import SETTINGS
from sb3_mcbs.agents.registry import SEARCHING as ALGORITHMS
from sb3_mcbs.search import make_settings
from sb3_mcbs.zoo import hyperparams_path

SEARCH_KEYS = {*SETTINGS, "env_wrapper"}
FAMILIES = [
    "Ant",
    "HalfCheetah",
    "Hopper",
    "Humanoid",
    "HumanoidStandup",
    "InvertedDoublePendulum",
    "InvertedPendulum",
    "Pusher",
    "Reacher",
    "Swimmer",
    "Walker2d",
]


def load(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text())


@pytest.fixture(scope="module", params=ALGORITHMS)
def algo(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def mcbs(algo: str) -> dict[str, Any]:
    return load(hyperparams_path(algo))


@pytest.fixture(scope="module")
def baseline(algo: str) -> dict[str, Any]:
    return load(hyperparams_path(algo.removeprefix("mcbs_")))


def test_the_two_files_differ_only_in_the_search(mcbs: dict[str, Any], baseline: dict[str, Any]) -> None:
    without_search = {
        env: {key: value for key, value in entry.items() if key not in SEARCH_KEYS}
        for env, entry in mcbs.items()
    }
    for env, entry in mcbs.items():
        if "branch_length" in entry:  # new transitions in every batch allow more updates of the actor
            del without_search[env]["policy_delay"]
            if "policy_delay" in baseline[env]:
                without_search[env]["policy_delay"] = baseline[env]["policy_delay"]
    assert without_search == baseline


def test_every_entry_searches_and_is_wrapped_for_worker_processes(mcbs: dict[str, Any]) -> None:
    for env, entry in mcbs.items():
        assert entry["env_wrapper"] == "sb3_mcbs.SnapshotEnvWrapper", env
        make_settings(
            **{key: entry[key] for key in ("beam_width", "rollout_depth", "n_simulations", "beam_noise")}
        )


def test_baseline_is_rl_zoos_own_where_rl_zoo_has_one(algo: str, baseline: dict[str, Any]) -> None:
    import rl_zoo3

    zoo = load(Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algo.removeprefix('mcbs_')}.yml")
    of_mujoco = zoo["HalfCheetah-v4"]
    if algo == "mcbs_crossq":  # smaller critics, on purpose
        for entry in zoo.values():
            if "2048" in entry.get("policy_kwargs", ""):
                entry["policy_kwargs"] = "dict(net_arch=dict(pi=[256, 256], qf=[256, 256]))"
        zoo["default"]["policy_kwargs"] = of_mujoco["policy_kwargs"]
    common = set(baseline) & set(zoo) - {"default"}
    assert {"HalfCheetah-v4", "Swimmer-v4", "Pendulum-v1", "BipedalWalker-v3"} <= common
    assert {env: baseline[env] for env in common} == {env: zoo[env] for env in common}
    # The one thing that differs on purpose: 100 random steps are what makes the v5 names a trap.
    assert baseline["default"] == {**zoo["default"], "learning_starts": of_mujoco["learning_starts"]}


def test_every_mujoco_environment_of_gymnasium_is_named(mcbs: dict[str, Any]) -> None:
    expected = {f"{family}-{version}" for family in FAMILIES for version in ("v4", "v5")} - {"Pusher-v4"}
    registered = {env for env in gym.registry if env.split("-")[0] in FAMILIES and env.endswith(("v4", "v5"))}
    assert expected == registered - {"Pusher-v4"}
    assert expected | {
        "default",
        "Pendulum-v1",
        "MountainCarContinuous-v0",
        "LunarLanderContinuous-v3",
        "BipedalWalker-v3",
    } == set(mcbs)


def test_v4_and_v5_have_the_same_settings(mcbs: dict[str, Any]) -> None:
    for env in mcbs:
        if env.endswith("-v5") and env != "Pusher-v5":
            assert mcbs[env] == mcbs[env.replace("-v5", "-v4")], env


def test_settings_that_an_environment_needs(algo: str, mcbs: dict[str, Any]) -> None:
    assert mcbs["Swimmer-v5"]["gamma"] > 0.99
    assert mcbs["BipedalWalker-v3"]["rollout_depth"] == 0
    assert mcbs["LunarLanderContinuous-v3"]["rollout_depth"] == 0
    assert mcbs["HalfCheetah-v5"]["learning_starts"] == (5_000 if algo == "mcbs_crossq" else 10_000)


def test_entries_hold_constructor_arguments_only(algo: str, mcbs: dict[str, Any]) -> None:
    arguments = set(inspect.signature(ALGORITHMS[algo]).parameters)
    of_rl_zoo = {"n_timesteps", "noise_type", "noise_std", "env_wrapper"}
    for env, entry in mcbs.items():
        assert set(entry) <= arguments | of_rl_zoo, env


def test_unknown_algorithm_is_named_with_what_there_is() -> None:
    with pytest.raises(FileNotFoundError, match=r"'ppo'.*mcbs_td3, mcbs_tqc, sac, td3, tqc.*-conf FILE"):
        hyperparams_path("ppo")
