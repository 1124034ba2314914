"""What presets say about a training besides the search: its schedule and value expansion."""

from collections.abc import Mapping
from typing import Any

from sb3_mcbs.agents.schedule import ScheduleSettings
from sb3_mcbs.agents.value_expansion import EXPANSION, ValueExpansionSettings
from sb3_mcbs.search import make_settings, with_preset
from sb3_mcbs.search.settings import OF_THE_MACHINE
from sb3_mcbs.types import Preset

#: Settings of presets: their default in the constructors is ``None``, which means not given.
OF_PRESETS = (
    "beam_width",
    "rollout_depth",
    "n_simulations",
    "beam_noise",
    "strategy",
    "search_share",
    "search_unit",
    *EXPANSION,
)


def _training(schedule: ScheduleSettings, expansion: ValueExpansionSettings) -> dict[str, Any]:
    return {**schedule.grouped(), **expansion.grouped(), "action_noise_after_search": False}


#: The presets that are about the training too: ``"paper"`` is Algorithm 1 at every step, ``"train"`` what
#: trained the best agents. The others leave the training as it is.
TRAINING: dict[str, dict[str, Any]] = {
    "paper": _training(ScheduleSettings(), ValueExpansionSettings()),
    "train": _training(
        ScheduleSettings(search_share=0.5, search_unit="episode"),
        ValueExpansionSettings(value_expansion=2, branch_length=20),
    ),
}


def settings_of_preset(name: Preset) -> dict[str, Any]:
    """The settings that a preset replaces in an existing agent or a hyperparameter file.

    :param name: one of :data:`~sb3_mcbs.search.PRESETS`.
    :return: all settings of the search; for ``"paper"`` and ``"train"`` also the schedule, value expansion
        (``None``: the preset's, see :func:`decide_expansion`) and ``action_noise_after_search``.
    :raises ValueError: if there is no such preset.
    """
    settings = make_settings(**with_preset(name, {})).grouped()
    for setting in OF_THE_MACHINE:
        del settings[setting]
    settings |= TRAINING.get(name, {})
    return {key: None if key in EXPANSION and value else value for key, value in settings.items()}


def decide_expansion(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Decide on the value expansion of an agent with a preset.

    Without explicit settings, that of the preset takes place where the forward model allows it.

    :param settings: the agent's, as far as they were given explicitly; ``None`` is not given.
    :return: the attributes to set; none for presets that leave the training as it is.
    """
    preset = settings.get("preset")
    if preset not in TRAINING:
        return {}
    given = {name: settings[name] for name in EXPANSION if settings.get(name) is not None}
    decided = {**{name: TRAINING[preset][name] for name in EXPANSION}, **given}
    if not decided["value_expansion"]:
        decided = {**dict.fromkeys(EXPANSION, 0), **given}
    if "value_expansion" in given or given.get("branch_length") or not decided["value_expansion"]:
        return {**decided, "expansion_where_possible": None}
    return {**dict.fromkeys(EXPANSION, 0), "expansion_where_possible": decided}
