"""What a spec may say, where its errors are, and which runs it makes."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from sb3_mcbs.experiments import SpecError, expand, read_spec
from sb3_mcbs.experiments.plan import from_yaml
from sb3_mcbs.experiments.spec import SPECS
from tests.experiment_helpers import SPEC, spec_file

TEXT = """\
environments: [Pendulum-v1]
seeds: [0, 1]
steps: 400
evaluation:
  every: 200
  episodes: 2
algorithms: [sac]
arms:
  searching:
    algorithm: mcbs_td3
    params:
      beam_width: 2
    grid:
      rollout_depth: [1, 3]
"""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seeds:", "seed:", r"line 2: seed: there is no key 'seed'. Did you mean seeds\? Known are "),
        ("steps: 400\n", "", "line 1: has no steps, which it must have"),
        ("[Pendulum-v1]", "[Pendulm-v1]", r"line 1: environments\[0\]: .* 'Pendulm-v1'. Did you mean Pend"),
        ("[sac]", "[sac, tcq]", r"line 7: algorithms\[1\]: there is no algorithm 'tcq'. Did you mean tqc\?"),
        ("mcbs_td3", "mcbs", r"line 10: arms.searching.algorithm: .* Known are .*mcbs_td3, .*td3"),
        ("[0, 1]", "[0, 1, 0]", r"line 2: seeds\[2\]: 0 is in the list twice"),
        ("[0, 1]", "[0, -1]", r"line 2: seeds\[1\]: must be an integer of 0 or more, got -1"),
        ("[0, 1]", "3", r"line 2: seeds: must be a list with at least one entry, got 3"),
        ("steps: 400", "steps: '400'", "line 3: steps: must be an integer of 1 or more, got '400'"),
        ("steps: 400", "steps: 1e3", "line 3: steps: YAML takes 1e3 for text. Write it out"),
        ("steps: 400", "steps: 500", "line 5: evaluation.every: 500 steps are no multiple of 200"),
        ("episodes: 2", "episodes: true", "line 6: evaluation.episodes: must be an integer"),
        (
            "episodes: 2",
            "episode: 2",
            r"line 6: evaluation.episode: there is no key .* Did you mean episodes",
        ),
        ("beam_width: 2", "beam_wdth: 2", r"line 12: .*params.beam_wdth: .* Did you mean beam_width\?"),
        ("beam_width: 2", "beam_width: two", "line 12: .*beam_width: must be of type int.*, got 'two'"),
        (
            "beam_width: 2",
            "preset: papr",
            r"line 12: .*preset: there is no preset 'papr'. Did you mean paper",
        ),
        ("beam_width: 2", "seed: 2", "line 12: .*seed: is no hyperparameter here: seeds of the spec"),
        ("beam_width: 2", "rollout_depth: 2", "line 14: .*grid.rollout_depth: is in params as well"),
        ("[1, 3]", "[1, deep]", r"line 14: .*rollout_depth\[1\]: must be of type int.*, got 'deep'"),
        ("[1, 3]", "[]", "line 14: .*rollout_depth: must be a list with at least one entry"),
        (
            "arms:\n",
            "arms:\n  sac: {algorithm: sac}\n",
            "line 9: arms.sac: there are two arms of the name sac",
        ),
        ("searching:", "a b:", "line 9: arms.a b: is no name for this"),
        ("  searching:", "  1:", "line 9: arms.1: must be text to be a key"),
        ("arms:\n", "arms:\n  searching: {algorithm: td3}\n", "line 10: arms.searching: is there twice"),
        ("algorithms: [sac]", "hyperparameters: {td3: no.yml}", "line 7: .*td3: 'no.yml' is not a file"),
        ("seeds: [0, 1]", "seeds: [0, 1", "line 3: not YAML"),
    ],
)
def test_an_error_names_the_line_the_key_and_what_is_known(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "wrong.yml"
    assert old in TEXT
    path.write_text(TEXT.replace(old, new))
    with pytest.raises(SpecError, match=rf"^{path}, {message}"):
        read_spec(path)


def test_arms_are_algorithms_and_what_a_grid_makes(tmp_path: Path) -> None:
    path = tmp_path / "right.yml"
    path.write_text(TEXT)
    runs = expand(read_spec(path))
    first = [run.name for run in runs[: len(runs) // 2]]
    assert first == [
        "sac_Pendulum-v1_0",
        "searching-rollout_depth=1_Pendulum-v1_0",
        "searching-rollout_depth=3_Pendulum-v1_0",
    ]
    assert [run.seed for run in runs] == [0, 0, 0, 1, 1, 1]
    assert runs[1].params == {"beam_width": 2, "rollout_depth": 1}
    assert runs[1].hyperparameters["env_wrapper"] == "sb3_mcbs.SnapshotEnvWrapper"
    assert from_yaml(runs[1].as_yaml()) == runs[1]


def test_hyperparameters_are_those_of_another_version_before_the_default(tmp_path: Path) -> None:
    changes: dict[str, Any] = {"environments": ["HalfCheetah-v5"], "algorithms": ["ppo"], "arms": {}}
    (run,) = expand(read_spec(spec_file(tmp_path, **changes)))
    assert run.source == "ppo.yml: HalfCheetah-v4"
    assert run.hyperparameters["learning_rate"] == 2.0633e-05


def test_a_hyperparameter_file_of_ones_own(tmp_path: Path) -> None:
    (tmp_path / "own.yml").write_text(yaml.safe_dump({"default": {"policy": "MlpPolicy", "gamma": 0.5}}))
    runs = expand(read_spec(spec_file(tmp_path, hyperparameters={"td3": "own.yml"})))
    assert [run.hyperparameters.get("gamma") for run in runs] == [0.5, 0.98]
    (tmp_path / "own.yml").write_text(yaml.safe_dump({"Ant-v5": {}}))
    with pytest.raises(SpecError, match=r"own.yml has no hyperparameters for Pendulum-v1: add an entry"):
        expand(read_spec(spec_file(tmp_path, hyperparameters={"td3": "own.yml"})))


SHIPPED = {
    "smoke": 2,
    "short": 18,
    "paper": 75,
    "evidence": 45,
    "ablation": 18,
    "ablation-frozen": 66,
    "search-training": 60,
    "crossq": 40,
    "crossq-100k": 40,
    "crossq-copies": 2,
    "saturation": 20,
    "learned-model": 6,
}


@pytest.mark.parametrize(("name", "n_runs"), SHIPPED.items())
def test_shipped_specs(name: str, n_runs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for agent in (yaml.safe_load((SPECS / f"{name}.yml").read_text()).get("agents") or {}).values():
        path = Path(agent["file"])
        path.parent.mkdir(parents=True)
        path.touch()
    assert len(expand(read_spec(name))) == n_runs


def test_every_shipped_spec_is_tested_and_offered() -> None:
    assert {path.stem for path in SPECS.glob("*.yml")} == set(SHIPPED)
    with pytest.raises(
        SpecError, match="no shipped spec of this name; shipped are ablation, ablation-frozen, crossq"
    ):
        read_spec("smok")


@pytest.mark.parametrize(
    ("algorithm", "params", "message"),
    [
        ("mcbs_td3", {"schedule_kwargs": {"final_search_share": 0.1}}, "final_search_share has no meaning"),
        ("mcbs_td3", {"search_kwargs": {"rollout_nose": 0.1}}, "no 'rollout_nose'; known are rollout_noise"),
        ("mcbs_td3", {"value_expansion": 2, "rollout_depth": 0}, "value_expansion needs a rollout_depth"),
        ("td3", {"search_evaluation": {"rollout_depht": 3}}, "unknown settings: rollout_depht"),
    ],
)
def test_settings_that_do_not_fit_together(
    algorithm: str, params: dict[str, Any], message: str, tmp_path: Path
) -> None:
    arms = {"wrong": {"algorithm": algorithm, "params": params}}
    with pytest.raises(SpecError, match=f"arm wrong, {algorithm}.yml: Pendulum-v1: .*{message}"):
        expand(read_spec(spec_file(tmp_path, arms=arms)))


def test_nothing_to_train(tmp_path: Path) -> None:
    (tmp_path / "none.yml").write_text(yaml.safe_dump({**SPEC, "arms": {}}))
    with pytest.raises(SpecError, match="there is nothing to train"):
        read_spec(tmp_path / "none.yml")


FROZEN = """\
agents:
  one:
    file: agent.zip
    environment: Pendulum-v1
