"""Agents go to the hub and come back, on files on the disk in place of the network."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import huggingface_hub
import numpy as np
import pytest
import yaml
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs import MCBSTD3, AgentFileError, SearchPolicy, cli, load_from_hub, push_to_hub, save_statistics
from sb3_mcbs.snapshot import SnapshotEnvWrapper

ENV = "Pendulum-v1"
RETURNS = {"actor alone": [-200.0, -100.0], "actor with search": [-120.0, -100.0]}


class FakeHub:
    """What ``huggingface_hub`` does, with a folder for each repository."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.calls = folder, []

    def HfApi(self, token: str | None = None) -> "FakeHub":
        self.calls.append(("HfApi", token))
        return self

    def create_repo(self, repo_id: str, **options: Any) -> None:
        self.calls.append(("create_repo", repo_id, options))

    def upload_folder(self, *, repo_id: str, folder_path: str, commit_message: str) -> str:
        shutil.copytree(folder_path, self.folder / repo_id)
        return f"https://hub/{repo_id}/commit/1"

    def snapshot_download(
        self, repo_id: str, *, revision, token, allow_patterns: list[str], ignore_patterns: list[str]
    ) -> str:
        files = list((self.folder / repo_id).iterdir())
        wanted = huggingface_hub.utils.filter_repo_objects(
            [path.name for path in files], allow_patterns=allow_patterns, ignore_patterns=ignore_patterns
        )
        downloaded = self.folder / "cache" / repo_id
        downloaded.mkdir(parents=True)
        for name in wanted:
            shutil.copyfile(self.folder / repo_id / name, downloaded / name)
        return str(downloaded)


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeHub:
    fake = FakeHub(tmp_path / "hub")
    for name in ("HfApi", "snapshot_download"):
        monkeypatch.setattr(huggingface_hub, name, getattr(fake, name))
    return fake


def make_env():
    return make_vec_env(ENV, seed=0, wrapper_class=SnapshotEnvWrapper)


def saved(cls: type, folder: Path, env, **settings):
    agent = cls("MlpPolicy", env, buffer_size=10, device="cpu", seed=0, **settings)
    agent.save(folder / "mine.zip")
    return agent, folder / "mine.zip"


def card_of(text: str) -> dict:
    return yaml.safe_load(text.split("---\n")[1])


def test_an_agent_comes_back_with_its_search_and_statistics(hub: FakeHub, tmp_path: Path) -> None:
    env = VecNormalize(make_env())
    env.obs_rms.mean[:], env.ret_rms.var = [0.1, 0.2, 3.0], np.float64(9.0)
    agent, file = saved(SAC, tmp_path, env)
    policy = SearchPolicy(agent, env, beam_width=4, n_simulations=1, search_kwargs={"antithetic": True})
    (tmp_path / "a.mp4").write_bytes(b"film")
    url = push_to_hub("me/sac", file, policy, ENV, RETURNS, video=tmp_path / "a.mp4", private=True, token="t")
    assert url == "https://hub/me/sac/commit/1"
    assert hub.calls == [("HfApi", "t"), ("create_repo", "me/sac", {"private": True, "exist_ok": True})]
    files = {path.name: path for path in (hub.folder / "me/sac").iterdir()}
    assert files.keys() == {"README.md", "agent.zip", "replay.mp4", "search.json", "statistics.npz"}
    card = files["README.md"].read_text()
    assert "| actor alone | -150.0 | 50.0 | 2 |\n| actor with search | -110.0 | 10.0 | 2 |" in card
    assert "beam_width: 4" in card and "replay.mp4" in card and 'load_from_hub("me/sac"' in card
    (model,) = card_of(card)["model-index"]
    values = [metric["value"] for metric in model["results"][0]["metrics"]]
    assert values == ["-150.00 +/- 50.00", "-110.00 +/- 10.00"]

    back = load_from_hub("me/sac", make_env(), seed=1)
    assert type(back.model) is SAC and back.settings == policy.settings
    assert back.planner.normalize_reward is True and not back.vec_env.norm_reward
    raw = np.array([[0.5, -0.5, 2.0]], dtype=np.float32)
    np.testing.assert_allclose(back.vec_env.normalize_obs(raw), env.normalize_obs(raw))
    assert back.predict(back.vec_env.reset())[0].shape == (1, 1)


