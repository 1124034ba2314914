"""The settings of a search, checked once and then immutable."""

import math
import sys
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any

from sb3_mcbs.models.factory import KINDS

#: More rollouts than this per environment are a mistake, not a search: memory would run out.
MAX_ROLLOUTS = 100_000
MAX_DEPTH = 10_000
#: Steps of one decision and environment: the noise of all of them is drawn at once.
MAX_STEPS = 10_000_000
#: Anything above clips every action to a corner, and float32 must be able to hold it.
MAX_NOISE = 1e6
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
        self._set_integer("beam_width", 1, MAX_ROLLOUTS)
        self._set_integer("rollout_depth", 0, MAX_DEPTH)
        self._set_integer("n_simulations", 1, MAX_ROLLOUTS)
        self._set_integer("n_threads", 0, MAX_THREADS)
        self._set_number("beam_noise", MAX_NOISE)
        if self.rollout_noise is not None:
            self._set_number("rollout_noise", MAX_NOISE)
        if self.noise_clip is not None:
            self._set_number("noise_clip", MAX_NOISE)
        if not isinstance(self.include_policy_action, bool):
            raise TypeError(
                f"include_policy_action must be True or False, got {self.include_policy_action!r}."
            )
        # Names are compared as strings only: an array, say, has no answer to whether it is in a tuple.
        if not isinstance(self.forward_model, str) or self.forward_model not in KINDS:
            raise ValueError(f"forward_model must be one of {KINDS}, got {self.forward_model!r}.")
        precision = self.matmul_precision
        if precision is not None and not (isinstance(precision, str) and precision in MATMUL_PRECISIONS):
            raise ValueError(
                f"matmul_precision must be one of {MATMUL_PRECISIONS} or None, got {self.matmul_precision!r}."
            )

        self._check_budget()
        self._check_size("max_beam_width" if self.max_beam_width is not None else "beam_width")

    def _check_size(self, width_name: str) -> None:
        rollouts = getattr(self, width_name) * self.n_simulations
        if rollouts > MAX_ROLLOUTS:
            raise ValueError(
                f"{width_name} * n_simulations is {rollouts} rollouts per environment; at most "
                f"{MAX_ROLLOUTS} are supported."
            )
        if rollouts * self.rollout_depth > MAX_STEPS:
            raise ValueError(
                f"{width_name} * n_simulations * rollout_depth is {rollouts * self.rollout_depth} steps per "
                f"environment; at most {MAX_STEPS} are supported."
            )

    def _check_budget(self) -> None:
        if self.time_budget is not None:
            self._set_number("time_budget", sys.float_info.max)
            if self.time_budget <= 0 or self.rollout_depth == 0:
                raise ValueError(
                    f"time_budget must be above 0 seconds, and needs a rollout_depth of 1 or more; got "
                    f"{self.time_budget} with rollout_depth={self.rollout_depth}."
                )
        if self.max_beam_width is not None:
            self._set_integer("max_beam_width", self.beam_width, MAX_ROLLOUTS)
            if self.time_budget is None:
                raise ValueError("max_beam_width needs a time_budget; without one set beam_width.")

    def _set_integer(self, name: str, low: int, high: int) -> None:
        value = getattr(self, name)
        if isinstance(value, bool) or not isinstance(value, Integral):
            raise TypeError(f"{name} must be an integer, got {value!r}.")
        if not low <= int(value) <= high:
            raise ValueError(f"{name} must be between {low} and {high}, got {value}.")
        # NumPy's integers have few bits, and products of settings overflow.
        object.__setattr__(self, name, int(value))

    def _set_number(self, name: str, high: float) -> None:
        value = getattr(self, name)
        if isinstance(value, bool) or not isinstance(value, Real):
            raise TypeError(f"{name} must be a number, got {value!r}.")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        # NaN is not between anything.
        if not 0 <= number <= high:
            raise ValueError(f"{name} must be finite, not negative and at most {high:g}, got {value}.")
        object.__setattr__(self, name, number)

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
