"""Settings of a search, checked once and then immutable: those of all strategies, and presets."""

import functools
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self, get_args

from sb3_mcbs.search.checks import CheckedSettings, as_dict, known_keys
from sb3_mcbs.types import BACKENDS, Backend, MatmulPrecision, Preset, Strategy

#: Rollouts per decision and environment; more would exhaust the memory.
MAX_ROLLOUTS = 100_000
MAX_DEPTH = 10_000
#: Steps per decision and environment, whose noise is drawn at once.
MAX_STEPS = 10_000_000
#: Larger noise clips every action to a corner, and may not fit float32.
MAX_NOISE = 1e6
MAX_THREADS = 1024
MATMUL_PRECISIONS: tuple[MatmulPrecision, ...] = get_args(MatmulPrecision)
#: The settings class of each strategy, see :mod:`~sb3_mcbs.search.strategy_settings`.
STRATEGIES: dict[str, type["SearchSettings"]] = {}
#: Settings of the machine, which presets leave alone.
OF_THE_MACHINE = ("forward_model", "model_kwargs", "matmul_precision")


@dataclass(frozen=True)
class SearchSettings(CheckedSettings, ABC):
    """Abstract base of :class:`BeamSettings`, :class:`TreeSettings` and :class:`CEMSettings`: the settings of
    all strategies.

    Agents have ``beam_width``, ``rollout_depth``, ``n_simulations``, ``beam_noise``, ``forward_model`` and
    ``matmul_precision`` as keywords, ``n_threads`` in ``model_kwargs`` and all others in ``search_kwargs``.

    :param beam_width: number of candidate actions per decision (``B``).
    :param rollout_depth: simulated steps per rollout (``D``), macro-steps if ``noise_hold`` is above 1. 0
        ranks the candidates by the critics alone: nothing is simulated and no snapshot is needed.
    :param n_simulations: rollouts per candidate (``N_sim``).
    :param beam_noise: standard deviation of the Gaussian noise that is added to the policy's action
        (``sigma_b``), in the action space scaled to [-1, 1].
    :param rollout_noise: the same for the later actions of a rollout. ``None``: ``beam_noise``.
    :param noise_clip: noise (for the cross-entropy method: the whole plan) is clipped to
        [-noise_clip, noise_clip]. ``None``: not clipped, as in the paper's Algorithm 1.
    :param include_policy_action: whether the policy's own action replaces the first candidate. ``False``, as
        in the paper, adds noise to all candidates.
    :param n_proposals: number of sampled actions, of which the critics choose those to simulate. ``None``:
        all are simulated.
    :param antithetic: whether noise comes in pairs of opposite sign, for candidates and for the simulations
        of a candidate.
    :param noise_hold: environment steps in a macro-step, in which all noise stays the same while the policy
        reacts to every state. A rollout simulates ``rollout_depth * noise_hold`` environment steps.
    :param proposal_dims: number of directions in which candidates (for a tree: all children, for the
        cross-entropy method: whole plans) differ, those in which recently executed actions varied most.
        ``None``: all directions.
    :param forward_model: ``"auto"``, ``"mujoco"`` (batched MuJoCo), ``"pool"`` (copies of the
        environment) or ``"ensemble"`` (learned by the agent, for environments without snapshots).
    :param n_threads: simulation threads. 0: one per available processor core. The result does not depend on
        it.
    :param matmul_precision: internal precision of the networks' float32 products during a search, as in
        ``torch.set_float32_matmul_precision``: ``"medium"`` is faster on processors with bfloat16 support.
        ``None``: the process's setting.
    :raises TypeError: if a value has the wrong type.
    :raises ValueError: if a value is out of range.
    """

    strategy: ClassVar[Strategy]
    group = "search_kwargs"
    flat = ("beam_width", "rollout_depth", "n_simulations", "beam_noise", "forward_model", "matmul_precision")

    beam_width: int = 6
    rollout_depth: int = 3
    n_simulations: int = 5
    beam_noise: float = 0.1
    rollout_noise: float | None = None
    noise_clip: float | None = None
    include_policy_action: bool = False
    n_proposals: int | None = None
    antithetic: bool = False
    noise_hold: int = 1
    proposal_dims: int | None = None
    forward_model: Backend = "auto"
    n_threads: int = 0
    matmul_precision: MatmulPrecision | None = None

    def __init_subclass__(cls) -> None:
        STRATEGIES[cls.strategy] = cls

    def __post_init__(self) -> None:
        self._set_integer("beam_width", 1, MAX_ROLLOUTS)
        self._set_integer("rollout_depth", 0, MAX_DEPTH)
        self._set_integer("n_simulations", 1, MAX_ROLLOUTS)
        self._set_integer("n_threads", 0, MAX_THREADS)
        self._set_integer("noise_hold", 1, MAX_DEPTH)
        if self.proposal_dims is not None:
            self._set_integer("proposal_dims", 1, MAX_ROLLOUTS)
        self._set_number("beam_noise", MAX_NOISE)
        for name in ("rollout_noise", "noise_clip"):
            if getattr(self, name) is not None:
                self._set_number(name, MAX_NOISE)
        for name in ("include_policy_action", "antithetic"):
            self._check_flag(name)
        self._check_name("forward_model", BACKENDS)
        if self.matmul_precision is not None:
            self._check_name("matmul_precision", MATMUL_PRECISIONS, "None")

        if self.forward_model == "ensemble" and self.rollout_depth == 0:
            raise ValueError(
                "forward_model='ensemble' needs a rollout_depth of 1 or more: with 0 nothing is simulated."
            )
        self._check_strategy()
        self._check_proposals()
        self._check_hierarchy()
        self._check_size()

    @abstractmethod
    def _check_strategy(self) -> None:
        """Check the strategy's own settings, also in combination with the others."""

    @property
    @abstractmethod
    def _factors(self) -> list[str]:
        """The names of the settings whose product is the number of rollouts of a decision."""

    def _check_size(self) -> None:
        factors = self._factors
        rollouts = math.prod(getattr(self, name) for name in factors)
        if rollouts > MAX_ROLLOUTS:
            raise ValueError(
                f"{' * '.join(factors)} is {rollouts} rollouts per environment; at most "
                f"{MAX_ROLLOUTS} are supported."
            )
        if rollouts * self.horizon > MAX_STEPS:
            factors += ["rollout_depth"] if self.noise_hold == 1 else ["rollout_depth", "noise_hold"]
            raise ValueError(
                f"{' * '.join(factors)} is {rollouts * self.horizon} steps per environment; at most "
                f"{MAX_STEPS} are supported."
            )

    def _check_that_it_simulates(self) -> None:
        chosen = f"strategy={self.strategy!r}"
        if self.rollout_depth == 0:
            raise ValueError(f"{chosen} needs a rollout_depth of 1 or more; got 0.")
        if not self.is_noisy(self.beam_noise):
            raise ValueError(
                f"{chosen} needs a beam_noise above 0, and a noise_clip above 0 if it is set: all "
                "candidates would be the same."
            )

    def _check_proposals(self, least: int | None = None) -> None:
        if self.n_proposals is None:
            return
        self._set_integer("n_proposals", min(least or self.beam_width, MAX_ROLLOUTS), MAX_ROLLOUTS)
        if self.rollout_depth == 0:
            raise ValueError(
                "n_proposals needs a rollout_depth of 1 or more: with 0 the critics rank all candidates "
                "anyway, and beam_width is their number."
            )

    def _check_hierarchy(self) -> None:
        if self.noise_hold > 1:
            if self.rollout_depth == 0:
                raise ValueError(
                    "noise_hold needs a rollout_depth of 1 or more: with 0 nothing is simulated."
                )
            if not self.is_noisy(max(self.beam_noise, self.effective_rollout_noise)):
                raise ValueError(
                    "noise_hold holds noise; there is none with this beam_noise, rollout_noise and "
                    "noise_clip: leave it out."
                )
        if self.proposal_dims is not None and not self.is_noisy(self.beam_noise):
            raise ValueError(
                "proposal_dims needs a beam_noise above 0, and a noise_clip above 0 if it is set: without "
                "noise there are no directions."
            )

    def is_noisy(self, spread: float) -> bool:
        """Whether noise with a standard deviation is not zero.

        :param spread: the standard deviation.
        """
        return spread > 0 and self.noise_clip != 0

    @property
    def effective_rollout_noise(self) -> float:
        """Standard deviation of the noise on the later actions of a rollout."""
        return self.beam_noise if self.rollout_noise is None else self.rollout_noise

    @property
    def horizon(self) -> int:
        """Environment steps that a rollout simulates."""
        return self.rollout_depth * self.noise_hold

    @property
    def why_by_steps(self) -> str:
        """Why rollouts are not simulated in one go; empty if they are."""
        return ""

    def distinct_simulations(self, deterministic: bool) -> int:
        """The number of simulations of a candidate that can differ.

        :param deterministic: whether the environment is deterministic.
        :return: ``n_simulations``, or 1 where nothing is random.
        """
        return 1 if deterministic else self.n_simulations

    @abstractmethod
    def simulated_steps(self, deterministic: bool = True) -> int:
        """The maximum number of simulated steps of a decision, per environment.

        :param deterministic: whether the environment is deterministic.
        :return: steps; fewer are simulated if rollouts terminate.
        """

    @classmethod
    def in_group(cls) -> tuple[str, ...]:
        return tuple(name for name in super().in_group() if name != "n_threads")

    @classmethod
    def of(cls, agent: Any) -> Self:
        """Read the settings from an agent's attributes.

        :param agent: an object with settings as attributes, such as ``MCBSTD3``.
        :return: the checked settings of its strategy.
        """
        settings: dict[str, Any] = {name: getattr(agent, name) for name in cls.flat}
        settings["n_threads"] = as_dict("model_kwargs", agent.model_kwargs).get("n_threads", 0)
        return make_settings(agent.strategy, agent.search_kwargs, **settings)  # type: ignore[return-value]

    def grouped(self) -> dict[str, Any]:
        threads = {"n_threads": self.n_threads} if self.n_threads else None
        return {**super().grouped(), "strategy": self.strategy, "model_kwargs": threads}

    @staticmethod
    def preset(name: Preset, **changes: Any) -> "SearchSettings":
        """The settings of a preset.

        :param name: one of :data:`PRESETS`.
        :param changes: settings that override the preset, as an agent's constructor takes them.
        :return: the settings.
        :raises ValueError: if there is no preset of that name.
        """
        _check_preset(name)
        return make_settings(**with_preset(name, changes))


