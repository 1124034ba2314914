"""Runs the strategy that belongs to a class of settings."""

import logging

import numpy as np

from sb3_mcbs.search.beam import beam_search
from sb3_mcbs.search.cem import cem_search, draw_plan_noise
from sb3_mcbs.search.interface import CountedValue, PolicyFunctions, Roots, SearchResult
from sb3_mcbs.search.proposals import draw_noise
from sb3_mcbs.search.settings import SearchSettings
from sb3_mcbs.search.strategy_settings import BeamSettings, CEMSettings, TreeSettings
from sb3_mcbs.search.tree import draw_tree_noise, tree_search
from sb3_mcbs.types import n_rows

logger = logging.getLogger("sb3_mcbs")


def search(
    roots: Roots,
    functions: PolicyFunctions,
    settings: SearchSettings,
    rng: np.random.Generator,
    directions: np.ndarray | None = None,
    plans: np.ndarray | None = None,
) -> SearchResult:
    """Choose one action per environment with the strategy of the settings.

    :param roots: where the search starts.
    :param functions: networks, discount and scales.
    :param settings: settings of the search.
    :param rng: draws all noise, and is given to a model with random dynamics.
    :param directions: ``[proposal_dims, act_dim]``, in which candidates differ; ``None``: all.
    :param plans: ``[n_envs, rollout_depth, act_dim]``, warm start of the cross-entropy method; ``None``: the
        policy alone.
    :return: actions and details of the search.
    """
    value = CountedValue(functions.value)
    functions = functions._replace(value=value)
    n_envs, act_dim = n_rows(roots.observations), functions.act_dim
    if isinstance(settings, BeamSettings):
        noise = draw_noise(rng, settings, n_envs, act_dim, directions=directions)
        result = beam_search(roots, functions, settings, noise, rng)
    elif isinstance(settings, TreeSettings):
        tree_noise = draw_tree_noise(rng, settings, n_envs, act_dim, directions)
        result = tree_search(roots, functions, settings, tree_noise, rng)
    else:
        assert isinstance(settings, CEMSettings)
        if plans is None:
            plans = np.zeros((n_envs, settings.rollout_depth, act_dim), dtype=np.float32)
        plan_noise = draw_plan_noise(rng, settings, n_envs, act_dim)
        result = cem_search(roots, functions, settings, plan_noise, rng, plans, directions)
    return result._replace(critic_evaluations=value.evaluations)


def check_dynamics(settings: SearchSettings, deterministic: bool) -> None:
    """Check settings against an environment's dynamics, and warn of meaningless ones.

    :param settings: settings of the search.
    :param deterministic: whether the environment is deterministic.
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
