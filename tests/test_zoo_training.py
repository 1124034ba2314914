"""Training through RL Zoo's command: hyperparameters found, both policies evaluated, nothing disturbed."""

import inspect
import typing
from pathlib import Path
from typing import Any

import pytest
import torch as th
import yaml
from stable_baselines3.common.logger import Logger

from sb3_mcbs import MCBSTD3, SearchPolicy, SearchSettings, SnapshotEnvWrapper
from sb3_mcbs.agents.hyperparameters import SETTINGS
from sb3_mcbs.agents.registry import SEARCHING as ALGORITHMS
from sb3_mcbs.models import ForwardModelError
from sb3_mcbs.zoo.callbacks import RenamingLogger, SearchEvalCallback, SecondEvalCallback
from sb3_mcbs.zoo.manager import NAMES
from sb3_mcbs.zoo.paths import sibling_folder
from sb3_mcbs.zoo.repeat import load_run
from tests.zoo_helpers import TINY, TINY_SEARCH, evaluations, monitor_rewards, zoo_train

SHORT = ("-n", "400", "--eval-freq", "200", "--eval-episodes", "2", "--seed", "1")


@pytest.fixture(scope="module")
def mcbs_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run of mcbs_td3 with both evaluations."""
    folder = tmp_path_factory.mktemp("mcbs_run")
    with pytest.MonkeyPatch.context() as monkeypatch:
        zoo_train(monkeypatch, folder, "mcbs_td3", *SHORT, "-params", *TINY_SEARCH)
    return folder


def test_finds_its_hyperparameters_and_trains_with_search(mcbs_run: Path) -> None:
    run = mcbs_run / "logs" / "mcbs_td3" / "Pendulum-v1_1"
    config, args = load_run(run)
    assert args["conf_file"] is None
    assert config["env_wrapper"] == "sb3_mcbs.SnapshotEnvWrapper"
    assert config["beam_noise"] == 0.1
    model = MCBSTD3.load(run / "Pendulum-v1.zip")
    assert model.n_decisions == 300
    # One step for each of two candidates.
    assert model.n_simulated_steps == 600


@pytest.mark.parametrize(
    "words",
    [
        ["preset:'efficient'"],
        ["preset:balanced", "beam_width:7"],
        ["preset:None", "beam_width:2", "n_simulations:1"],
    ],
)
def test_another_preset_for_a_trained_agent(
    mcbs_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    trained = mcbs_run / "logs" / "mcbs_td3" / "Pendulum-v1_1" / "Pendulum-v1.zip"
    more = ("-n", "110", "--eval-freq", "-1", "-i", str(trained), "-params", "learning_starts:100", *words)
    zoo_train(monkeypatch, tmp_path, "mcbs_td3", *more)
    settings = MCBSTD3.load(
        tmp_path / "logs" / "mcbs_td3" / "Pendulum-v1_1" / "Pendulum-v1.zip"
    ).search_settings
    strategy, width, simulations = settings.strategy, settings.beam_width, settings.n_simulations
    expected = {"efficient": ("beam", 6, 1), "balanced": ("cem", 7, 1), "None": ("beam", 2, 1)}
    assert (strategy, width, simulations) == next(expected[name] for name in expected if name in words[0])


def test_both_policies_are_evaluated_where_rl_zoo_draws_them(mcbs_run: Path) -> None:
    logs = mcbs_run / "logs"
    with_search = evaluations(logs / "mcbs_td3" / "Pendulum-v1_1")
    actor = evaluations(logs / "mcbs_td3_actor" / "Pendulum-v1_1")
    for data in (with_search, actor):
        assert data["timesteps"].tolist() == [200, 400]
        assert data["results"].shape == (2, 2)
        assert data["ep_lengths"].tolist() == [[200, 200]] * 2
    assert (with_search["results"] != actor["results"]).all()


@pytest.mark.parametrize("algo", [name for name in ALGORITHMS if name != "mcbs_td3"])
def test_every_algorithm_trains_and_is_evaluated_twice(
    algo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("-n", "210", "--eval-freq", "200", "--eval-episodes", "1", "--seed", "1")
    zoo_train(monkeypatch, tmp_path, algo, *words, "-params", *TINY_SEARCH)
    run = tmp_path / "logs" / algo / "Pendulum-v1_1"
    assert load_run(run)[0]["env_wrapper"] == "sb3_mcbs.SnapshotEnvWrapper"
    with_search, actor = evaluations(run), evaluations(sibling_folder(run, "actor"))
    assert (with_search["results"] != actor["results"]).all()
    assert ALGORITHMS[algo].load(run / "Pendulum-v1.zip").n_decisions == 110


def test_each_evaluation_is_the_policy_it_claims_to_be(make_agent: Any, tmp_path: Path) -> None:
    """An agent that does not learn is evaluated by the callbacks and by hand."""
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    def env() -> Any:
        return make_vec_env("Pendulum-v1", seed=1, wrapper_class=SnapshotEnvWrapper)

    agent = make_agent(learning_starts=1000, seed=3)
    options: dict[str, Any] = {"eval_freq": 5, "n_eval_episodes": 2, "verbose": 0}
    agent.learn(
        5,
        callback=[
            SecondEvalCallback(env(), "actor", log_path=str(tmp_path / "actor"), **options),
            SearchEvalCallback(env(), log_path=str(tmp_path / "search"), **options),
        ],
    )
    by_hand, searched = env(), env()
    actor, _ = evaluate_policy(agent, by_hand, 2, return_episode_rewards=True)
    search, _ = evaluate_policy(
        SearchPolicy(agent, searched, seed=3), searched, 2, return_episode_rewards=True
    )
    assert evaluations(tmp_path / "actor")["results"].tolist() == [actor]
    assert evaluations(tmp_path / "search")["results"].tolist() == [search]
    assert actor != search


def test_evaluating_changes_nothing_in_training(
    mcbs_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    zoo_train(
        monkeypatch,
        tmp_path,
        "mcbs_td3",
        *SHORT[:2],
        "--eval-freq",
        "-1",
        "--seed",
        "1",
        "-params",
        *TINY_SEARCH,
    )
    name = Path("logs/mcbs_td3/Pendulum-v1_1")
    assert monitor_rewards(tmp_path / name) == monitor_rewards(mcbs_run / name)
    left, right = (
        MCBSTD3.load(folder / name / "Pendulum-v1.zip").policy.state_dict() for folder in (mcbs_run, tmp_path)
    )
    assert all(th.equal(left[key], right[key]) for key in left)
    assert not (tmp_path / "logs" / "mcbs_td3_actor").exists()


def test_td3_evaluated_with_search_too_and_otherwise_unchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    search = "search_evaluation:dict(beam_width=3, rollout_depth=1, n_simulations=1)"
    zoo_train(monkeypatch, tmp_path, "td3", *SHORT, "-conf", "sb3_mcbs", "-params", *TINY, search)
    zoo_train(monkeypatch, tmp_path, "td3", *SHORT, "-conf", "sb3_mcbs", "-params", *TINY)
    with_evaluation, without = (tmp_path / "logs" / "td3" / f"Pendulum-v1_{number}" for number in (1, 2))
    assert monitor_rewards(with_evaluation) == monitor_rewards(without)
    bare = evaluations(with_evaluation)["results"]
    assert (bare == evaluations(without)["results"]).all()
    assert (bare != evaluations(tmp_path / "logs" / "td3_search" / "Pendulum-v1_1")["results"]).all()
    assert not (tmp_path / "logs" / "td3_search" / "Pendulum-v1_2").exists()
    assert not (tmp_path / "logs" / "td3_actor").exists()
    # The baseline is this package's file, not RL Zoo's.
    assert load_run(without)[0]["n_timesteps"] == 20_000
    assert "beam_width" not in load_run(without)[0]


def test_explicit_configuration_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = {
        "Pendulum-v1": {"n_timesteps": 120, "policy": "MlpPolicy", "learning_starts": 110, "beam_width": 2}
    }
    (tmp_path / "own.yml").write_text(yaml.safe_dump(own))
    zoo_train(monkeypatch, tmp_path, "mcbs_td3", "-conf", "own.yml", "--eval-freq", "-1")
    config, _ = load_run(tmp_path / "logs" / "mcbs_td3" / "Pendulum-v1_1")
    assert config == own["Pendulum-v1"]


def test_mujoco_lands_on_the_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("-n", "120", "--eval-freq", "-1", "-params", *TINY_SEARCH)
    zoo_train(monkeypatch, tmp_path, "mcbs_td3", *words, env="HalfCheetah-v5")
    assert "Forward model: MuJoCo batch of HalfCheetahEnv" in capsys.readouterr().out


def test_nothing_is_said_of_the_xml_of_half_cheetah(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """MuJoCo's reader calls its ``settotalmass`` deprecated: for the training and for each evaluation."""
    words = ("-n", "110", "--eval-freq", "1000", "-params", *TINY_SEARCH)
    zoo_train(monkeypatch, tmp_path, "mcbs_td3", *words, env="HalfCheetah-v5")
    output = capfd.readouterr()
    assert "Creating second test environment" in output.out
    assert "settotalmass" not in output.out + output.err
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_names_need_no_quotes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("preset:strong", "forward_model:pool", "noise_type:ornstein-uhlenbeck", "noise_std:0.2")
    classes = ("policy:MlpPolicy", "env_wrapper:sb3_mcbs.SnapshotEnvWrapper", "matmul_precision:None")
    words = (
        "-n",
        "101",
        "--eval-freq",
        "-1",
        "-params",
        *TINY,
        "model_kwargs:dict(n_threads=1)",
        *names,
        *classes,
    )
    zoo_train(monkeypatch, tmp_path, "mcbs_tqc", *words)
    config, _ = load_run(tmp_path / "logs" / "mcbs_tqc" / "Pendulum-v1_1")
    assert (config["preset"], config["policy"], config["matmul_precision"]) == ("strong", "MlpPolicy", None)
    agent = ALGORITHMS["mcbs_tqc"].load(tmp_path / "logs" / "mcbs_tqc" / "Pendulum-v1_1" / "Pendulum-v1.zip")
    assert agent.search_settings == SearchSettings.preset(
        "strong", model_kwargs=dict(n_threads=1), forward_model="pool"
    )
    assert "OrnsteinUhlenbeck" in repr(agent.action_noise)


