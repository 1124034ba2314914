"""The strategies by the classes of their settings, behind one way to call them."""

import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_mcbs.search.beam import beam_search
from sb3_mcbs.search.cem import cem_search, draw_plan_noise
from sb3_mcbs.search.interface import CountedValue, PolicyFunctions, SearchResult
from sb3_mcbs.search.proposals import draw_noise
from sb3_mcbs.search.settings import SearchSettings
from sb3_mcbs.search.strategy_settings import BeamSettings, CEMSettings, TreeSettings
from sb3_mcbs.search.tree import draw_tree_noise, tree_search
from sb3_mcbs.search.warm_start import EpisodeClock, WarmStart
from sb3_mcbs.types import ForwardModel, Observations

logger = logging.getLogger("sb3_mcbs")


class Decision(NamedTuple):
    """One decision in every environment.

    :param model: simulates; may be ``None`` if ``rollout_depth`` is 0.
    :param roots: present states of the environments, from :meth:`ForwardModel.read_roots`.
    :param observations: ``[n_envs, *obs_shape]``, present observations.
    :param functions: networks, discount and scales.
    :param settings: settings of the search.
    :param shape: ``(n_envs, act_dim)``.
    :param rng: of the search: draws all noise, and is given to a model with random dynamics.
    :param memory: of the cross-entropy method.
    :param envs: the environments that decide, by their numbers in the memory.
    :param clocks: the present moment of each, for the memory.
    :param directions: ``[proposal_dims, act_dim]``, in which candidates differ; ``None``: in all.
    """

    model: ForwardModel | None
    roots: Sequence[Any]
    observations: Observations
    functions: PolicyFunctions
    settings: SearchSettings
    shape: tuple[int, int]
    rng: np.random.Generator
    memory: WarmStart | None = None
    envs: Sequence[int] = ()
    clocks: Sequence[EpisodeClock] = ()
    directions: np.ndarray | None = None


def search(decision: Decision) -> SearchResult:
    """Choose one action per environment by the strategy that the settings are of.

    :param decision: what there is to decide.
    :return: actions, and what the search found.
    """
    value = CountedValue(decision.functions.value)
    strategy = _STRATEGIES[type(decision.settings)]
    result = strategy(decision._replace(functions=decision.functions._replace(value=value)))
    return result._replace(critic_evaluations=value.evaluations)


def check_dynamics(settings: SearchSettings, deterministic: bool) -> None:
    """Say which settings make no sense, or none with an environment's dynamics.

    :param settings: of the search.
    :param deterministic: whether the environment's steps are.
    :raises ValueError: if the search would follow the luckiest random draw.
    """
    if not deterministic and not isinstance(settings, BeamSettings) and settings.n_simulations == 1:
        raise ValueError(
            f"strategy={settings.strategy!r} needs n_simulations of 2 or more here: the environment's steps "
            "are random, and with one simulation the luckiest draw would win."
        )
    if (settings.strategy, settings.beam_width, settings.include_policy_action) == ("beam", 1, True):
        logger.warning(
            "beam_width=1 with include_policy_action leaves nothing to choose from: the policy's own action "
            "is the only candidate."
        )
    if settings.distinct_simulations(deterministic) < settings.n_simulations:
        logger.warning(
            "n_simulations=%d is reduced to 1: the environment's steps are deterministic and nothing else "
            "is random in a simulation, so all would be the same.",
            settings.n_simulations,
        )


def _beam(decision: Decision) -> SearchResult:
    noise = draw_noise(decision.rng, decision.settings, *decision.shape, directions=decision.directions)
    return beam_search(*decision[:5], noise, decision.rng)


def _tree(decision: Decision) -> SearchResult:
    model, roots, observations, functions, settings, shape, rng = decision[:7]
    assert model is not None and isinstance(settings, TreeSettings)
    noise = draw_tree_noise(rng, settings, *shape, decision.directions)
    return tree_search(model, roots, observations, functions, settings, noise, rng)


def _cem(decision: Decision) -> SearchResult:
    model, roots, observations, functions, settings, shape, rng = decision[:7]
    assert model is not None and isinstance(settings, CEMSettings)
    assert decision.memory is not None, "the cross-entropy method remembers its plans"
    noise = draw_plan_noise(rng, settings, *shape)
    hold = settings.noise_hold
    # The present macro-steps need not begin where those of the last decision did.
    by_step = decision.memory.recall(decision.envs, decision.clocks)
    remembered = by_step.reshape(len(by_step), -1, hold, by_step.shape[2]).mean(axis=2)
    result, plans = cem_search(
        model, roots, observations, functions, settings, noise, rng, remembered, decision.directions
    )
    decision.memory.keep(np.repeat(plans, hold, axis=1), decision.envs, decision.clocks)
    return result


_STRATEGIES: dict[type[SearchSettings], Callable[[Decision], SearchResult]] = {
    BeamSettings: _beam,
    TreeSettings: _tree,
    CEMSettings: _cem,
}
