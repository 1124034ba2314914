"""The settings of a search, checked once and then immutable."""

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sb3_mcbs.search.checks import CheckedSettings
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
STRATEGIES = ("beam", "tree", "refine")
#: Settings of how, not of what, is computed: no preset or trial is about them.
OF_THE_MACHINE = ("n_threads", "forward_model", "matmul_precision")


@dataclass(frozen=True)
class SearchSettings(CheckedSettings):
    """Settings of a search: Monte Carlo Beam Search (Algorithm 1) unless ``strategy`` says otherwise.

    :param beam_width: number of candidate actions per decision (``B``).
    :param rollout_depth: simulated steps per rollout (``D``), macro-steps if ``noise_hold`` is above 1. 0
        ranks the candidates by the critics alone: nothing is simulated and no snapshot is needed.
    :param n_simulations: rollouts per candidate (``N_sim``).
    :param beam_noise: standard deviation of the Gaussian noise that makes candidates of the policy's
        action (``sigma_b``), in the action space scaled to [-1, 1].
    :param rollout_noise: the same for the later actions of a rollout. ``None``: as ``beam_noise``.
    :param noise_clip: noise (of a refinement: what its plans add to the policy's actions) is clipped to
        [-noise_clip, noise_clip]. ``None``: not clipped, as in the paper's Algorithm 1.
    :param include_policy_action: whether the policy's own action takes the place of the first
        candidate. ``False``, as in the paper, makes all candidates noisy.
    :param n_threads: threads that simulate. 0: one per available processor core. The result does not
        depend on it.
    :param forward_model: ``"auto"``, ``"mujoco"`` (batched MuJoCo), ``"pool"`` (copies of the
        environment) or ``"ensemble"`` (learned by the agent, for environments without snapshots).
    :param matmul_precision: internal precision of the networks' float32 products during a search, as in
        ``torch.set_float32_matmul_precision``: ``"medium"`` is quicker on processors that multiply bfloat16.
        ``None``: as the process has it.
    :param time_budget: seconds that a decision may take, from the call to the action. Candidates are then
        evaluated in rounds while the next is expected to finish in time, and the results depend on how fast
        the machine is. ``None``: all candidates, however long it takes, and reproducible to the bit.
    :param max_beam_width: with ``time_budget``, the number of candidates that is enough; ``None``:
        ``beam_width``, which may leave time unused.
    :param strategy: ``"beam"`` (Algorithm 1), ``"tree"`` (the best ``beam_width`` nodes of every depth grow
        ``branching`` children each) or ``"refine"`` (``n_rounds`` of ``beam_width`` plans, each round around
        the best so far).
    :param n_proposals: actions that are drawn, of which the critics choose those that are simulated.
        ``None``: all that are drawn are simulated.
    :param antithetic: whether noise comes in pairs of opposite sign, of candidates and of the simulations of
        one candidate.
    :param branching: children of a node in a tree.
    :param n_rounds: rounds of a refinement.
    :param n_elites: the best plans that a round of a refinement goes on from. ``None``: a quarter of
        ``beam_width``.
    :param min_noise: what the spread of a refinement does not fall below, in the scaled action space.
    :param noise_hold: environment steps in a macro-step, in which all noise stays the same while the policy
        goes on reacting. A rollout simulates ``rollout_depth * noise_hold`` environment steps.
    :param proposal_dims: candidates (of a tree: all children, of a refinement: whole plans) differ only in so
        many directions, those in which recently executed actions varied most. ``None``: in all.
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
    strategy: str = "beam"
    n_proposals: int | None = None
    antithetic: bool = False
    branching: int = 5
    n_rounds: int = 3
    n_elites: int | None = None
    min_noise: float = 0.02
    noise_hold: int = 1
    proposal_dims: int | None = None

    def __post_init__(self) -> None:
        self._set_integer("beam_width", 1, MAX_ROLLOUTS)
        self._set_integer("rollout_depth", 0, MAX_DEPTH)
        self._set_integer("n_simulations", 1, MAX_ROLLOUTS)
        self._set_integer("n_threads", 0, MAX_THREADS)
        self._set_integer("branching", 1, MAX_ROLLOUTS)
        self._set_integer("n_rounds", 1, MAX_ROLLOUTS)
        self._set_integer("noise_hold", 1, MAX_DEPTH)
        if self.proposal_dims is not None:
            self._set_integer("proposal_dims", 1, MAX_ROLLOUTS)
        if self.max_beam_width is not None:
            self._set_integer("max_beam_width", self.beam_width, MAX_ROLLOUTS)
        for name in ("beam_noise", "min_noise"):
            self._set_number(name, MAX_NOISE)
        for name in ("rollout_noise", "noise_clip"):
            if getattr(self, name) is not None:
                self._set_number(name, MAX_NOISE)
        if self.n_elites is not None:
            self._set_integer("n_elites", 1, self.beam_width)
        for name in ("include_policy_action", "antithetic"):
            self._check_flag(name)
        self._check_name("forward_model", BACKENDS)
        self._check_name("strategy", STRATEGIES)
        if self.matmul_precision is not None:
            self._check_name("matmul_precision", MATMUL_PRECISIONS, "None")

        if self.forward_model == "ensemble" and self.rollout_depth == 0:
            raise ValueError(
                "forward_model='ensemble' needs a rollout_depth of 1 or more: with 0 nothing is simulated."
            )
        self._check_strategy()
        self._check_proposals()
        self._check_hierarchy()
        self._check_budget()
        self._check_size()

    def _check_size(self) -> None:
        factors = ["beam_width", "n_simulations"]
        if self.max_beam_width is not None:
            factors[0] = "max_beam_width"
        if self.strategy == "tree":
            factors[:1] = ["beam_width", "branching"] if self.n_proposals is None else ["n_proposals"]
        elif self.strategy == "refine":
            factors[:1] = ["beam_width" if self.n_proposals is None else "n_proposals", "n_rounds"]
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

    def _check_budget(self) -> None:
        if self.time_budget is not None:
            self._set_number("time_budget", sys.float_info.max)
            if self.time_budget <= 0 or self.rollout_depth == 0:
                raise ValueError(
                    f"time_budget must be above 0 seconds, and needs a rollout_depth of 1 or more; got "
                    f"{self.time_budget} with rollout_depth={self.rollout_depth}."
                )
            if self.strategy != "beam":
                raise ValueError(
                    f"time_budget works with strategy='beam' only, got strategy={self.strategy!r}."
                )
            for name in ("n_proposals", "antithetic"):
                if getattr(self, name):
                    raise ValueError(
                        f"time_budget evaluates candidates in rounds, which {name} does not: leave one of "
                        "the two out."
                    )
        if self.max_beam_width is not None and self.time_budget is None:
            raise ValueError("max_beam_width needs a time_budget; without one set beam_width.")

    def _check_strategy(self) -> None:
        chosen = f"strategy={self.strategy!r}"
        if self.strategy == "beam":
            self._check_beam()
            return
        if self.rollout_depth == 0:
            raise ValueError(f"{chosen} needs a rollout_depth of 1 or more; got 0.")
        if not self.is_noisy(self.beam_noise):
            raise ValueError(
                f"{chosen} needs a beam_noise above 0, and a noise_clip above 0 if it is set: all "
                "candidates would be the same."
            )
        if self.strategy == "refine":
            self._check_refinement()
        is_deep = self.strategy == "tree" and self.rollout_depth > 1 and self.branching > 1
        if is_deep and not self.is_noisy(self.effective_rollout_noise):
            raise ValueError(
                f"{chosen} needs a rollout_noise above 0 (None: as beam_noise), or branching=1: all children "
                "of a node would be the same."
            )

    def _check_beam(self) -> None:
        most = self.max_beam_width or self.beam_width
        if most > 1 and not self.is_noisy(self.beam_noise):
            raise ValueError(
                "beam_width above 1 needs a beam_noise above 0, and a noise_clip above 0 if it is set: all "
                "candidates would be the policy's own action."
            )

    def _check_refinement(self) -> None:
        if self.beam_width == 1:
            raise ValueError("strategy='refine' needs a beam_width of 2 or more; got 1.")
        if self.n_rounds > 1 and self.effective_n_elites == 1 and self.min_noise == 0:
            raise ValueError(
                "strategy='refine' needs n_elites of 2 or more with min_noise=0: one elite has no spread, "
                "and all later rounds would repeat it (n_elites=None is a quarter of beam_width)."
            )

    def _check_proposals(self) -> None:
        if self.n_proposals is None:
            return
        per_environment = self.beam_width * (self.branching if self.strategy == "tree" else 1)
        self._set_integer("n_proposals", min(per_environment, MAX_ROLLOUTS), MAX_ROLLOUTS)
        if self.rollout_depth == 0:
            raise ValueError(
                "n_proposals needs a rollout_depth of 1 or more: with 0 the critics rank all candidates "
                "anyway, and beam_width is their number."
            )
        if self.strategy == "tree" and self.n_proposals % self.beam_width:
            raise ValueError(
                f"n_proposals must be a multiple of beam_width={self.beam_width} with strategy='tree', since "
                f"each node proposes equally many; got {self.n_proposals}."
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

    @property
    def effective_n_elites(self) -> int:
        """The best plans that a refinement goes on from."""
        return max(1, self.beam_width // 4) if self.n_elites is None else self.n_elites

    def distinct_simulations(self, deterministic: bool) -> int:
        """How many simulations of a candidate can differ from one another.

        :param deterministic: whether the environment's steps are.
        :return: ``n_simulations``, or 1 where nothing is random.
        """
        # Only Algorithm 1 draws the later actions of each simulation anew.
        noisy = self.strategy == "beam" and self.is_noisy(self.effective_rollout_noise)
        return self.n_simulations if noisy or not deterministic else 1

    def simulated_steps(self, deterministic: bool = True) -> int:
        """The most environment steps that a decision simulates, per environment.

        :param deterministic: whether the environment's steps are.
        :return: steps; fewer are simulated where rollouts terminate.
        """
        simulations, width = self.distinct_simulations(deterministic), self.max_beam_width or self.beam_width
        if self.strategy == "tree":
            return width * self.branching * simulations * self.horizon
        if self.strategy == "refine":
            return self.n_rounds * width * simulations * self.horizon
        shared = min(self.noise_hold, self.horizon) if deterministic else 0
        return width * (shared + (self.horizon - shared) * simulations)

    @classmethod
    def preset(cls, name: str, **changes: Any) -> "SearchSettings":
        """Settings for an effort, by name.

        :param name: one of :data:`PRESETS`.
        :param changes: settings that shall differ from the preset.
        :return: the settings.
        :raises ValueError: if there is no preset of that name.
        """
        _check_preset(name)
        return cls(**with_preset(name, changes))


#: The settings that presets change, by the names of the presets. Around trained agents in deterministic
#: environments "efficient", "balanced" and "strong" simulate about 20, 110 and 580 steps per decision.
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    "efficient": dict(n_simulations=1, rollout_noise=0.0, include_policy_action=True),
    "balanced": dict(strategy="refine", beam_width=12, n_simulations=1, antithetic=True),
    "strong": dict(
        strategy="refine",
        beam_width=24,
        n_rounds=4,
        n_elites=4,
        rollout_depth=6,
        n_simulations=1,
        antithetic=True,
    ),
}


def with_preset(name: str | None, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Start from a preset.

    :param name: one of :data:`PRESETS`; ``None``: there is none.
    :param changes: settings that stay as they are, whatever the preset says.
    :return: the preset's settings and those.
    :raises ValueError: if there is no preset of that name.
    """
    if name is None:
        return dict(changes)
    _check_preset(name)
    return {**PRESETS[name], **changes}


def _check_preset(name: object) -> None:
    if not isinstance(name, str) or name not in PRESETS:
        raise ValueError(f"There is no preset {name!r}; known are {', '.join(PRESETS)}.")
