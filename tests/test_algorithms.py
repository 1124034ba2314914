"""The constructors of the algorithms: SB3's parameters, then the search's."""

import inspect
import re
from typing import get_type_hints

import pytest

from sb3_mcbs import MCBS, MCBSSAC
from sb3_mcbs.agents.hyperparameters import SearchKeywords, setting_fields
from sb3_mcbs.networks.td3_update import FastUpdate
from tests.conftest import SEARCHING, SMALL_SEARCH, WITHOUT_SEARCH


def own_settings(cls) -> set[str]:
    """The keyword-only parameters that are not fields of SearchSettings."""
    return {"action_noise_after_search", "preset", *(["fast_update"] if issubclass(cls, FastUpdate) else [])}


@pytest.mark.parametrize("cls", SEARCHING)
def test_parameters_are_sb3s_in_their_order_and_then_the_searchs(cls):
    theirs = inspect.signature(WITHOUT_SEARCH[cls].__init__).parameters
    ours = inspect.signature(cls.__init__).parameters
    assert list(ours)[: len(theirs)] == list(theirs)
    for name, parameter in theirs.items():
        assert (ours[name].default, ours[name].kind) == (parameter.default, parameter.kind), name
    others = {name: ours[name] for name in list(ours)[len(theirs) :]}
    assert {parameter.kind for parameter in others.values()} == {inspect.Parameter.KEYWORD_ONLY}
    search = {field.name: field.default for field in setting_fields()}
    assert others.keys() == search.keys() | own_settings(cls)
    assert {name: others[name].default for name in search} == search
    assert inspect.signature(cls).parameters.keys() == ours.keys() - {"self"}


@pytest.mark.parametrize("cls", SEARCHING)
def test_every_parameter_is_documented_once_and_kept(make_agent, cls):
    parameters = list(inspect.signature(cls).parameters)
    assert re.findall(r"^:param (\w+):", inspect.cleandoc(cls.__doc__), re.MULTILINE) == parameters
    agent = make_agent(cls=cls)
    for name in {*(field.name for field in setting_fields()), *own_settings(cls)}:
        assert hasattr(agent, name), name
    assert {name: getattr(agent, name) for name in SMALL_SEARCH} == SMALL_SEARCH


def test_type_checkers_know_every_setting():
    types = {field.name: field.type for field in setting_fields()}
    assert get_type_hints(SearchKeywords) == types
    assert {name: hint for name, hint in get_type_hints(MCBS).items() if name in types} == types


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