seeds: [0]
evaluation: {episodes: 2}
arms:
  actor: {policy: actor}
  search: {policy: search, params: {preset: paper}, grid: {beam_width: [2, 4]}}
"""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("agent.zip", "other.zip", "line 3: agents.one.file: 'other.zip' is not a file, seen from"),
        ("Pendulum-v1", "Pendulum", "line 4: agents.one.environment: there is no environment 'Pendulum'"),
        ("one:", "a b:", "line 2: agents.a b: is no name for this"),
        ("seeds: [0]", "steps: 100", "line 5: steps: there is no key 'steps'"),
        ("{episodes: 2}", "{every: 2}", "line 6: evaluation.every: there is no key 'every'"),
        ("policy: actor", "policy: acter", "line 8: arms.actor.policy: .*Did you mean actor"),
        (
            "policy: actor",
            "policy: actor, params: {beam_width: 2}",
            "line 8: arms.actor: the actor alone has",
        ),
        ("preset: paper", "learning_rate: 1", "line 9: .*there is no setting of a search: 'learning_rate'"),
        ("beam_width: [2, 4]", "beam_width: [2, x]", r"line 9: .*beam_width\[1\]: must be of type int"),
    ],
)
def test_a_spec_of_trained_agents(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "frozen.yml"
    (tmp_path / "agent.zip").write_bytes(b"an agent")
    path.write_text(FROZEN)
    runs = expand(read_spec(path))
    names = ["actor_one_0", "search-beam_width=2_one_0", "search-beam_width=4_one_0"]
    assert [run.name for run in runs] == names and runs[1].params == {"preset": "paper", "beam_width": 2}
    assert from_yaml(runs[1].as_yaml()) == runs[1]
    assert old in FROZEN
    path.write_text(FROZEN.replace(old, new, 1))
    with pytest.raises(SpecError, match=rf"^{path}, {message}"):
        read_spec(path)
