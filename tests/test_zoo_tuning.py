"""What ``-optimize`` tunes for our algorithms, and what its objective is."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import optuna
import pytest
import yaml

from sb3_mcbs import SearchPolicy
from sb3_mcbs.agents.hyperparameters import SETTINGS
from sb3_mcbs.agents.registry import SEARCHING as ALGORITHMS
from sb3_mcbs.agents.schedule import ScheduleSettings
from sb3_mcbs.agents.value_expansion import ValueExpansionSettings
from sb3_mcbs.search import SearchSettings, make_settings, with_preset
from sb3_mcbs.zoo import sampler, train
from sb3_mcbs.zoo.manager import MCBSExperimentManager
from sb3_mcbs.zoo.paths import hyperparams_path
from tests.zoo_helpers import TINY, zoo_train

SEARCH = {"beam_width": 6, "rollout_depth": 3, "n_simulations": 5, "beam_noise": 0.1}
TD3 = {
    "one_minus_gamma": 0.02,
    "batch_size_pow": 6,
    "learning_rate": 1e-3,
    "train_freq": 4,
    "tau": 0.01,
    "noise_type": "normal",
    "noise_std": 0.2,
    "net_arch": "small",
}
NO_HER = {"using_her_replay_buffer": False, "her_kwargs": {}}


BASES = [name.removeprefix("mcbs_") for name in ALGORITHMS]


def sample(params: dict[str, Any], base: str = "td3") -> dict[str, Any]:
    return sampler.sample_mcbs_params(base, optuna.trial.FixedTrial(params), 1, 1, dict(NO_HER))


@pytest.mark.parametrize("base", BASES)
def test_only_the_search_is_tuned_by_default(base: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(sampler.SWITCH, raising=False)
    assert sample(SEARCH, base) == {**SEARCH, "preset": None}
    assert sampler.convert_mcbs_params(SEARCH) == {**SEARCH, "preset": None}


@pytest.mark.parametrize("base", ["td3", "ddpg"])
@pytest.mark.parametrize("noise_type", ["normal", "ornstein-uhlenbeck", None])
def test_everything_is_tuned_when_asked(
    base: str, noise_type: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(sampler.SWITCH, "all")
    params = {**SEARCH, **TD3, "noise_type": noise_type}
    sampled = sample(params, base)
    assert sampled["gamma"] == 0.98 and sampled["batch_size"] == 64 and sampled["beam_width"] == 6
    converted = sampler.convert_mcbs_params(params)
    noise = {key: converted.pop(key, None) for key in ("noise_type", "noise_std")}
    # RL Zoo makes the noise from its name and scale; without a name the file's noise stays, as in the trial.
    assert noise == ({"noise_type": None, "noise_std": None} if noise_type is None else
                     {"noise_type": noise_type, "noise_std": 0.2})  # fmt: skip
    sampled_noise = sampled.pop("action_noise", None)
    assert (sampled_noise is None) == (noise_type is None)
    assert converted == sampled


@pytest.mark.parametrize("base", ["sac", "tqc", "crossq"])
def test_everything_is_tuned_of_agents_with_quantiles_or_entropy(
    base: str, make_agent: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(sampler.SWITCH, "all")
    of_base = {key: value for key, value in TD3.items() if not key.startswith("noise")}
    if base == "tqc":
        of_base |= {"n_quantiles": 9, "top_quantiles_to_drop_per_net": 3}
    if base == "crossq":
        del of_base["tau"]
    sampled = sample({**SEARCH, **of_base}, base)
    assert sampled == sampler.convert_mcbs_params({**SEARCH, **of_base})
    agent = make_agent(cls=ALGORITHMS[f"mcbs_{base}"], **sampled)
    assert (agent.gamma, agent.batch_size, agent.beam_width) == (0.98, 64, 6)
    assert base != "tqc" or (agent.critic.n_quantiles, agent.top_quantiles_to_drop_per_net) == (9, 3)


@pytest.mark.parametrize("schedule", ["constant", "saturation", "anneal"])
def test_schedules_are_tuned_when_asked(
    schedule: str, make_agent: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(sampler.SWITCH, "schedules")
    drawn = {
        "search_schedule": schedule,
        "search_share": 0.5,
        "search_unit": "episode",
        "value_expansion": 2,
    }
    params = {**SEARCH, **drawn, "final_share_factor": 0.2}
    if schedule == "constant":
        del params["final_share_factor"]
    sampled = sample(params)
    assert sampled == sampler.convert_mcbs_params(params)
    assert sampled["schedule_kwargs"] == ({} if schedule == "constant" else {"final_search_share": 0.1})
    agent = make_agent("InvertedPendulum-v5", **sampled)
    assert {name: getattr(agent, name) or {} for name in sampled} == {n: v or {} for n, v in sampled.items()}
    with pytest.raises(optuna.TrialPruned, match="value_expansion needs a rollout_depth"):
        sample({**params, "rollout_depth": 0, "n_simulations": 1})


def test_trials_without_value_expansion_have_no_branches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(sampler.SWITCH, "schedules")
    params = {**SEARCH, "search_schedule": "constant", "search_share": 0.5, "search_unit": "step"}
    file = {"value_expansion": 2, "branch_length": 20}
    for value_expansion in sampler.VALUE_EXPANSION:
        trial = optuna.trial.FixedTrial({**params, "value_expansion": value_expansion})
        trial.set_user_attr(sampler.HELD, file)
        sampled = sampler.sample_mcbs_params("crossq", trial, 1, 1, dict(NO_HER))
        assert ({**file, **sampled}["branch_length"] > 0) == (value_expansion > 0)
        assert sampled == sampler.convert_mcbs_params(trial.params)


def search_settings(params: dict[str, Any]) -> SearchSettings:
    """What a trial searches with, whatever preset the hyperparameter file names."""
    file = {"preset": "strong"}
    params = {**file, **params}
    return make_settings(**with_preset(params.pop("preset"), params))


@pytest.mark.parametrize("base", BASES)
def test_strategies_are_tuned_when_asked(base: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(sampler.SWITCH, "strategies")
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    seen: dict[str, int] = {}
    held_or_narrow: set[tuple[int, int | None]] = set()
    for _ in range(400):
        trial = study.ask()
        try:
            params = sampler.sample_mcbs_params(base, trial, 3, 1, dict(NO_HER))
        except optuna.TrialPruned:
            assert trial.user_attrs["pruned"]
            continue
        settings = search_settings(params)
        assert settings.simulated_steps(deterministic=False) <= sampler.MAX_SIMULATED_STEPS
        assert sampler.convert_mcbs_params(trial.params) == params
        assert (settings.proposal_dims or 0) < 3, "three directions are all of them"
        held_or_narrow.add((settings.noise_hold, settings.proposal_dims))
        seen[settings.strategy] = seen.get(settings.strategy, 0) + 1
    assert {(1, None), (2, 1), (3, 2)} <= held_or_narrow
    assert set(seen) == set(sampler.STRATEGIES) and min(seen.values()) >= 5


#: Settings that a file might hold.
UNUSUAL = [
    ("strategy", "tree"),
    ("strategy", "cem"),
    ("search_kwargs", {"include_policy_action": True}),
    ("search_kwargs", {"time_budget": 0.5}),
    ("search_kwargs", {"noise_clip": 0.3}),
    ("schedule_kwargs", {"saturation_window": 500}),
]


@pytest.mark.parametrize("scope", ["search", "strategies", "schedules"])
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_trials_go_with_every_entry_of_the_files(
    scope: str, algo: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a trial draws and what the file holds must make an agent together, or the study would end."""
    monkeypatch.setenv(sampler.SWITCH, scope)
    kinds: list[dict[str, Any]] = []
    for entry in yaml.safe_load(hyperparams_path(algo).read_text()).values():
        held = {name: value for name, value in entry.items() if name in SETTINGS}
        kinds += [] if held in kinds else [held]
    for held in [*kinds, *({"rollout_depth": 3, name: value} for name, value in UNUSUAL)]:
        kwargs = held.get("search_kwargs", {})
        study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
        n_good = 0
        for _ in range(150):  # seldom so many: few go with a time budget
            trial = study.ask()
            trial.set_user_attr(sampler.HELD, held)
            try:
                params = sampler.sample_mcbs_params(algo.removeprefix("mcbs_"), trial, 6, 1, dict(NO_HER))
            except optuna.TrialPruned:
                continue
            n_good += 1
            agent = SimpleNamespace(**{**SETTINGS, **held, **params})
            search, schedule = SearchSettings.of(agent), ScheduleSettings.of(agent)
            expansion = ValueExpansionSettings.of(agent)
            assert search.noise_clip == kwargs.get("noise_clip"), "limits are held"
            assert schedule.saturation_window == held.get("schedule_kwargs", {}).get(
                "saturation_window", ScheduleSettings.saturation_window
            )
            schedule.check_search(search)
            expansion.check_search(search)
            if n_good == 10:
                break
        assert n_good >= (1 if "time_budget" in kwargs else 10), held
        simulations_differ = "rollout_noise" not in kwargs and held.get("strategy", "beam") == "beam"
        assert ("n_simulations" in trial.params) == (scope == "strategies" or simulations_differ)


