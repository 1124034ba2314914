"""Settings that there once were, or were keywords themselves: refused by name, and older files load."""

import sys
import warnings
from copy import deepcopy
from pathlib import Path

import pytest

from sb3_mcbs import MCBSSAC, MCBSTD3, BeamSettings, CEMSettings, SearchPolicy
from sb3_mcbs.agents import EnsembleSettings, ScheduleSettings
from sb3_mcbs.agents.hyperparameters import MOVED, REMOVED, SETTINGS
from sb3_mcbs.checkpoints import CheckpointError
from sb3_mcbs.checkpoints.names import known_names
from sb3_mcbs.checkpoints.settings import describe_agent
from sb3_mcbs.checkpoints.settings import make_agent as make_agent_again
from sb3_mcbs.search import PRESETS
from sb3_mcbs.search.settings import STRATEGIES
from sb3_mcbs.zoo.manager import checked_search_evaluation
from tests.conftest import SEARCHING, SMALL, snapshot_vec_env
from tests.zoo_helpers import zoo_train

TINY = ("policy_kwargs:dict(net_arch=[16,16])", "buffer_size:1000", "learning_starts:100")


def test_none_is_a_setting_any_more():
    assert not (REMOVED.keys() | MOVED.keys()) & SETTINGS.keys()
    for preset in PRESETS.values():
        assert preset.keys() <= SETTINGS.keys()


def test_all_went_where_they_are_known():
    known = {"model_kwargs": {"n_threads", *EnsembleSettings.in_group()}}
    known["schedule_kwargs"] = set(ScheduleSettings.in_group())
    known["search_kwargs"] = {name for settings in STRATEGIES.values() for name in settings.in_group()}
    for name, group in MOVED.items():
        assert name in known[group]


@pytest.mark.parametrize("name", [*REMOVED, *MOVED])
def test_an_old_name_is_refused_everywhere(make_agent, tmp_path, name):
    agent = make_agent()
    agent.save(tmp_path / "agent")
    env = snapshot_vec_env("Pendulum-v1")
    words = f"{name} was removed: .* Leave it out"
    if name in MOVED:
        words = f"{name} is now part of {MOVED[name]}: write {MOVED[name]}={{'{name}': 1}}"
    for use in (
        lambda: make_agent(**{name: 1}),
        lambda: MCBSTD3.load(tmp_path / "agent", **{name: 1}),
        *([lambda: MCBSTD3.load(tmp_path / "agent", custom_objects={name: 1})] if name in MOVED else []),
        lambda: SearchPolicy(agent, env, **{name: 1}),
        lambda: setattr(agent, name, 1),
        lambda: setattr(SearchPolicy(agent, env), name, 1),
        lambda: checked_search_evaluation({name: 1}, "td3"),
    ):
        with pytest.raises(TypeError, match=words):
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


#: What every agent was saved with, and what is another strategy's and never mattered.
FLAT = dict(
    rollout_noise=None, noise_clip=0.3, include_policy_action=False, n_threads=1, time_budget=None,
    max_beam_width=None, n_proposals=None, antithetic=True, branching=7, n_rounds=2, n_elites=None,
    min_noise=0.02, noise_hold=1, proposal_dims=None, final_search_share=0.5, final_beam_width=None,
    final_rollout_depth=None, saturation_window=20, saturation_tolerance=0.05, recovery_tolerance=0.15,
    ensemble_size=9, ensemble_train_freq=1000, ensemble_gradient_steps=500, ensemble_max_error=0.5,
    ensemble_pessimism=1.0,
)  # fmt: skip


@pytest.fixture
def older(make_agent, tmp_path):
    """A file as they were when all settings were attributes themselves."""

    def save(**settings):
        agent = make_agent(search_schedule="saturation")
        attributes = vars(agent)
        for name in ("search_kwargs", "schedule_kwargs", "model_kwargs"):
            del attributes[name]
        attributes.update({**FLAT, **settings})
        agent.save(tmp_path / "older")
        return tmp_path / "older"

    assert FLAT.keys() == MOVED.keys()
    return save


@pytest.mark.filterwarnings("error::FutureWarning")
def test_settings_of_an_older_file_go_where_they_belong(older):
    env = snapshot_vec_env("Pendulum-v1")
    loaded = MCBSTD3.load(older(strategy="refine"), env)
    assert not vars(loaded).keys() & MOVED.keys()
    sizes = dict(beam_width=3, rollout_depth=2, n_simulations=2, n_threads=1)
    assert loaded.search_settings == CEMSettings(**sizes, noise_clip=0.3, antithetic=True, n_rounds=2)
    assert loaded.schedule_settings == ScheduleSettings(
        "saturation", final_search_share=0.5, saturation_window=20
    )
    assert loaded.model_kwargs == {"n_threads": 1}
    loaded.learn(40)
    beam = MCBSTD3.load(older(), env)
    assert beam.search_settings == BeamSettings(**sizes, noise_clip=0.3, antithetic=True)
    learned = MCBSTD3.load(older(forward_model="ensemble"), env)
    assert learned.model_kwargs == {"n_threads": 1, "ensemble_size": 9}


