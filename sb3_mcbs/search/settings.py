"""The settings of a search, checked once and then immutable: what all strategies share, and presets."""

import functools
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from sb3_mcbs.search.checks import CheckedSettings, as_dict, known_keys
from sb3_mcbs.types import BACKENDS

#: More rollouts than this per environment are a mistake, not a search: memory would run out.
MAX_ROLLOUTS = 100_000
MAX_DEPTH = 10_000
#: Steps of one decision and environment: the noise of all of them is drawn at once.
MAX_STEPS = 10_000_000
#: Anything above clips every action to a corner, and float32 must be able to hold it.
MAX_NOISE = 1e6
MAX_THREADS = 1024
MATMUL_PRECISIONS = ("highest", "high", "medium")
#: The settings' class of each strategy, as defined in :mod:`~sb3_mcbs.search.strategy_settings`.
STRATEGIES: dict[str, type["SearchSettings"]] = {}
#: Settings of how, not of what, is computed: no preset or trial is about them.
OF_THE_MACHINE = ("forward_model", "model_kwargs", "matmul_precision")


@dataclass(frozen=True)
class SearchSettings(CheckedSettings, ABC):
    """What the settings of all strategies share: :class:`BeamSettings`, :class:`TreeSettings` and
    :class:`CEMSettings`.

    Agents have ``beam_width``, ``rollout_depth``, ``n_simulations``, ``beam_noise``, ``forward_model`` and
    ``matmul_precision`` as keywords, ``n_threads`` in ``model_kwargs`` and all others in ``search_kwargs``.

    :param beam_width: number of candidate actions per decision (``B``).
    :param rollout_depth: simulated steps per rollout (``D``), macro-steps if ``noise_hold`` is above 1. 0
        ranks the candidates by the critics alone: nothing is simulated and no snapshot is needed.
    :param n_simulations: rollouts per candidate (``N_sim``).
    :param beam_noise: standard deviation of the Gaussian noise that makes candidates of the policy's
        action (``sigma_b``), in the action space scaled to [-1, 1].
    :param rollout_noise: the same for the later actions of a rollout. ``None``: as ``beam_noise``.
    :param noise_clip: noise (of the cross-entropy method: what its plans add to the policy's actions) is
        clipped to [-noise_clip, noise_clip]. ``None``: not clipped, as in the paper's Algorithm 1.
    :param include_policy_action: whether the policy's own action takes the place of the first
        candidate. ``False``, as in the paper, makes all candidates noisy.
    :param n_proposals: actions that are drawn, of which the critics choose those that are simulated.
        ``None``: all that are drawn are simulated.
    :param antithetic: whether noise comes in pairs of opposite sign, of candidates and of the simulations of
        one candidate.
    :param noise_hold: environment steps in a macro-step, in which all noise stays the same while the policy
        goes on reacting. A rollout simulates ``rollout_depth * noise_hold`` environment steps.
    :param proposal_dims: candidates (of a tree: all children, of the cross-entropy method: whole plans)
        differ only in so many directions, those in which recently executed actions varied most. ``None``: in
        all.
    :param forward_model: ``"auto"``, ``"mujoco"`` (batched MuJoCo), ``"pool"`` (copies of the
        environment) or ``"ensemble"`` (learned by the agent, for environments without snapshots).
    :param n_threads: threads that simulate. 0: one per available processor core. The result does not
        depend on it.
    :param matmul_precision: internal precision of the networks' float32 products during a search, as in
        ``torch.set_float32_matmul_precision``: ``"medium"`` is quicker on processors that multiply bfloat16.
        ``None``: as the process has it.
    :raises TypeError: if a value has the wrong type.
    :raises ValueError: if a value is out of range.
    """

    strategy: ClassVar[str]
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
    forward_model: str = "auto"
    n_threads: int = 0
    matmul_precision: str | None = None

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
        """Check the strategy's own settings, and the others with them."""

    @property
    @abstractmethod
    def _factors(self) -> list[str]:
        """The names of the settings whose product are the rollouts of a decision."""

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
        """Whether noise of a standard deviation is any noise at all.

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

    def distinct_simulations(self, deterministic: bool) -> int:
        """How many simulations of a candidate can differ from one another.

        :param deterministic: whether the environment's steps are.
        :return: ``n_simulations``, or 1 where nothing is random.
        """
        return 1 if deterministic else self.n_simulations

    @abstractmethod
    def simulated_steps(self, deterministic: bool = True) -> int:
        """The most environment steps that a decision simulates, per environment.

        :param deterministic: whether the environment's steps are.
        :return: steps; fewer are simulated where rollouts terminate.
        """

    @classmethod
    def in_group(cls) -> tuple[str, ...]:
        return tuple(name for name in super().in_group() if name != "n_threads")

    @classmethod
    def of(cls, agent: Any) -> Self:
        """Read the settings that an agent carries as attributes.

        :param agent: an object that has settings as attributes, such as ``MCBSTD3``.
        :return: the checked settings.
        """
        settings: dict[str, Any] = {name: getattr(agent, name) for name in cls.flat}
        settings["n_threads"] = as_dict("model_kwargs", agent.model_kwargs).get("n_threads", 0)
        return make_settings(agent.strategy, agent.search_kwargs, **settings)  # type: ignore[return-value]

    def grouped(self) -> dict[str, Any]:
        threads = {"n_threads": self.n_threads} if self.n_threads else None
        return {**super().grouped(), "strategy": self.strategy, "model_kwargs": threads}

    @staticmethod
    def preset(name: str, **changes: Any) -> "SearchSettings":
        """Settings for an effort, by name.

        :param name: one of :data:`PRESETS`.
        :param changes: settings that shall differ from the preset, as an agent's constructor takes them.
        :return: the settings.
        :raises ValueError: if there is no preset of that name.
        """
        _check_preset(name)
        return make_settings(**with_preset(name, changes))


def make_settings(
    strategy: str = "beam",
    search_kwargs: Mapping[str, Any] | None = None,
    model_kwargs: Mapping[str, Any] | None = None,
    **settings: Any,
) -> SearchSettings:
    """Make the settings of a strategy, from what an agent's constructor takes.

    :param strategy: one of :data:`STRATEGIES`.
    :param search_kwargs: the settings of the strategy that are no keywords of the constructor.
    :param model_kwargs: ``n_threads``.
    :param settings: the keywords that are about the search.
    :return: the checked settings.
    :raises TypeError: if a value has the wrong type, or a key is not known.
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
    """The present name of a strategy.

    :param strategy: a name, of which an old one brings a warning.
    """
    if isinstance(strategy, str) and strategy == "refine":
        _warn_of_old_name()
        return "cem"
    return strategy


