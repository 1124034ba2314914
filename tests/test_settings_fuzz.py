"""No setting that passes validation crashes a search; one that does not is refused by its name.

Sizes that are valid and large are not searched with, only checked: a search of 100,000 rollouts takes
minutes and gigabytes, and differs from a small one in nothing but that.
"""

import math
import warnings
from copy import deepcopy
from fractions import Fraction
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.noise import NormalActionNoise

from sb3_mcbs import (
    MCBSTD3,
    MCBSTQC,
    BeamSettings,
    CEMSettings,
    SearchPolicy,
    SearchSettings,
    SnapshotEnvWrapper,
    TreeSettings,
)
from sb3_mcbs.search import (
    LatencyForecast,
    PolicyFunctions,
    Roots,
    deadline_search,
    make_settings,
    search,
)
from sb3_mcbs.search.settings import STRATEGIES
from tests.conftest import SMALL, snapshot_vec_env
from tests.fake_model import LineWorld

# Reproducible, and without a limit that a busy machine would exceed.
fuzz = settings(
    derandomize=True, deadline=None, max_examples=300, suppress_health_check=list(HealthCheck), database=None
)
fuzz_with_environments = settings(fuzz, max_examples=60)

WRONG = st.one_of(
    st.none(),
    st.booleans(),
    st.text(max_size=5),
    st.sampled_from([b"6", [3], (), {}, np.array([1, 2]), 3j, np.bool_(True), object(), np.str_("pool")]),
    st.sampled_from([np.nan, np.inf, -np.inf, np.float32("nan"), np.float64("inf"), -0.0, 1e300, 10**400]),
    st.integers(-(2**70), -1),
    st.floats(max_value=-1e-300),
    st.floats(width=32).map(np.float32),
)


def integers(low: int, high: int) -> st.SearchStrategy:
    plain = st.integers(low, high)
    return st.one_of(plain, plain.map(np.int64), plain.map(np.uint8), plain.map(np.int16))


def numbers(low: float = 0.0) -> st.SearchStrategy:
    plain = st.one_of(st.floats(low, 2.0), st.sampled_from([5e-324, 1e-40, 1e5, 1e6]))
    return st.one_of(
        plain, plain.map(np.float64), st.integers(1, 3), st.just(Fraction(1, 3)), st.just(np.float32(0.1))
    )


VALID = {
    "beam_width": integers(1, 5),
    "rollout_depth": integers(0, 3),
    "n_simulations": integers(1, 3),
    "beam_noise": numbers(),
    "forward_model": st.sampled_from(["auto", "mujoco", "pool", np.str_("pool")]),
    "matmul_precision": st.sampled_from([None, "highest", "high", "medium"]),
}
assert VALID.keys() == set(SearchSettings.flat)
IN_SEARCH_KWARGS = {
    "rollout_noise": st.none() | numbers(),
    "noise_clip": st.none() | numbers(),
    "include_policy_action": st.booleans(),
    "n_proposals": st.none() | integers(1, 30),
    "antithetic": st.booleans(),
    "noise_hold": integers(1, 3),
    "proposal_dims": st.none() | integers(1, 1),  # actions have one entry here
    "time_budget": st.none() | numbers(1e-6).map(lambda seconds: min(seconds, 0.01)),
    "max_beam_width": st.none() | integers(1, 6),
    "branching": integers(1, 3),
    "n_rounds": integers(1, 3),
    "n_elites": st.none() | integers(1, 5),
    "min_noise": numbers(),
}
assert IN_SEARCH_KWARGS.keys() == {key for cls in STRATEGIES.values() for key in cls.in_group()}
IN_MODEL_KWARGS = {"n_threads": integers(0, 2)}
GROUPS = {"search_kwargs": IN_SEARCH_KWARGS, "model_kwargs": IN_MODEL_KWARGS}


def of_strategy(strategy: str) -> st.SearchStrategy:
    own = {key: IN_SEARCH_KWARGS[key] for key in STRATEGIES[strategy].in_group()}
    groups = {
        name: st.none() | st.fixed_dictionaries({}, optional=group)
        for name, group in (("search_kwargs", own), ("model_kwargs", IN_MODEL_KWARGS))
    }
    return st.fixed_dictionaries(
        {"strategy": st.sampled_from([strategy, np.str_(strategy)])},
        optional={**VALID, **groups},
    )


valid_mostly = st.sampled_from(sorted(STRATEGIES)).flatmap(of_strategy)