def test_what_is_given_goes_before_an_older_file(older):
    path = older(strategy="refine")
    loaded = MCBSTD3.load(path, search_kwargs={"n_rounds": 4})
    assert loaded.search_kwargs == {"n_rounds": 4} and loaded.model_kwargs == {"n_threads": 1}
    assert MCBSTD3.load(path, search_kwargs=None).search_kwargs is None
    assert MCBSTD3.load(path, preset="paper").search_settings == BeamSettings(n_threads=1)


def test_several_old_names_are_written_together(make_agent):
    with pytest.raises(TypeError, match=r"antithetic, n_rounds are now part of .*True, 'n_rounds': 2"):
        make_agent(strategy="cem", antithetic=True, n_rounds=2)


def test_an_older_checkpoint_is_refused(make_agent):
    agent = make_agent()
    encoded = describe_agent(agent)
    encoded.json["settings"]["antithetic"] = encoded.json["settings"]["action_noise_after_search"]
    with pytest.raises(CheckpointError, match="says: antithetic is now part of search_kwargs"):
        make_agent_again(encoded, known_names(()), agent.get_env())


@pytest.mark.parametrize("word", ["tqc_value:truncated", "common_noise:True", "rollout_replay:0.5"])
def test_on_the_command_line_it_is_one_line(
    word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SystemExit) as stopped:
        zoo_train(monkeypatch, tmp_path, "mcbs_tqc", "-n", "101", "-params", *TINY, word)
    name = word.partition(":")[0]
    assert str(stopped.value.code).startswith(f"-params {word}: {name} was removed: ")


def test_on_the_command_line_it_says_where_it_went(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit) as stopped:
        zoo_train(monkeypatch, tmp_path, "mcbs_tqc", "-n", "101", "-params", *TINY, "antithetic:True")
    assert stopped.value.code == (
        "-params antithetic:True: antithetic is now part of search_kwargs: write "
        '"search_kwargs:dict(antithetic=True)".'
    )


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("one_node_per_root: true", "one_node_per_root was removed: a tree keeps its best nodes"),
        ("n_threads: 2", "n_threads is now part of model_kwargs: write model_kwargs={'n_threads': 2}"),
    ],
)
def test_in_a_file_of_hyperparameters(
    line: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "file.yml"
    file.write_text(
        f"Pendulum-v1:\n  n_timesteps: 101\n  policy: MlpPolicy\n  {line}\n"
        "  env_wrapper: sb3_mcbs.SnapshotEnvWrapper\n"
    )
    with pytest.raises(TypeError, match=words):
        zoo_train(monkeypatch, tmp_path, "mcbs_td3", "-conf", str(file), "-n", "101")


@pytest.mark.parametrize(
    "cls, file, strategy, group",
    [
        (MCBSTD3, "td3_refine", "cem", {"n_rounds": 2, "proposal_dims": 1}),
        (MCBSSAC, "sac_tree", "tree", {"branching": 2}),
    ],
)
def test_agents_that_were_saved_with_flat_settings_and_other_modules_go_on(cls, file, strategy, group):
    path = Path(__file__).parent / "agents_of_before" / file
    with warnings.catch_warnings(record=True):  # of the old name of a strategy
        agent = cls.load(path, env=snapshot_vec_env("Pendulum-v1"))
    assert (agent.strategy, agent.search_kwargs, agent.model_kwargs) == (strategy, group, {"n_threads": 1})
    assert agent.learn(30, reset_num_timesteps=False).n_decisions == 70
    assert "sb3_mcbs.algorithms" not in sys.modules


def test_a_class_of_the_users_has_parameters_that_were_once_ours():
    class WithThreads(MCBSTD3):
        def __init__(self, *args, n_threads=2, **kwargs):
            self.n_threads = n_threads
            super().__init__(*args, model_kwargs={"n_threads": n_threads}, **kwargs)

    agent = WithThreads("MlpPolicy", "Pendulum-v1", n_threads=1, **deepcopy(SMALL))
    assert agent.search_settings.n_threads == agent.n_threads == 1


def test_a_wrong_value_does_not_stay_where_a_class_has_a_default_of_its_own():
    class Wide(MCBSTD3):
        beam_width = 4

    agent = Wide("MlpPolicy", "Pendulum-v1", **deepcopy(SMALL))
    with pytest.raises(ValueError, match="beam_width"):
        agent.beam_width = -3
    assert agent.beam_width == 6


def test_loading_with_what_stands_for_the_default(make_agent, tmp_path):
    make_agent().save(tmp_path / "agent")
    assert MCBSTD3.load(tmp_path / "agent", beam_width=None).beam_width == 3
    objects = {"preset": "balanced", "beam_width": 20}
    assert MCBSTD3.load(tmp_path / "agent", custom_objects=objects).beam_width == 20


def test_settings_without_a_replay_buffer(make_agent):
    agent = make_agent()
    agent.replay_buffer = None
    agent.beam_width = 4
    assert agent.search_settings.beam_width == 4