def test_uploaded_settings_replace_those_of_the_training(hub: FakeHub, tmp_path: Path) -> None:
    agent, file = saved(MCBSTD3, tmp_path, make_env(), search_kwargs={"antithetic": True}, beam_width=8)
    policy = SearchPolicy(agent, make_env(), preset="balanced")
    push_to_hub("me/td3", file, policy, ENV, RETURNS)
    assert load_from_hub("me/td3", make_env()).settings == policy.settings
    shutil.rmtree(hub.folder / "cache")
    assert load_from_hub("me/td3", make_env(), beam_width=3).beam_width == 3


def test_agents_of_rl_zoo_are_read_and_their_pickles_are_not(hub: FakeHub, tmp_path: Path) -> None:
    folder = hub.folder / "sb3/td3-Pendulum-v1"
    folder.mkdir(parents=True)
    _, file = saved(TD3, tmp_path, make_env())
    shutil.copyfile(file, folder / "td3-Pendulum-v1.zip")
    (folder / "train_eval_metrics.zip").write_bytes(b"")
    (folder / "args.yml").write_text("!!python/object/apply:os.abort []")
    policy = load_from_hub("sb3/td3-Pendulum-v1", make_env())
    assert policy.settings == SearchPolicy(policy.model, make_env(), preset="efficient").settings
    shutil.rmtree(hub.folder / "cache")
    (folder / "vec_normalize.pkl").write_bytes(b"not opened")
    with pytest.raises(AgentFileError, match=r"pickle.*convert-statistics"):
        load_from_hub("sb3/td3-Pendulum-v1", make_env())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "damaged"),
        ('{"search": {"forward_model": "pool"}}', "only beam_noise, beam_width"),
        ('{"search": {}, "normalize_reward": 1}', "true or false"),
    ],
)
def test_strange_settings_are_refused(content: str, message: str, hub: FakeHub, tmp_path: Path) -> None:
    folder = hub.folder / "x/y"
    folder.mkdir(parents=True)
    _, file = saved(TD3, tmp_path, make_env())
    shutil.copyfile(file, folder / "agent.zip")
    (folder / "search.json").write_text(content)
    with pytest.raises(AgentFileError, match=message):
        load_from_hub("x/y", make_env())


def test_a_repository_without_an_agent_is_refused(hub: FakeHub) -> None:
    (hub.folder / "x/y").mkdir(parents=True)
    with pytest.raises(AgentFileError, match="one agent in a zip, and has none"):
        load_from_hub("x/y", make_env())


def test_the_command_evaluates_and_uploads(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    env = VecNormalize(make_env())
    _, file = saved(TD3, tmp_path, env)
    save_statistics(env, tmp_path / "statistics.npz")
    words = ["push", str(file), "me/td3", "--env", ENV, "--episodes", "1"]
    monkeypatch.setattr(sys, "argv", ["sb3-mcbs", *words])
    cli.main()
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("actor alone: -") and printed[-1] == "https://hub/me/td3/commit/1"
    found = json.loads((hub.folder / "me/td3/search.json").read_text())
    assert found["search"]["n_simulations"] == 1 and found["environment"] == ENV
    monkeypatch.setattr(sys, "argv", ["sb3-mcbs", *words, "--folder", str(tmp_path / "out")])
    cli.main()
    assert "wrote" in capsys.readouterr().out and (tmp_path / "out/README.md").is_file()
    assert len(hub.calls) == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--folder", "made"], "made is there already"),
        (["--video", "none.mp4"], "no video none.mp4"),
        (["--video", "mine.zip"], "shows .mp4 and .gif"),
    ],
)
def test_what_cannot_be_written_is_refused_before_the_evaluation(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    saved(TD3, tmp_path, make_env())
    (tmp_path / "made").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["sb3-mcbs", "push", "mine.zip", "me/td3", "--env", ENV, *words])
    with pytest.raises(SystemExit, match=message):
        cli.main()
    assert "actor alone" not in capsys.readouterr().out