@pytest.mark.parametrize(
    ("word", "line"),
    [
        ("preset:strng", "there is no such preset; known are paper, efficient, balanced, strong, train."),
        ("preset:'strng'", "there is no such preset; known are paper, efficient, balanced, strong, train."),
        ("search_unit:episodes", "there is no such search_unit; known are step, episode."),
        ("search_share:true", "must be a number, True, False or None."),
        ("search_kwargs:antithetic", "must be a dictionary, such as dict(NAME=VALUE), or None."),
    ],
)
def test_a_misspelt_value_is_one_line(
    word: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SystemExit) as stopped:
        zoo_train(monkeypatch, tmp_path, "mcbs_td3", "-n", "101", "-params", *TINY, word)
    assert stopped.value.code == f"-params {word.replace(chr(39), '')}: {line}"


def test_every_setting_that_is_a_name_is_known() -> None:
    parameters = inspect.signature(MCBSTD3).parameters
    found = {}
    for name in SETTINGS:
        kinds = [parameters[name].annotation, *typing.get_args(parameters[name].annotation)]
        assert str not in kinds, f"{name} is any text"
        for kind in kinds:
            if typing.get_origin(kind) is typing.Literal:
                found[name] = set(typing.get_args(kind))
    assert {name: set(values) for name, values in NAMES.items()} == found