def put(kwargs: dict[str, Any], name: str, value: Any) -> dict[str, Any]:
    """Settings with another value, whether it is of a keyword or of a key."""
    group = next((group for group, known in GROUPS.items() if name in known), None)
    if group is None:
        return {**kwargs, name: value}
    return {**kwargs, group: {**(kwargs.get(group) or {}), name: value}}


def with_one(names: dict[str, Any], values: Any, settings: st.SearchStrategy) -> st.SearchStrategy:
    """Settings of which one, of any strategy, is drawn from elsewhere."""
    return st.sampled_from(sorted(names)).flatmap(
        lambda name: st.tuples(settings, values(name)).map(lambda pair: put(pair[0], name, pair[1]))
    )


ALL = {**VALID, **IN_SEARCH_KWARGS, **IN_MODEL_KWARGS, "strategy": None, **GROUPS}
one_wrong = with_one(ALL, lambda name: WRONG, valid_mostly)


def names_in(kwargs: dict[str, Any]) -> set[str]:
    """The keywords and keys that are given."""
    groups = (kwargs[group] for group in GROUPS if isinstance(kwargs.get(group), dict))
    return {*kwargs, *(key for group in groups for key in group)}


def made(kwargs: dict[str, Any]) -> SearchSettings | None:
    """The settings, or None if they are refused as they should be."""
    try:
        return make_settings(**kwargs)
    except (TypeError, ValueError) as error:
        assert any(name in str(error) for name in names_in(kwargs)), f"no setting is named: {error}"
        return None


def small(found: SearchSettings) -> bool:
    widest = max(found.beam_width, getattr(found, "max_beam_width", None) or 0)
    times = getattr(found, "branching", 1) * getattr(found, "n_rounds", 1)
    factors = (found.n_simulations, max(found.horizon, 1), times)
    return (
        widest * math.prod(factors) <= 10_000
        and (found.n_proposals or 0) <= 1000
        and found.n_threads <= 64
        and (found.proposal_dims or 1) == 1
    )


@fuzz
@given(one_wrong)
def test_settings_are_refused_or_search_a_small_world(kwargs: dict[str, Any]) -> None:
    found = made(kwargs)
    if found is None or not small(found):
        return
    agent = PolicyFunctions(
        policy=lambda observations: np.clip(-observations, -1, 1).astype(np.float32),
        value=lambda observations, actions: -(observations[:, 0] ** 2),
        gamma=0.9,
        unscale_action=lambda actions: actions,
        scale_reward=lambda rewards: rewards,
        act_dim=1,
    )
    rng, roots = np.random.default_rng(0), Roots(LineWorld(), [0.5, -1.0], np.array([[0.5], [-1.0]]))
    if getattr(found, "time_budget", None) is None:
        result = search(roots, agent, found, rng)
    else:
        pace = LatencyForecast()
        deadline = pace.clock() + min(found.time_budget, 0.01)
        result = deadline_search(roots, agent, found, deadline, pace, rng)
    assert result.actions.shape == (2, 1)
    assert (np.abs(result.actions) <= 1).all()


@pytest.fixture(scope="module")
def pendulums() -> dict[str, tuple[MCBSTQC, Any]]:
    """An agent that no setting is refused for and its environments, for each kind of forward model."""
    return {
        env_id: (
            MCBSTQC("MlpPolicy", env_id, seed=0, **deepcopy(SMALL)),
            snapshot_vec_env(env_id, 2),
        )
        for env_id in ("Pendulum-v1", "InvertedPendulum-v5")
    }


def on_one_thread(kwargs: dict[str, Any]) -> dict[str, Any]:
    given = kwargs.get("model_kwargs")
    return {**kwargs, "model_kwargs": {"n_threads": 1, **given} if isinstance(given, dict) else given or {}}


def is_batched(env_id: str, found: SearchSettings) -> bool:
    return env_id != "Pendulum-v1" or found.forward_model != "mujoco"


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "InvertedPendulum-v5"])
@fuzz_with_environments
@given(kwargs=valid_mostly)
def test_valid_settings_search_in_environments(pendulums, env_id: str, kwargs: dict[str, Any]) -> None:
    found = made(kwargs)
    if found is None or not is_batched(env_id, found):
        return
    agent, vec_env = pendulums[env_id]
    policy = SearchPolicy(agent, vec_env, seed=0, **on_one_thread(kwargs))
    observations = vec_env.reset()
    for _ in range(2):
        actions, _ = policy.predict(observations)
        assert np.isfinite(actions).all() and vec_env.action_space.contains(actions[0])
        assert (np.abs(policy.last_result.actions) <= 1).all()
        observations, *_ = vec_env.step(actions)
    policy.close()


