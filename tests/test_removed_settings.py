"""Settings that there once were: refused by name, and files that carry them with their defaults load."""

from dataclasses import fields
from pathlib import Path

import pytest

from sb3_mcbs import MCBSTD3, SearchPolicy
from sb3_mcbs.agents.hyperparameters import REMOVED, SETTING_NAMES
from sb3_mcbs.search import PRESETS, SearchSettings
from sb3_mcbs.zoo.manager import _checked_search_evaluation
from tests.conftest import SEARCHING, snapshot_vec_env
from tests.zoo_helpers import zoo_train

TINY = ("policy_kwargs:dict(net_arch=[16,16])", "buffer_size:1000", "learning_starts:100")


def test_none_is_a_setting_any_more():
    assert not REMOVED.keys() & SETTING_NAMES
    for preset in PRESETS.values():
        assert preset.keys() <= {field.name for field in fields(SearchSettings)}


@pytest.mark.parametrize("name", REMOVED)
def test_a_removed_setting_is_refused_everywhere(make_agent, tmp_path, name):
    agent, (default, _) = make_agent(), REMOVED[name]
    agent.save(tmp_path / "agent")
    env = snapshot_vec_env("Pendulum-v1")
    for use in (
        lambda: make_agent(**{name: default}),
        lambda: MCBSTD3.load(tmp_path / "agent", **{name: default}),
        lambda: SearchPolicy(agent, env, **{name: default}),
        lambda: setattr(agent, name, default),
        lambda: setattr(SearchPolicy(agent, env), name, default),
        lambda: _checked_search_evaluation({name: default}, "td3"),
    ):
        with pytest.raises(TypeError, match=f"{name} was removed: .* Leave it out"):
            use()


@pytest.mark.parametrize("cls", SEARCHING)
def test_an_older_file_loads_unless_it_relies_on_one(make_agent, tmp_path, cls):
    agent = make_agent(cls=cls).learn(40)
    vars(agent).update({name: default for name, (default, _) in REMOVED.items()})
    agent.save(tmp_path / "older")
    loaded = cls.load(tmp_path / "older", env=snapshot_vec_env("Pendulum-v1"))
    assert not vars(loaded).keys() & REMOVED.keys()
    loaded.learn(20, reset_num_timesteps=False)
    vars(agent)["common_noise"] = True
    agent.save(tmp_path / "relies")
    with pytest.raises(TypeError, match="saved with common_noise=True, which was removed"):
        cls.load(tmp_path / "relies")
    loaded = cls.load(tmp_path / "relies", custom_objects={"common_noise": False})
    assert "common_noise" not in vars(loaded)


@pytest.mark.parametrize("word", ["tqc_value:truncated", "common_noise:True", "rollout_replay:0.5"])
def test_on_the_command_line_it_is_one_line(
    word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SystemExit) as stopped:
        zoo_train(monkeypatch, tmp_path, "mcbs_tqc", "-n", "101", "-params", *TINY, word)
    name = word.partition(":")[0]
    assert str(stopped.value.code).startswith(f"-params {word}: {name} was removed: ")


def test_in_a_file_of_hyperparameters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "file.yml"
    file.write_text(
        "Pendulum-v1:\n  n_timesteps: 101\n  policy: MlpPolicy\n  one_node_per_root: true\n"
        "  env_wrapper: sb3_mcbs.SnapshotEnvWrapper\n"
    )
    with pytest.raises(TypeError, match="one_node_per_root was removed: a tree keeps its best nodes"):
        zoo_train(monkeypatch, tmp_path, "mcbs_td3", "-conf", str(file), "-n", "101")