def test_a_loaded_trial_searches_within_the_limits_that_it_was_drawn_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(sampler.SWITCH, "strategies")
    file = str(tmp_path / "study.log")
    backend = optuna.storages.journal.JournalFileBackend(file)
    study = optuna.create_study(
        storage=optuna.storages.JournalStorage(backend),
        study_name="tiny",
        sampler=optuna.samplers.RandomSampler(seed=0),
    )
    manager: Any = object.__new__(MCBSExperimentManager)
    manager.algo = "mcbs_td3"
    for _ in range(20):
        trial = study.ask()
        trial.set_user_attr(sampler.HELD, {"search_kwargs": {"noise_clip": 0.3, "rollout_noise": 0.2}})
        try:
            params = sampler.sample_mcbs_params("td3", trial, 6, 1, dict(NO_HER))
        except optuna.TrialPruned:
            continue
        study.tell(trial, 0.0)
        loaded = manager.load_trial(file, "tiny", trial.number)
        assert loaded == params and loaded["search_kwargs"]["noise_clip"] == 0.3
        assert loaded["search_kwargs"].get("rollout_noise") != 0.2


def test_unknown_scope_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(sampler.SWITCH, "td3")
    with pytest.raises(
        ValueError, match="SB3_MCBS_TUNE must be one of search, strategies, schedules, all, got 'td3'"
    ):
        sample(SEARCH)


