"""``sb3-mcbs evaluate``: both policies of an agent in the same episodes."""

import json
import pickle
import sys
from pathlib import Path
from typing import Any

import pytest
from sb3_contrib import TQC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_mcbs import MCBSTD3, SearchPolicy, load_agent
from sb3_mcbs.zoo import evaluate
from sb3_mcbs.zoo.environments import find_environment
from sb3_mcbs.zoo.paths import PathError
from tests.agent_files import save_agent
from tests.zoo_helpers import TINY_SEARCH, zoo_train

BALL = f"{Path(__file__).with_name('doctor_envs.py')}:Ball"


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Run the command, and return what it printed."""
    monkeypatch.setattr(sys, "path", [*sys.path])

    def run(*words: object) -> str:
        monkeypatch.setattr(sys, "argv", ["sb3-mcbs evaluate", *map(str, words)])
        capsys.readouterr()
        evaluate.main()
        return capsys.readouterr().out

    return run


@pytest.fixture
def agent(make_agent: Any, tmp_path: Path) -> Path:
    return save_agent(make_agent, tmp_path, TQC, env=find_environment(BALL)())[1]


def test_both_policies_play_the_same_episodes(command: Any, agent: Path) -> None:
    said = json.loads(command(agent, "--env", BALL, "--episodes", 3, "--seed", 5, "--json"))
    assert (said["algorithm"], said["environment"], said["statistics"]) == ("TQC", BALL, None)
    alone, searched = said["policies"]
    assert (alone["policy"], searched["policy"]) == ("actor alone", "actor with search, efficient")
    assert [episode["seed"] for episode in searched["episodes"]] == [5, 6, 7]
    assert (alone["simulated_steps"], searched["simulated_steps"]) == (0, 3 * (18 * 18 + 12 + 6))

    env = make_vec_env(find_environment(BALL))
    model = load_agent(agent, env)
    for policy, result in ((model, alone), (SearchPolicy(model, env, seed=5, preset="efficient"), searched)):
        expected = []
        for seed in (5, 6, 7):
            env.seed(seed)
            expected.append(evaluate_policy(policy, env, 1)[0])
        assert [episode["return"] for episode in result["episodes"]] == expected
        assert result["mean_return"] == pytest.approx(sum(expected) / 3)


def test_the_table(command: Any, agent: Path) -> None:
    said = command(agent, "--env", BALL, "--episodes", 2, "--preset", "efficient", "balanced")
    assert "2 episodes with reset seeds 0 to 1" in said
    rows = [line for line in said.splitlines() if line.startswith("actor")]
    assert len(rows) == 3 and "of 2" not in rows[0] and "of 2" in rows[1] and "balanced" in rows[2]
    assert max(map(len, rows)) <= 80


def test_an_agent_that_searched_in_training_searches_as_it_did(
    command: Any, make_agent: Any, tmp_path: Path
) -> None:
    settings = {"env": find_environment(BALL)(), "beam_width": 2, "rollout_depth": 1, "n_simulations": 1}
    _, path = save_agent(make_agent, tmp_path, MCBSTD3, **settings)
    _, searched = json.loads(command(path, "--env", BALL, "--episodes", 1, "--json"))["policies"]
    assert (searched["policy"], searched["simulated_steps"]) == ("actor with search", 20 * 2)


def test_the_folder_of_a_run(command: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("-n", "120", "--eval-freq", "-1", "-params", *TINY_SEARCH, "normalize:True")
    zoo_train(monkeypatch, tmp_path, "mcbs_td3", *words)
    run = tmp_path / "logs" / "mcbs_td3" / "Pendulum-v1_1"
    with pytest.raises(SystemExit, match="say so with --trusted"):
        command(run)
    for path in (run, run / "Pendulum-v1.zip"):
        said = json.loads(command(path, "--episodes", 1, "--trusted", "--json"))
        assert (said["algorithm"], said["environment"]) == ("MCBSTD3", "Pendulum-v1")
        assert said["statistics"] == str(run / "Pendulum-v1" / "vecnormalize.pkl")
        assert said["policies"][1]["simulated_steps"] == 200 * 2
    (run / "Pendulum-v1" / "vecnormalize.pkl").unlink()
    with pytest.raises(SystemExit, match="name them with --vecnormalize"):
        command(run)


def test_statistics_are_not_opened_unasked(command: Any, agent: Path) -> None:
    agent.with_name("vecnormalize.pkl").write_bytes(pickle.dumps(print))
    with pytest.raises(SystemExit, match=r"vecnormalize.pkl is a pickle"):
        command(agent, "--env", BALL)


def test_bad_paths(command: Any, agent: Path, tmp_path: Path) -> None:
    with pytest.raises(PathError, match="name the environment with --env"):
        evaluate.find_subject(agent, None, ())
    with pytest.raises(PathError, match="is not the folder of an RL Zoo run"):
        evaluate.find_subject(tmp_path, None, ())
    with pytest.raises(SystemExit, match=r"There is no .*nowhere\.zip"):
        command(tmp_path / "nowhere.zip")
    with pytest.raises(SystemExit, match="Did you mean: `Pendulum`"):
        command(agent, "--env", "Pendulm-v1")
    with pytest.raises(SystemExit, match="Is it the environment that the agent was trained in"):
        command(agent, "--env", "Pendulum-v1")
