"""What a look-ahead needs from a simulator: many simulated states side by side.

A forward model keeps rows. A row is one simulated state. Rows are filled from the states of real
environments (:meth:`ForwardModel.read_roots`, :meth:`ForwardModel.set_roots`), gathered
(:meth:`ForwardModel.select`) and stepped together (:meth:`ForwardModel.step`). Nothing that a
model does is visible in a real environment.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

#: One array ``[rows, *shape]``, or one per key for a Dict observation space.
Observations = np.ndarray | dict[str, np.ndarray]

# Names of choices, for type checkers. What a command or an error lists comes from the same place.
Strategy = Literal["beam", "tree", "cem"]
Preset = Literal["paper", "efficient", "balanced", "strong", "train"]
Backend = Literal["auto", "mujoco", "pool", "ensemble"]
ScheduleName = Literal["constant", "saturation", "anneal"]
SearchUnit = Literal["step", "episode"]
MatmulPrecision = Literal["highest", "high", "medium"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)


class Transition(NamedTuple):
    """What one simulated step of every row gave.

    :param observations: ``[rows, *obs_shape]`` (or a dict of such arrays), in the dtype that the
        real environment returns.
    :param rewards: ``[rows]`` float64, as the real environment returns them.
    :param terminated: ``[rows]`` bool. A ``TimeLimit`` never shows here.
    :param valid: ``[rows]`` bool. False where the simulation diverged: nothing else that the row
        says may be used, and stepping it again has no meaning.
    :param stopped: ``[rows]`` bool, or ``None`` for nowhere. True where the environment itself truncated the
        episode: no step can follow, but the state is not terminal: the return bootstraps from the critics.
    """

    observations: Observations
    rewards: np.ndarray
    terminated: np.ndarray
    valid: np.ndarray
    stopped: np.ndarray | None = None

    @property
    def goes_on(self) -> np.ndarray:
        """``[rows]`` bool, whether a row can be stepped further."""
        goes_on = self.valid & ~self.terminated
        return goes_on if self.stopped is None else goes_on & ~self.stopped


class Layer(NamedTuple):
    """A linear layer with what comes before and after it; its float32 arrays by their addresses.

    So compiled code is the same for any number of layers, and always reads the networks' current weights.

    :param gain: address of ``[n_in]``, multiplied with the input first; 0 if there is nothing.
    :param shift: address of ``[n_in]``, added then.
    :param weight: address of ``[n_out, n_in]``.
    :param bias: address of ``[n_out]``.
    :param n_in: inputs.
    :param n_out: outputs.
    :param activation: of the output, one of :data:`ACTIVATIONS`.
    """

    gain: int
    shift: int
    weight: int
    bias: int
    n_in: int
    n_out: int
    activation: int


#: :attr:`Layer.activation` by name.
ACTIVATIONS = {"none": 0, "relu": 1, "tanh": 2}


class PolicyArrays(NamedTuple):
    """An actor, its critics, and all that lies between them and the environment, as arrays.

    A network is a table of its layers, a row of numbers for each :class:`Layer`. Who makes one keeps the
    arrays behind the addresses alive.

    :param actor: ``[layers, 7]`` int64, float32 observations -> actions in [-1, 1].
    :param critics: ``[critics, layers, 7]`` int64, float32 observations and actions -> estimates.
    :param averages: whether the value is the mean over all estimates (TQC's quantiles) or the minimum.
    :param mean: ``[obs_dim]``, subtracted from observations; empty if they are not normalised.
    :param deviation: ``[obs_dim]``, which then divides them.
    :param clip: the largest absolute normalised entry.
    :param low: ``[act_dim]`` float32, the environment's lowest actions.
    :param half_range: ``[act_dim]`` float32, half the distance to the highest.
    :param reward_scale: divides rewards.
    :param reward_clip: the largest absolute scaled reward.
    :param gamma: discount factor per environment step.
    """

    actor: np.ndarray
    critics: np.ndarray
    averages: bool
    mean: np.ndarray
    deviation: np.ndarray
    clip: float
    low: np.ndarray
    half_range: np.ndarray
    reward_scale: float
    reward_clip: float
    gamma: float


class PolicyRollouts(NamedTuple):
    """What rolling out a policy gave.

    :param returns: ``[candidates, sim]``, discounted sums of scaled rewards until the last valid step, and,
        if asked for, of the critics' value after a last step that ended nothing.
    :param valid: ``[candidates, sim]`` bool, False where the simulation diverged.
    :param terminated: ``[candidates, sim]`` bool.
    :param lengths: ``[candidates, sim]``, numbers of valid steps.
    :param observations: ``[candidates, sim, obs_dim]``, the last ones, as the environment returns them.
    :param actions: ``[candidates, sim, act_dim]`` float32, the actions to take there.
    :param first_observations: ``[candidates, obs_dim]``, after the first step.
    :param first_rewards: ``[candidates]``, of the first step, not scaled.
    :param simulated_steps: environment steps, each counted once.
    """

    returns: np.ndarray
    valid: np.ndarray
    terminated: np.ndarray
    lengths: np.ndarray
    observations: np.ndarray
    actions: np.ndarray
    first_observations: np.ndarray
    first_rewards: np.ndarray
    simulated_steps: int


class ForwardModel(ABC):
    """Many simulated states of one or more real environments.

    :ivar deterministic: whether the same state and action always give the same transition. A
        search then simulates the first step of a candidate once for all its simulations.
    :ivar kind: the backend, ``"mujoco"``, ``"pool"`` or ``"ensemble"``; what ``forward_model=`` asks for.
    :ivar description: one line for a log: which backend, and why if it was chosen by itself.
    :ivar why_not_faster: why "auto" could not take a faster model; "" if this is the fastest.
    :ivar first_error: traceback of the first error that an environment raised in a simulation; "" for none.
    """

    deterministic: bool
    kind: str
    description: str
    first_error: str = ""
    why_not_faster: str = ""

    @property
    @abstractmethod
    def n_rows(self) -> int:
        """Number of simulated states held at present."""

    @abstractmethod
    def read_roots(self, env_indices: Sequence[int]) -> list[Any]:
        """Read the present states of real environments.

        :param env_indices: which environments, by their position in the vectorized environment.
        :return: one opaque root per environment, to be given to :meth:`set_roots`.
        """

    @abstractmethod
    def set_roots(self, roots: Sequence[Any], index: np.ndarray, rng: np.random.Generator) -> None:
        """Make row i a simulation that starts at ``roots[index[i]]``.

        :param roots: what :meth:`read_roots` returned.
        :param index: ``[rows]`` integers into ``roots``, non-decreasing; the model then has
            ``len(index)`` rows.
        :param rng: where rows with random dynamics take their generators from, so that a
            look-ahead never sees the real environment's future random draws. A deterministic model
            draws nothing from it.
        """

    @abstractmethod
    def select(self, index: np.ndarray) -> None:
        """Make row i what row ``index[i]`` was: copies, drops and reorders rows.

        :param index: ``[new_rows]`` integers into the present rows, non-decreasing; a row that is
            named twice is copied, one that is not named is dropped.
        """

    @abstractmethod
    def step(self, actions: np.ndarray) -> Transition:
        """Step every row once.

        :param actions: ``[rows, *act_shape]``, in the action space of the environment (not scaled
            to [-1, 1]), in its dtype. Row i's numbers reach the simulator as they are.
        :return: the transition. Its arrays are valid until the next call, which may overwrite them.
        """

    def refresh(self) -> None:  # noqa: B027
        """Take over what the real environments' simulators are now, after they were edited.

        :raises ForwardModelError: if this model cannot follow the edit.
        """

    def close(self) -> None:  # noqa: B027
        """Release threads, processes and copies of environments."""


class ForwardModelError(RuntimeError):
    """No forward model can simulate this environment, or not any longer; the message says why."""


def stack(observations: list[Any]) -> Observations:
    """``[rows, *obs_shape]`` from single observations, per key where they are dicts."""
    if isinstance(observations[0], dict):
        return {key: np.stack([one[key] for one in observations]) for key in observations[0]}
    return np.stack(observations)


def map_arrays(function: Callable[[np.ndarray], Any], observations: Observations) -> Any:
    """Apply a function to observations, or to each part of a dict of them.

    :param function: of one array.
    :param observations: one array, or one per key.
    :return: its value, or one per key.
    """
    if isinstance(observations, dict):
        return {key: function(value) for key, value in observations.items()}
    return function(observations)


def take_rows(observations: Observations, index: np.ndarray | slice) -> Observations:
    """Copy rows out of observations.

    :param observations: ``[rows, *obs_shape]``.
    :param index: which rows.
    :return: the copy.
    """
    if isinstance(observations, dict):
        return {key: value[index].copy() for key, value in observations.items()}
    return observations[index].copy()


def put_rows(target: Observations, into: Any, source: Observations, index: Any) -> None:
    """Copy rows into other observations.

    :param target: ``[n, *obs_shape]``, changed in place.
    :param into: index of its rows.
    :param source: ``[rows, *obs_shape]``.
    :param index: index of its rows, of the same length.
    """
    if isinstance(target, dict):
        assert isinstance(source, dict)
        for key, value in target.items():
            value[into] = source[key][index]
    else:
        assert isinstance(source, np.ndarray)
        target[into] = source[index]


def row_of(observations: Observations, index: int) -> Any:
    """One of them.

    :param observations: ``[rows, *obs_shape]``.
    :param index: which row.
    """
    if isinstance(observations, dict):
        return {key: value[index] for key, value in observations.items()}
    return observations[index]


def n_rows(observations: Observations) -> int:
    """How many there are.

    :param observations: ``[rows, *obs_shape]``.
    """
    return len(next(iter(observations.values()))) if isinstance(observations, dict) else len(observations)


def equal(left: Observations, right: Observations) -> bool:
    """Whether two are the same; NaN is not equal to itself.

    :param left: ``[rows, *obs_shape]``.
    :param right: the others.
    """
    if isinstance(left, dict):
        return isinstance(right, dict) and all(np.array_equal(left[key], right[key]) for key in left)
    # What np.array_equal does, without its Python.
    return not isinstance(right, dict) and left.shape == right.shape and bool((left == right).all())


def difference(left: Any, right: Any) -> float:
    """Largest absolute difference; two NaNs are equal, a NaN and a number are infinitely far apart.

    :param left: one observation, or a number.
    :param right: the other.
    """
    if isinstance(left, dict):
        return max(difference(left[key], right[key]) for key in left)
    left, right = np.asarray(left, np.float64), np.asarray(right, np.float64)
    if np.array_equal(left, right, equal_nan=True):
        return 0.0
    distance = np.abs(left - right)
    return float(np.where(np.isnan(distance), np.inf, distance).max())