def test_no_file_of_this_package_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit, match=r"-conf sb3_mcbs: .* no hyperparameters for 'ppo'"):
        zoo_train(monkeypatch, tmp_path, "ppo", "-n", "101", "-conf", "sb3_mcbs")


def test_the_preset_for_training_where_no_states_can_be_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    words = ("-n", "101", "--eval-freq", "-1", "-params", *TINY, "preset:train")
    zoo_train(monkeypatch, tmp_path, "mcbs_td3", *words)
    assert "value expansion is left out: it needs batched MuJoCo" in capsys.readouterr().out
    with pytest.raises(ForwardModelError, match="Leave value_expansion out"):
        zoo_train(monkeypatch, tmp_path, "mcbs_td3", *words, "value_expansion:2")


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_preset_of_the_command_line_goes_before_the_file(
    algo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (
        "-n",
        "101",
        "--eval-freq",
        "-1",
        "-params",
        *TINY,
        "preset:'strong'",
        "beam_width:8",
        "model_kwargs:dict(n_threads=1)",
    )
    zoo_train(monkeypatch, tmp_path, algo, *words)
    agent = ALGORITHMS[algo].load(tmp_path / "logs" / algo / "Pendulum-v1_1" / "Pendulum-v1.zip")
    settings = SearchSettings.preset("strong", beam_width=8, model_kwargs=dict(n_threads=1))
    assert (agent.preset, agent.search_settings) == ("strong", settings)


def test_the_papers_preset_takes_noise_from_searched_actions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = {"n_timesteps": 120, "policy": "MlpPolicy", "action_noise_after_search": True, "search_share": 0.5}
    (tmp_path / "own.yml").write_text(
        yaml.safe_dump({"Pendulum-v1": {**file, "noise_type": "normal", "noise_std": 0.1}})
    )
    for preset, noisy in {"efficient": True, "paper": False}.items():
        words = ("-conf", "own.yml", "--eval-freq", "-1", "-f", preset)
        zoo_train(monkeypatch, tmp_path, "mcbs_td3", *words, "-params", *TINY, f"preset:'{preset}'")
        agent = MCBSTD3.load(tmp_path / preset / "mcbs_td3" / "Pendulum-v1_1" / "Pendulum-v1.zip")
        assert (agent.action_noise_after_search, agent.search_share) == (noisy, 0.5 if noisy else 1)


@pytest.mark.parametrize("preset", ["paper", "strong", "train"])
def test_a_preset_replaces_what_the_file_says_of_the_search(
    preset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (
        "-n",
        "101",
        "--eval-freq",
        "-1",
        "-params",
        *TINY,
        f"preset:'{preset}'",
        "model_kwargs:dict(n_threads=1)",
    )
    zoo_train(monkeypatch, tmp_path, "mcbs_td3", *words, env="HalfCheetah-v5")
    folder = tmp_path / "logs" / "mcbs_td3" / "HalfCheetah-v5_1"
    agent = MCBSTD3.load(folder / "HalfCheetah-v5.zip")
    assert agent.search_settings == SearchSettings.preset(preset, model_kwargs=dict(n_threads=1))
    training = agent.search_share, agent.search_unit, agent.value_expansion, agent.branch_length
    of_file = 0.5, "episode", 2, 20
    of_presets = {"paper": (1, "step", 0, 0), "train": (0.5, "episode", 2, 20)}
    assert training == of_presets.get(preset, of_file), "the others leave it to the file when to search"


def test_several_environments_in_this_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zoo_train(monkeypatch, tmp_path, "mcbs_td3", "-n", "240", "--eval-freq", "200", "--eval-episodes", "1",
              "-params", *TINY_SEARCH, "n_envs:4")  # fmt: skip
    run = tmp_path / "logs" / "mcbs_td3" / "Pendulum-v1_1"
    assert len(list(run.glob("*.monitor.csv"))) == 4
    assert (
        evaluations(run)["timesteps"].tolist()
        == evaluations(sibling_folder(run, "actor"))["timesteps"].tolist()
    )
    assert MCBSTD3.load(run / "Pendulum-v1.zip").n_decisions > 0


@pytest.mark.slow
def test_environments_in_worker_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zoo_train(monkeypatch, tmp_path, "mcbs_td3", "-n", "240", "--eval-freq", "200", "--eval-episodes", "1",
              "--vec-env", "subproc", "-params", *TINY_SEARCH, "n_envs:2")  # fmt: skip
    run = tmp_path / "logs" / "mcbs_td3" / "Pendulum-v1_1"
    assert len(evaluations(run)["results"]) == len(evaluations(sibling_folder(run, "actor"))["results"]) == 1


@pytest.mark.parametrize(
    ("algo", "value", "message"),
    [
        ("mcbs_td3", "{}", "mcbs_td3 is evaluated with its training's search settings already"),
        ("ppo", "{}", "ppo has no policy and critics to search with"),
        ("td3", "{'beam': 3}", "unknown settings: beam. Known are: beam_width"),
        ("td3", "{'preset': 'quick'}", "There is no preset 'quick'"),
        ("td3", "'6,3,5'", "must be a dictionary of search settings"),
        ("td3", "{'beam_width': 0}", "beam_width must be between 1"),
    ],
)
def test_wrong_search_evaluation_is_refused_before_training(
    algo: str, value: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        zoo_train(monkeypatch, tmp_path, algo, "-n", "100", "-params", f"search_evaluation:{value}")


def test_other_algorithms_keep_rl_zoos_callback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sb3_mcbs.zoo.manager import MCBSExperimentManager

    managers = []
    original = MCBSExperimentManager.learn
    monkeypatch.setattr(
        MCBSExperimentManager, "learn", lambda self, model: (managers.append(self), original(self, model))
    )
    zoo_train(
        monkeypatch,
        tmp_path,
        "sac",
        *SHORT[:2],
        "--eval-freq",
        "400",
        "--eval-episodes",
        "1",
        "-params",
        *TINY,
    )
    (manager,) = managers
    assert "rl_zoo3" in manager.config
    (callback,) = manager.callbacks
    assert isinstance(callback, SearchEvalCallback) and not isinstance(callback.model, SearchPolicy)
    assert sorted(path.name for path in (tmp_path / "logs").iterdir()) == ["sac"]


def test_second_evaluation_logs_under_its_own_name_and_never_writes() -> None:
    target = Logger(folder=None, output_formats=[])
    renaming = RenamingLogger(target, "eval/", "eval_actor/")
    renaming.record("eval/mean_reward", 1.0)
    renaming.record("time/total_timesteps", 5, exclude="tensorboard")
    renaming.dump(5)
    assert dict(target.name_to_value) == {"eval_actor/mean_reward": 1.0, "time/total_timesteps": 5}
    assert target.name_to_excluded["time/total_timesteps"] == ("tensorboard",)


def test_saving_and_logging_of_a_searching_evaluation_go_to_the_agent(
    make_agent: Any, tmp_path: Path
) -> None:
    from stable_baselines3.common.env_util import make_vec_env

    def env() -> Any:
        return make_vec_env("Pendulum-v1", seed=0, wrapper_class=SnapshotEnvWrapper)

    best = SearchEvalCallback(
        env(), eval_freq=40, n_eval_episodes=1, best_model_save_path=str(tmp_path), verbose=0
    )
    second = SecondEvalCallback(env(), "actor", eval_freq=40, n_eval_episodes=1, verbose=0)
    recorded: list[str] = []
    agent = make_agent(learning_starts=10)
    agent.set_logger(Logger(folder=None, output_formats=[]))
    original = agent.logger.dump
    agent.logger.dump = lambda step=0: (recorded.extend(agent.logger.name_to_value), original(step))
    agent.learn(40, callback=[second, best])
    assert isinstance(best.model, SearchPolicy) and best.model.model is agent
    assert {"eval/mean_reward", "eval_actor/mean_reward"} <= set(recorded)
    assert MCBSTD3.load(tmp_path / "best_model.zip").num_timesteps == 40
