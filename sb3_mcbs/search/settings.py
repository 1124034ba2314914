"""The settings of a search, checked once and then immutable."""

import math
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any

from sb3_mcbs.models.factory import KINDS

#: More rollouts than this per environment are a mistake, not a search: memory would run out.
MAX_ROLLOUTS = 100_000
MAX_DEPTH = 10_000
MAX_THREADS = 1024
MATMUL_PRECISIONS = ("highest", "high", "medium")


@dataclass(frozen=True)
class SearchSettings:
    """Settings of Monte Carlo Beam Search (Algorithm 1).

    :param beam_width: number of candidate actions per decision (``B``).
    :param rollout_depth: simulated steps per rollout (``D``). 0 ranks the candidates by the critics
        alone: nothing is simulated and no snapshot is needed.
    :param n_simulations: rollouts per candidate (``N_sim``).
    :param beam_noise: standard deviation of the Gaussian noise that makes candidates of the policy's
        action (``sigma_b``), in the action space scaled to [-1, 1].
    :param rollout_noise: the same for the later actions of a rollout. ``None``: as ``beam_noise``.
    :param noise_clip: noise is clipped to [-noise_clip, noise_clip]. ``None``: not clipped, as in the
        paper's Algorithm 1.
    :param include_policy_action: whether the policy's own action takes the place of the first
        candidate. ``False``, as in the paper, makes all candidates noisy.
    :param n_threads: threads that simulate. 0: one per available processor core. The result does not
        depend on it.
    :param forward_model: ``"auto"``, ``"mujoco"`` (batched MuJoCo) or ``"pool"`` (copies of the
        environment).
    :param matmul_precision: internal precision of the networks' float32 products during a search, as in
        ``torch.set_float32_matmul_precision``: ``"medium"`` is quicker on processors that multiply bfloat16.
        ``None``: as the process has it.
    :param time_budget: seconds that a decision may take, from the call to the action. Candidates are then
        evaluated in rounds while the next is expected to finish in time, and the results depend on how fast
        the machine is. ``None``: all candidates, however long it takes, and reproducible to the bit.
    :param max_beam_width: with ``time_budget``, the number of candidates that is enough; ``None``:
        ``beam_width``, which may be left idle time.
    :raises TypeError: if a value has the wrong type.
    :raises ValueError: if a value is out of range.
    """

    beam_width: int = 6
    rollout_depth: int = 3
    n_simulations: int = 5
    beam_noise: float = 0.1
    rollout_noise: float | None = None
    noise_clip: float | None = None
    include_policy_action: bool = False
    n_threads: int = 0
    forward_model: str = "auto"
    matmul_precision: str | None = None
    time_budget: float | None = None
    max_beam_width: int | None = None

    def __post_init__(self) -> None:
        _check_integer("beam_width", self.beam_width, 1, MAX_ROLLOUTS)
        _check_integer("rollout_depth", self.rollout_depth, 0, MAX_DEPTH)
        _check_integer("n_simulations", self.n_simulations, 1, MAX_ROLLOUTS)
        _check_integer("n_threads", self.n_threads, 0, MAX_THREADS)
        if self.beam_width * self.n_simulations > MAX_ROLLOUTS:
            raise ValueError(
                f"beam_width * n_simulations is {self.beam_width * self.n_simulations} rollouts per "
                f"environment; at most {MAX_ROLLOUTS} are supported."
            )
        _check_number("beam_noise", self.beam_noise)
        if self.rollout_noise is not None:
            _check_number("rollout_noise", self.rollout_noise)
        if self.noise_clip is not None:
            _check_number("noise_clip", self.noise_clip)
        if not isinstance(self.include_policy_action, bool):
            raise TypeError(
                f"include_policy_action must be True or False, got {self.include_policy_action!r}."
            )
        if self.forward_model not in KINDS:
            raise ValueError(f"forward_model must be one of {KINDS}, got {self.forward_model!r}.")
        if self.matmul_precision not in (None, *MATMUL_PRECISIONS):
            raise ValueError(
                f"matmul_precision must be one of {MATMUL_PRECISIONS} or None, got {self.matmul_precision!r}."
            )

        self._check_budget()

    def _check_budget(self) -> None:
        if self.time_budget is not None:
            _check_number("time_budget", self.time_budget)
            if self.time_budget <= 0 or self.rollout_depth == 0:
                raise ValueError(
                    f"time_budget must be above 0 seconds, and needs a rollout_depth of 1 or more; got "
                    f"{self.time_budget} with rollout_depth={self.rollout_depth}."
                )
        if self.max_beam_width is not None:
            _check_integer("max_beam_width", self.max_beam_width, self.beam_width, MAX_ROLLOUTS)
            if self.time_budget is None:
                raise ValueError("max_beam_width needs a time_budget; without one set beam_width.")

    @property
    def effective_rollout_noise(self) -> float:
        """Standard deviation of the noise on the later actions of a rollout."""
        return self.beam_noise if self.rollout_noise is None else self.rollout_noise

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names of all settings, in the order of the constructor."""
        return tuple(field.name for field in fields(cls))

    @classmethod
    def of(cls, agent: Any) -> "SearchSettings":
        """Read the settings that an agent carries as attributes.

        :param agent: an object that has every setting as an attribute, such as ``MCBSTD3``.
        :return: the checked settings.
        """
        return cls(**{name: getattr(agent, name) for name in cls.names()})


def _check_integer(name: str, value: Any, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise TypeError(f"{name} must be an integer, got {value!r}.")
    if not low <= int(value) <= high:
        raise ValueError(f"{name} must be between {low} and {high}, got {value}.")


def _check_number(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number, got {value!r}.")
    if not (math.isfinite(value) and float(value) >= 0):
        raise ValueError(f"{name} must be finite and not negative, got {value}.")
