"""The searches that ``benchmarks.strategies`` compares: every strategy at about the same simulated steps."""

from typing import Any

#: Simulated steps per decision that arms are compared at, and how far an arm may be from them.
BUDGETS = (20, 60, 110, 580)
SLACK = 0.15

#: The actor, whose action the critics rate: nothing is simulated.
ACTOR: dict[str, Any] = dict(rollout_depth=0, beam_width=1, n_simulations=1, beam_noise=0.0)


def beam(width: int, depth: int, **kwargs: Any) -> dict[str, Any]:
    """Candidates around the policy's own action, without noise afterwards."""
    return _arm("beam", width, depth, rollout_noise=0.0, include_policy_action=True, **kwargs)


def tree(width: int, branching: int, depth: int, **kwargs: Any) -> dict[str, Any]:
    """Partial expansion."""
    kwargs = dict(branching=branching, include_policy_action=True, rollout_noise=0.05, **kwargs)
    return _arm("tree", width, depth, **kwargs)


def cem(width: int, rounds: int, depth: int, **kwargs: Any) -> dict[str, Any]:
    """Rounds around the best plans so far."""
    return _arm("cem", width, depth, n_rounds=rounds, antithetic=True, **kwargs)


def _arm(strategy: str, width: int, depth: int, **kwargs: Any) -> dict[str, Any]:
    sizes = dict(strategy=strategy, beam_width=width, rollout_depth=depth, n_simulations=1)
    return {**sizes, "search_kwargs": kwargs}


ARMS: dict[str, dict[str, Any]] = {
    "actor alone": ACTOR,
    "paper": {},
    # about 20 simulated steps
    "beam 6x3": beam(6, 3),
    "beam 3x6": beam(3, 6),
    "beam 3x(2x3)": beam(3, 2, noise_hold=3),
    "beam 6x3 in 2": beam(6, 3, proposal_dims=2),
    "beam 6x3 of 48": beam(6, 3, n_proposals=48),
    "tree 2x3x3": tree(2, 3, 3),
    "cem 3x2x3": cem(3, 2, 3),
    "cem 6x1x3": cem(6, 1, 3),
    "cem 3x1x6": cem(3, 1, 6),
    "cem 3x1x(3x2)": cem(3, 1, 3, noise_hold=2),
    # about 60
    "beam 10x6": beam(10, 6),
    "beam 10x6 in 3": beam(10, 6, proposal_dims=3),
    "beam 10x(3x2)": beam(10, 3, noise_hold=2),
    "tree 5x2x6": tree(5, 2, 6),
    "cem 7x3x3": cem(7, 3, 3),
    "cem 5x2x6": cem(5, 2, 6),
    "cem 10x1x6": cem(10, 1, 6),
    "cem 5x2x(3x2)": cem(5, 2, 3, noise_hold=2),
    "cem 5x2x6 in 3": cem(5, 2, 6, proposal_dims=3),
    # about 110
    "beam 18x6": beam(18, 6),
    "tree 6x3x6": tree(6, 3, 6),
    "cem 12x3x3": cem(12, 3, 3),
    "cem 6x3x6": cem(6, 3, 6),
    "cem 9x2x6": cem(9, 2, 6),
    "cem 18x1x6": cem(18, 1, 6),
    "cem 9x2x(3x2)": cem(9, 2, 3, noise_hold=2),
    "cem 9x2x6 in 3": cem(9, 2, 6, proposal_dims=3),
    "cem 9x2x6 in 2": cem(9, 2, 6, proposal_dims=2),
    "cem 12x3x3 in 3": cem(12, 3, 3, proposal_dims=3),
    # about 580
    "beam 96x6": beam(96, 6),
    "tree 16x6x6": tree(16, 6, 6),
    "cem 24x4x6": cem(24, 4, 6, n_elites=4),
    "cem 16x4x9": cem(16, 4, 9, n_elites=4),
    "cem 12x4x12": cem(12, 4, 12, n_elites=4),
    "cem 16x3x(6x2)": cem(16, 3, 6, n_elites=4, noise_hold=2),
}