@functools.cache
def _warn_of_old_name() -> None:
    message = "The strategy 'refine' is called 'cem' now, for the cross-entropy method: write strategy='cem'."
    warnings.warn(message, FutureWarning, stacklevel=4)


#: The settings that presets change, by the names of the presets. Around trained agents in deterministic
#: environments "efficient", "balanced" and "strong" simulate about 20, 110 and 580 steps per decision.
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    "efficient": dict(n_simulations=1, search_kwargs=dict(rollout_noise=0.0, include_policy_action=True)),
    "balanced": dict(strategy="cem", beam_width=12, n_simulations=1, search_kwargs=dict(antithetic=True)),
    "strong": dict(
        strategy="cem",
        beam_width=24,
        rollout_depth=6,
        n_simulations=1,
        search_kwargs=dict(n_rounds=4, n_elites=4, antithetic=True),
    ),
}


def with_preset(name: str | None, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Start from a preset.

    :param name: one of :data:`PRESETS`; ``None``: there is none.
    :param changes: settings that stay as they are, whatever the preset says.
    :return: the preset's settings and those, see :func:`merged`.
    :raises ValueError: if there is no preset of that name.
    """
    if name is None:
        return dict(changes)
    _check_preset(name)
    return merged(PRESETS[name], changes)


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with others over them: of ``search_kwargs`` and ``model_kwargs`` each key.

    :param base: settings as an agent's constructor takes them.
    :param changes: the same. What another strategy than that of ``base`` does not know is dropped from it.
    :return: both.
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