#: The keywords of an agent's constructor that are about the search: what :func:`make_settings` takes.
KEYWORDS = (*SearchSettings.flat, "strategy", "search_kwargs", "model_kwargs")


def make_settings(
    strategy: Strategy = "beam",
    search_kwargs: Mapping[str, Any] | None = None,
    model_kwargs: Mapping[str, Any] | None = None,
    **settings: Any,
) -> SearchSettings:
    """Make the settings of a strategy from an agent's constructor arguments.

    :param strategy: one of :data:`STRATEGIES`.
    :param search_kwargs: the settings of the strategy that are not keywords of the constructor.
    :param model_kwargs: ``n_threads``.
    :param settings: the other keywords of the search.
    :return: the checked settings.
    :raises TypeError: if a value has the wrong type, or a key is unknown.
    :raises ValueError: if a value is out of range.
    """
    strategy = present_name(strategy)
    if not isinstance(strategy, str) or strategy not in STRATEGIES:
        raise ValueError(f"strategy must be one of {tuple(STRATEGIES)}, got {strategy!r}.")
    cls = STRATEGIES[strategy]
    others = {
        key: f"is for strategy={name!r}" for name, other in STRATEGIES.items() for key in other.in_group()
    }
    others |= dict.fromkeys((*cls.flat, "strategy"), "is a keyword of its own")
    own = known_keys("search_kwargs", search_kwargs, cls.in_group(), f"strategy={strategy!r}", others)
    threads = known_keys("model_kwargs", model_kwargs, ("n_threads",), "a search")
    return cls(**settings, **own, **threads)