@pytest.mark.parametrize(
    "change", [{"rollout_depth": 0}, {"beam_width": 18, "rollout_depth": 6, "n_simulations": 10}]
)
def test_invalid_combinations_are_pruned_in_the_sampler(change: dict[str, int]) -> None:
    with pytest.raises(optuna.TrialPruned, match="rollout_depth"):
        sample({**SEARCH, **change})


def test_every_other_combination_is_accepted_by_the_constructor() -> None:
    accepted = 0
    for width in sampler.BEAM_WIDTHS:
        for depth in sampler.ROLLOUT_DEPTHS:
            for n_simulations in sampler.N_SIMULATIONS:
                params = {"beam_width": width, "rollout_depth": depth, "n_simulations": n_simulations}
                try:
                    search_settings(sample({**params, "beam_noise": sampler.BEAM_NOISE[1]}))
                    accepted += 1
                except optuna.TrialPruned:
                    assert depth == 0 or width * depth * n_simulations > sampler.MAX_SIMULATED_STEPS
    assert accepted > 50


WORDS = ["-optimize", "-n", "300", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots",
         "--study-name", "tiny", "--storage", "study.log", "--num-threads", "1"]  # fmt: skip
PARAMS = ["-params", *TINY, "model_kwargs:dict(n_threads=1)"]


def load_study(path: Path) -> optuna.Study:
    backend = optuna.storages.journal.JournalFileBackend(str(path))
    return optuna.load_study(study_name="tiny", storage=optuna.storages.JournalStorage(backend))


