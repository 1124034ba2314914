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

from sb3_mcbs import MCBSTD3, MCBSTQC, SearchPolicy, SearchSettings, SnapshotEnvWrapper
from sb3_mcbs.search import LatencyForecast, PolicyFunctions, Roots, deadline_search, search
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
    "rollout_noise": st.none() | numbers(),
    "noise_clip": st.none() | numbers(),
    "include_policy_action": st.booleans(),
    "n_threads": integers(0, 2),
    "forward_model": st.sampled_from(["auto", "mujoco", "pool", np.str_("pool")]),
    "matmul_precision": st.sampled_from([None, "highest", "high", "medium"]),
    "time_budget": st.none() | numbers(1e-6).map(lambda seconds: min(seconds, 0.01)),
    "max_beam_width": st.none() | integers(1, 6),
    "strategy": st.sampled_from(["beam", "tree", "refine", np.str_("tree")]),
    "n_proposals": st.none() | integers(1, 30),
    "antithetic": st.booleans(),
    "branching": integers(1, 3),
    "n_rounds": integers(1, 3),
    "n_elites": st.none() | integers(1, 5),
    "min_noise": numbers(),
    "noise_hold": integers(1, 3),
    "proposal_dims": st.none() | integers(1, 1),  # actions have one entry here
}
assert VALID.keys() == set(SearchSettings.names())

valid_mostly = st.fixed_dictionaries({}, optional=VALID)
one_wrong = st.sampled_from(sorted(VALID)).flatmap(
    lambda name: st.tuples(valid_mostly, WRONG).map(lambda pair: {**pair[0], name: pair[1]})
)


def made(kwargs: dict[str, Any]) -> SearchSettings | None:
    """The settings, or None if they are refused as they should be."""
    try:
        return SearchSettings(**kwargs)
    except (TypeError, ValueError) as error:
        assert any(name in str(error) for name in kwargs), f"no setting is named: {error}"
        return None


def small(found: SearchSettings) -> bool:
    widest = max(found.beam_width, found.max_beam_width or 0)
    factors = (found.n_simulations, max(found.horizon, 1), found.branching, found.n_rounds)
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
    if found.time_budget is None:
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
            MCBSTQC("MlpPolicy", env_id, seed=0, n_threads=1, **deepcopy(SMALL)),
            snapshot_vec_env(env_id, 2),
        )
        for env_id in ("Pendulum-v1", "InvertedPendulum-v5")
    }


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
    policy = SearchPolicy(agent, vec_env, seed=0, **{"n_threads": 1, **kwargs})
    observations = vec_env.reset()
    for _ in range(2):
        actions, _ = policy.predict(observations)
        assert np.isfinite(actions).all() and vec_env.action_space.contains(actions[0])
        assert (np.abs(policy.last_result.actions) <= 1).all()
        observations, *_ = vec_env.step(actions)
    policy.close()


OWN = {
    **VALID,
    "action_noise_after_search": st.booleans(),
    "fast_update": st.booleans(),
    "preset": st.sampled_from([None, "paper", "efficient", "balanced"]),
    "action_noise": st.sampled_from([None, NormalActionNoise(np.zeros(1), np.ones(1))]),
}
one_own = st.sampled_from(sorted(OWN)).flatmap(
    lambda name: st.tuples(st.fixed_dictionaries({}, optional=OWN), st.one_of(OWN[name], WRONG)).map(
        lambda pair: {**pair[0], name: pair[1]}
    )
)


@settings(fuzz, max_examples=50)
@given(kwargs=one_own)
def test_agents_are_refused_or_train(kwargs: dict[str, Any]) -> None:
    # What is SB3's own is not checked here.
    if not isinstance(kwargs.get("action_noise"), NormalActionNoise | None):
        kwargs["action_noise"] = None
    search = {name: value for name, value in kwargs.items() if name in VALID}
    try:
        SearchSettings(**search)
        fits = small(SearchSettings(**search)) and search.get("forward_model") != "mujoco"
    except (TypeError, ValueError):
        fits = True
    if not fits:
        return
    threads = th.get_num_threads()
    try:
        agent = MCBSTD3(
            "MlpPolicy", "Pendulum-v1", seed=0, learning_starts=4, **SMALL, **{"n_threads": 1, **kwargs}
        )
    except (TypeError, ValueError) as error:
        assert any(name in str(error) for name in kwargs), error
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
        with pytest.raises(TypeError, match="Unknown search settings"):
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
    largest = SearchSettings(beam_width=100_000, rollout_depth=100, n_simulations=1)
    assert largest.beam_width == 100_000
    for kwargs, words in (
        (
            dict(beam_width=100_000, rollout_depth=101, n_simulations=1),
            r"beam_width \* n_simulations \* rollout_depth",
        ),
        (
            dict(beam_width=np.int16(20_000), n_simulations=np.int16(20_000)),
            r"beam_width \* n_simulations is 400000000",
        ),
        (dict(time_budget=1, max_beam_width=100_000, n_simulations=2), r"max_beam_width \* n_simulations"),
        (
            dict(strategy="tree", beam_width=1000, branching=1000),
            r"beam_width \* branching \* n_simulations",
        ),
        (
            dict(strategy="refine", beam_width=1000, n_rounds=1000),
            r"beam_width \* n_rounds \* n_simulations",
        ),
        (
            dict(strategy="refine", n_proposals=1000, n_rounds=1000),
            r"n_proposals \* n_rounds \* n_simulations",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            SearchSettings(**kwargs)