def present_name(strategy: Any) -> Any:
    """The current name of a strategy.

    :param strategy: a name; an old one causes a warning.
    """
    if isinstance(strategy, str) and strategy == "refine":
        _warn_of_old_name()
        return "cem"
    return strategy


@functools.cache
def _warn_of_old_name() -> None:
    message = "The strategy 'refine' is called 'cem' now, for the cross-entropy method: write strategy='cem'."
    warnings.warn(message, FutureWarning, stacklevel=4)


_EFFICIENT: dict[str, Any] = dict(
    n_simulations=1, search_kwargs=dict(rollout_noise=0.0, include_policy_action=True)
)
#: The settings of presets that differ from the defaults. In deterministic environments "efficient",
#: "balanced" and "strong" simulate about 20, 110 and 580 steps per decision. "train" searches as "efficient"
#: does; what it says about the training is the agents' business.
PRESETS: dict[Preset, dict[str, Any]] = {
    "paper": {},
    "efficient": _EFFICIENT,
    "balanced": dict(strategy="cem", beam_width=12, n_simulations=1, search_kwargs=dict(antithetic=True)),
    "strong": dict(
        strategy="cem",
        beam_width=24,
        rollout_depth=6,
        n_simulations=1,
        search_kwargs=dict(n_rounds=4, n_elites=4, antithetic=True),
    ),
    "train": _EFFICIENT,
}


def with_preset(name: Preset | None, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Combine a preset with explicit settings.

    :param name: one of :data:`PRESETS`; ``None``: no preset.
    :param changes: settings that override the preset.
    :return: the combined settings, see :func:`merged`.
    :raises ValueError: if there is no preset of that name.
    """
    if name is None:
        return dict(changes)
    _check_preset(name)
    return merged(PRESETS[name], changes)


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Override settings with others, including single keys of ``search_kwargs`` and ``model_kwargs``.

    :param base: settings as an agent's constructor takes them.
    :param changes: settings that override them. With another strategy, keys of ``base`` that it does not have
        are dropped.
    :return: the combined settings.
    """
    result = {**base, **changes}
    for group in ("search_kwargs", "model_kwargs"):
        below = base.get(group) or {}
        strategy = present_name(result.get("strategy", "beam"))
        if group == "search_kwargs" and isinstance(strategy, str) and strategy in STRATEGIES:
            below = {key: value for key, value in below.items() if key in STRATEGIES[strategy].in_group()}
        if below:
            result[group] = {**below, **as_dict(group, changes.get(group))}
    return result


def _check_preset(name: object) -> None:
    if not isinstance(name, str) or name not in PRESETS:
        raise ValueError(f"There is no preset {name!r}; known are {', '.join(PRESETS)}.")
