"""The constructors of the algorithms: SB3's parameters, then the search's."""

import inspect
import re
from typing import get_args, get_type_hints

import pytest

from sb3_mcbs import MCBS, MCBSSAC, MCBSCrossQ
from sb3_mcbs.agents import EnsembleSettings, ScheduleSettings
from sb3_mcbs.agents.hyperparameters import SETTINGS
from sb3_mcbs.agents.presets import OF_PRESETS
from sb3_mcbs.agents.value_expansion import ValueExpansionSettings
from sb3_mcbs.networks.td3_update import FastUpdate
from sb3_mcbs.search import PRESETS
from sb3_mcbs.search.settings import STRATEGIES
from sb3_mcbs.types import Preset, Strategy
from tests.conftest import SEARCHING, SMALL_SEARCH, WITHOUT_SEARCH


def keywords(cls) -> list[str]:
    """The parameters that are not SB3's."""
    fast = ["fast_update"] if issubclass(cls, FastUpdate | MCBSCrossQ) else []
    return [*SETTINGS, *fast, "cuda_graphs"]


def test_type_checkers_know_all_names():
    assert get_args(Preset) == tuple(PRESETS)
    assert set(get_args(Strategy)) == set(STRATEGIES)


@pytest.mark.parametrize("cls", SEARCHING)
def test_parameters_are_sb3s_in_their_order_and_then_the_searchs(cls):
    theirs = inspect.signature(WITHOUT_SEARCH[cls].__init__).parameters
    ours = inspect.signature(cls.__init__).parameters
    assert list(ours)[: len(theirs)] == list(theirs)
    for name, parameter in theirs.items():
        assert (ours[name].default, ours[name].kind) == (parameter.default, parameter.kind), name
    others = {name: ours[name] for name in list(ours)[len(theirs) :]}
    assert {parameter.kind for parameter in others.values()} == {inspect.Parameter.KEYWORD_ONLY}
    assert list(others) == keywords(cls)
    defaults = {name: None if name in OF_PRESETS else default for name, default in SETTINGS.items()}
    assert {name: others[name].default for name in SETTINGS} == defaults
    assert inspect.signature(cls).parameters.keys() == ours.keys() - {"self"}


def test_defaults_are_those_of_the_settings():
    beam, known = STRATEGIES["beam"](), {"action_noise_after_search": False, "preset": None}
    for settings in (beam, ScheduleSettings(), ValueExpansionSettings()):
        known |= settings.grouped()
    assert known == SETTINGS


@pytest.mark.parametrize("cls", SEARCHING)
def test_every_parameter_is_documented_once_and_kept(make_agent, cls):
    ours, theirs = (
        re.findall(r"^:param (\w+):", inspect.cleandoc(each.__doc__), re.MULTILINE)
        for each in (cls, WITHOUT_SEARCH[cls])
    )
    parameters = list(inspect.signature(cls).parameters)
    assert ours == [name for name in parameters if name in ours], "each once, in their order"
    assert set(parameters) == {*ours, *theirs}, "what is as SB3 says is documented there"
    assert set(keywords(cls)) <= set(ours)
    agent = make_agent(cls=cls)
    for name in keywords(cls):
        assert hasattr(agent, name), name
    assert {name: getattr(agent, name) for name in SMALL_SEARCH} == SMALL_SEARCH


def test_every_key_is_documented_where_the_agents_point_to():
    for cls in (*STRATEGIES.values(), ScheduleSettings, EnsembleSettings):
        documents = "".join(base.__doc__ or "" for base in cls.__mro__[:2])
        assert cls.in_group()
        for key in cls.in_group():
            assert documents.count(f":param {key}:") == 1, key


def test_type_checkers_know_every_setting():
    attributes, parameters = get_type_hints(MCBS), inspect.signature(MCBSSAC).parameters
    for name in SETTINGS:
        kept = attributes[name] | None if name in OF_PRESETS else attributes[name]
        assert kept == parameters[name].annotation, name


def test_subclasses_of_users_are_left_alone():
    class Own(MCBSSAC):
        """My docstring."""

    class OwnConstructor(MCBSSAC):
        def __init__(self, *args, extra=1, **kwargs):
            super().__init__(*args, **kwargs)

    assert Own.__doc__ == "My docstring." and "beam_width" in inspect.signature(Own).parameters
    assert list(inspect.signature(OwnConstructor).parameters) == ["args", "extra", "kwargs"]


def test_runs_are_named_after_their_class(make_agent, tmp_path):
    agent = make_agent(cls=MCBSSAC, tensorboard_log=str(tmp_path))
    agent.learn(5)
    agent.learn(5, tb_log_name="mine")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["MCBSSAC_1", "mine_1"]
