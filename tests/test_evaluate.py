"""``sb3-mcbs evaluate``: both policies of an agent in the same episodes."""

import json
import pickle
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from sb3_contrib import TQC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs import MCBSTD3, SearchPolicy, load_agent, save_statistics
from sb3_mcbs.agents import episodes
from sb3_mcbs.video import Outcome
from sb3_mcbs.zoo import evaluate
from sb3_mcbs.zoo.environments import find_environment
from sb3_mcbs.zoo.subject import find_subject
from sb3_mcbs.zoo.watch import record
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


def test_an_episode_that_has_no_end_is_named(
    make_agent: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    agent, env = make_agent("Pendulum-v1"), make_vec_env("Pendulum-v1")
    monkeypatch.setattr(episodes, "LONG", 201)
    episodes.play(agent, env, 3)
    assert not caplog.text
    monkeypatch.setattr(episodes, "LONG", 150)
    assert episodes.play(agent, env, 3).length == 200
    assert caplog.text.count("reset seed 3 has had no end for 150 steps") == 1 and "TimeLimit" in caplog.text


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


@pytest.fixture
def run(make_agent: Any, tmp_path: Path) -> Any:
    """Write the folder of a run that trained TD3, with an entry of its configuration."""

    def write(env: str = "Pendulum-v1", args: dict[str, Any] | None = None, **config: Any) -> Path:
        folder = tmp_path / "logs" / "td3" / f"{env}_1"
        (folder / env).mkdir(parents=True)
        _, file = save_agent(make_agent, tmp_path, env=env)
        file.rename(folder / f"{env}.zip")
        saved = {"algo": "td3", "env": env, **(args or {})}
        (folder / env / "args.yml").write_text(yaml.safe_dump(saved))
        (folder / env / "config.yml").write_text(yaml.safe_dump({"policy": "MlpPolicy", **config}))
        return folder

    return write


@pytest.mark.parametrize(
    ("args", "config", "says"),
    [
        ({}, {"frame_stack": 4}, "was trained with frame_stack, and a search cannot simulate through it"),
        ({"gym_packages": ["no_such_robot"]}, {}, "--gym-packages no_such_robot, which cannot be imported"),
        ({}, {"env_wrapper": "no_such_robot.Wrapper"}, "no_such_robot.Wrapper cannot be imported"),
        ({"env_kwargs": {"gravity": 1}}, {}, "Pendulum-v1 cannot be made: TypeError"),
        ({"algo": "td3"}, {"normalize": True}, "name them with --vecnormalize"),
    ],
)
def test_a_run_that_cannot_be_evaluated(command: Any, run: Any, args: Any, config: Any, says: str) -> None:
    folder = run(args=args, **config)
    with pytest.raises(SystemExit, match=says):
        command(folder)


def test_the_command_line_comes_before_the_run(command: Any, run: Any, tmp_path: Path) -> None:
    env = make_vec_env("Pendulum-v1")
    save_statistics(VecNormalize(env), tmp_path / "own.npz")
    folder = run(normalize=True, env_wrapper="no_such_robot.Wrapper", args={"env_kwargs": {"g": 9.0}})
    words = ("--vecnormalize", tmp_path / "own.npz", "--wrapper", "gymnasium.wrappers.FlattenObservation")
    args = evaluate._parser().parse_args([*map(str, (folder, *words)), "--wrapper", "sb3_mcbs.Other"])
    subject = find_subject(args)
    assert subject.statistics == tmp_path / "own.npz" and subject.env_kwargs == {"g": 9.0}
    assert subject.wrappers == ["gymnasium.wrappers.FlattenObservation", "sb3_mcbs.Other"]
    args.env = "Pendulum-v0"
    assert find_subject(args).environment == "Pendulum-v0" and find_subject(args).env_kwargs == {}
    assert json.loads(command(folder, *words, "--episodes", 1, "--json"))["environment"] == "Pendulum-v1"


def test_the_folder_of_a_run_of_an_experiment(command: Any, run: Any, tmp_path: Path) -> None:
    file = run() / "Pendulum-v1.zip"
    (tmp_path / "logs" / "td3_search" / "Pendulum-v1_1").mkdir(parents=True)
    assert json.loads(command(tmp_path, "--episodes", 1, "--json"))["file"] == str(file)


@pytest.mark.parametrize("ending", ["gif", "png"])
def test_the_video_shows_the_first_episode(
    ending: str, command: Any, run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pygame", reason="Pendulum draws with pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    recorded: list[Outcome] = []
    monkeypatch.setattr(evaluate, "record", lambda *args, **how: recorded.extend(record(*args, **how)))
    folder, video = run(args={"env_kwargs": {"max_episode_steps": 9}}), tmp_path / f"video.{ending}"
    said = json.loads(command(folder, "--episodes", 2, "--seed", 3, "--video", video, "--json"))
    played = [policy["episodes"][0] for policy in said["policies"]]
    assert [outcome.label for outcome in recorded] == ["TD3 alone", "TD3 with search"]
    assert [(each.seed, each.total, each.steps) for each in recorded] == [
        (3, pytest.approx(episode["return"]), 9) for episode in played
    ]
    assert video.stat().st_size > 1000


def test_statistics_of_another_kind(command: Any, agent: Path) -> None:
    statistics = agent.with_name("vecnormalize.pkl")
    for content, says in (
        (b"no pickle", "cannot be unpickled"),
        (pickle.dumps([1.0]), "has no VecNormalize in it, but a list"),
        (pickle.dumps(VecNormalize(make_vec_env("Pendulum-v1"))), r"shape \(3,\).* have \(2,\)"),
    ):
        statistics.write_bytes(content)
        with pytest.raises(SystemExit, match=says):
            command(agent, "--env", BALL, "--trusted")


def test_an_environment_that_cannot_be_made_is_named(command: Any, agent: Path, tmp_path: Path) -> None:
    (tmp_path / "gone.py").write_text("def make():\n    raise OSError('no robot at port 7')\n")
    with pytest.raises(SystemExit, match=r"gone.py:make cannot be made: OSError: no robot at port 7 \(gone"):
        command(agent, "--env", f"{tmp_path}/gone.py:make")


def test_an_interrupt_ends_without_a_traceback(
    command: Any, agent: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "play", interrupt)
    with pytest.raises(SystemExit) as ended:
        command(agent, "--env", BALL)
    assert ended.value.code == 130 and capsys.readouterr().err == "sb3-mcbs evaluate: stopped\n"


def test_statistics_are_not_opened_unasked(command: Any, agent: Path) -> None:
    agent.with_name("vecnormalize.pkl").write_bytes(pickle.dumps(print))
    with pytest.raises(SystemExit, match=r"vecnormalize.pkl is a pickle"):
        command(agent, "--env", BALL)


def test_bad_paths(command: Any, agent: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="name the environment with --env"):
        command(agent)
    with pytest.raises(SystemExit, match="is not the folder of an RL Zoo run"):
        command(tmp_path)
    with pytest.raises(SystemExit, match=r"There is no .*nowhere\.zip"):
        command(tmp_path / "nowhere.zip")
    with pytest.raises(SystemExit, match="Did you mean: `Pendulum`"):
        command(agent, "--env", "Pendulm-v1")
    with pytest.raises(SystemExit, match="Is it the environment that the agent was trained in"):
        command(agent, "--env", "Pendulum-v1")