def test_objective_is_the_actor_with_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    original = SearchPolicy.predict

    def predict(self: SearchPolicy, *args: Any, **kwargs: Any) -> Any:
        calls.append(self.settings.beam_width)
        return original(self, *args, **kwargs)

    monkeypatch.setattr(SearchPolicy, "predict", predict)
    monkeypatch.setattr(sampler, "ROLLOUT_DEPTHS", (1,))
    monkeypatch.setattr(sampler, "N_SIMULATIONS", (1,))
    monkeypatch.setattr(sampler, "BEAM_WIDTHS", (2,))
    zoo_train(monkeypatch, tmp_path, "mcbs_td3", *WORDS, "--n-trials", "2", "--seed", "1", *PARAMS)
    study = load_study(tmp_path / "study.log")
    assert calls == [2] * 400  # an episode for each trial
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"] * 2
    for trial in study.trials:
        assert trial.user_attrs["search/decisions"] == 200
        assert trial.user_attrs[sampler.HELD]["model_kwargs"] == {"n_threads": 1}, (
            "what the file and -params say of the search"
        )
        assert trial.user_attrs["search/simulated_steps"] == 400
        assert np.isfinite(trial.value)
    assert len(list((tmp_path / "logs" / "mcbs_td3").glob("report_*.csv"))) == 1

    # RL Zoo takes trial number 0 for no trial at all.
    best = study.trials[0].params["beam_noise"]
    zoo_train(
        monkeypatch, tmp_path, "mcbs_td3", "-n", "100", "--eval-freq", "-1", "--storage", "study.log",
        "--study-name", "tiny", "--trial-id", "0", *PARAMS,
    )  # fmt: skip
    from sb3_mcbs.zoo.repeat import load_run

    runs = sorted((tmp_path / "logs" / "mcbs_td3").glob("*/Pendulum-v1/config.yml"))
    config, _ = load_run(runs[-1].parents[1])
    assert config["beam_noise"] == best and config["beam_width"] == 2


def test_trials_refuse_a_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="leave preset out of -params"):
        zoo_train(monkeypatch, tmp_path, "mcbs_td3", *WORDS, "--n-trials", "1", *PARAMS, "preset:'strong'")


def test_invalid_combinations_do_not_end_a_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampler, "ROLLOUT_DEPTHS", (0,))
    monkeypatch.setattr(sampler, "N_SIMULATIONS", (1, 5))
    words = [*WORDS, "--n-trials", "4", "--sampler", "random", "--seed", "0", *PARAMS]
    zoo_train(monkeypatch, tmp_path, "mcbs_td3", *words)
    trials = load_study(tmp_path / "study.log").trials
    states = {(trial.params["n_simulations"], trial.state.name) for trial in trials}
    assert len(trials) == 4
    assert states == {(1, "COMPLETE"), (5, "PRUNED")}


def test_what_the_simulator_cannot_do_does_not_end_a_study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pendulum is not simulated by batched MuJoCo, whose states value_expansion needs."""
    monkeypatch.setenv(sampler.SWITCH, "schedules")
    for name, values in {
        "ROLLOUT_DEPTHS": (1,),
        "N_SIMULATIONS": (1,),
        "VALUE_EXPANSION": (0, 2),
        "SCHEDULES": ("constant",),
    }.items():
        monkeypatch.setattr(sampler, name, values)
    words = [*WORDS, "--n-trials", "4", "--sampler", "random", "--seed", "0", *PARAMS]
    zoo_train(monkeypatch, tmp_path, "mcbs_td3", *words)
    trials = load_study(tmp_path / "study.log").trials
    states = {(trial.params["value_expansion"], trial.state.name) for trial in trials}
    assert len(trials) == 4
    assert states == {(0, "COMPLETE"), (2, "PRUNED")}
    assert any("batched MuJoCo" in trial.user_attrs.get("pruned", "") for trial in trials)


@pytest.mark.slow
def test_two_workers_share_one_study(tmp_path: Path) -> None:
    """The recipe of docs/tuning.md."""
    command = [sys.executable, "-m", train.__name__, "--algo", "mcbs_td3", "--env", "Pendulum-v1", *WORDS]
    workers = [
        subprocess.Popen([*command, "--n-trials", "3", "--seed", str(seed), *PARAMS], cwd=tmp_path)
        for seed in (1, 2)
    ]
    assert [worker.wait(300) for worker in workers] == [0, 0]
    trials = load_study(tmp_path / "study.log").trials
    assert len(trials) == 6
    assert len({tuple(sorted(trial.params.items())) for trial in trials}) == 6
    complete = [trial for trial in trials if trial.state.name == "COMPLETE"]
    assert complete and all(trial.user_attrs["search/decisions"] > 0 for trial in complete)