OWN = {
    "action_noise_after_search": st.booleans(),
    "fast_update": st.booleans(),
    "cuda_graphs": st.booleans(),
    "preset": st.sampled_from([None, "paper", "efficient", "balanced", "train"]),
    "action_noise": st.sampled_from([None, NormalActionNoise(np.zeros(1), np.ones(1))]),
}
owned = st.tuples(valid_mostly, st.fixed_dictionaries({}, optional=OWN)).map(lambda pair: pair[0] | pair[1])
one_own = with_one({**ALL, **OWN}, lambda name: st.one_of(OWN.get(name, st.nothing()), WRONG), owned)


@settings(fuzz, max_examples=50)
@given(kwargs=one_own)
def test_agents_are_refused_or_train(kwargs: dict[str, Any]) -> None:
    # What is SB3's own is not checked here.
    if not isinstance(kwargs.get("action_noise"), NormalActionNoise | None):
        kwargs["action_noise"] = None
    search = {name: value for name, value in kwargs.items() if name in ALL}
    try:
        fits = small(make_settings(**search)) and search.get("forward_model") != "mujoco"
    except (TypeError, ValueError):
        fits = True
    if not fits:
        return
    threads = th.get_num_threads()
    try:
        more = on_one_thread(kwargs)
        agent = MCBSTD3("MlpPolicy", "Pendulum-v1", seed=0, learning_starts=4, **SMALL, **more)
    except (TypeError, ValueError) as error:
        assert any(name in str(error) for name in names_in(kwargs)), error
        return
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        agent.learn(8)
    assert np.abs(agent.replay_buffer.actions[:8]).max() <= 1
    assert th.get_num_threads() == threads


@settings(fuzz, max_examples=30)
@given(name=st.text(max_size=8), value=WRONG)
def test_a_search_policy_refuses_what_it_does_not_know(pendulums, name: str, value: Any) -> None:
    agent, vec_env = pendulums["Pendulum-v1"]
    for kwargs in ({f"x_{name}": value}, {"beam_width": 1, f"beam_{name}_": value}):
        with pytest.raises(TypeError, match="unexpected keyword argument"):
            SearchPolicy(agent, vec_env, **kwargs)
    if value is not None and not isinstance(value, bool):
        with pytest.raises(TypeError, match="normalize_reward must be"):
            SearchPolicy(agent, vec_env, normalize_reward=value)


@settings(fuzz, max_examples=100)
@given(
    rng=WRONG
    | st.sampled_from(["restore", "keep", "Restore", np.random.default_rng(0), np.random.RandomState(0)])
)
def test_what_becomes_of_generators(rng: Any) -> None:
    env = SnapshotEnvWrapper(gym.make("Pendulum-v1"))
    env.reset(seed=0)
    snapshot = env.snapshot()
    if isinstance(rng, np.random.Generator) or (isinstance(rng, str) and rng in ("restore", "keep")):
        env.restore(snapshot, rng=rng)
    else:
        with pytest.raises((TypeError, ValueError), match="rng must be"):
            env.restore(snapshot, rng=rng)
    env.close()


def test_sizes_that_are_valid_but_not_together() -> None:
    largest = BeamSettings(beam_width=100_000, rollout_depth=100, n_simulations=1)
    assert largest.beam_width == 100_000
    many = np.int16(20_000)
    for cls, kwargs, words in (
        (BeamSettings, dict(beam_width=100_000, rollout_depth=101, n_simulations=1),
         r"beam_width \* n_simulations \* rollout_depth"),
        (BeamSettings, dict(beam_width=many, n_simulations=many), r"width \* n_simulations is 400000000"),
        (BeamSettings, dict(time_budget=1, max_beam_width=100_000, n_simulations=2),
         r"max_beam_width \* n_simulations"),
        (TreeSettings, dict(beam_width=1000, branching=1000), r"beam_width \* branching \* n_simulations"),
        (CEMSettings, dict(beam_width=1000, n_rounds=1000), r"beam_width \* n_rounds \* n_simulations"),
        (CEMSettings, dict(n_proposals=1000, n_rounds=1000), r"n_proposals \* n_rounds \* n_simulations"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            cls(**kwargs)
