"""The settings of each strategy."""

import sys
from dataclasses import dataclass

from sb3_mcbs.search.settings import MAX_NOISE, MAX_ROLLOUTS, SearchSettings


@dataclass(frozen=True)
class BeamSettings(SearchSettings):
    """Settings of ``strategy="beam"``, Monte Carlo Beam Search (Algorithm 1): those of
    :class:`SearchSettings`, and these in ``search_kwargs``.

    :param time_budget: seconds that a decision may take, from the call to the action. Candidates are then
        evaluated in rounds while the next is expected to finish in time, and results depend on the machine's
        speed. ``None``: no limit, and results are reproducible bit for bit.
    :param max_beam_width: with ``time_budget``, the largest number of candidates; ``None``: ``beam_width``,
        which may leave time unused.
    """

    strategy = "beam"

    time_budget: float | None = None
    max_beam_width: int | None = None

    @property
    def _factors(self) -> list[str]:
        width = "beam_width" if self.max_beam_width is None else "max_beam_width"
        return [width, "n_simulations"]

    def _check_strategy(self) -> None:
        if self.max_beam_width is not None:
            self._set_integer("max_beam_width", self.beam_width, MAX_ROLLOUTS)
            if self.time_budget is None:
                raise ValueError("max_beam_width needs a time_budget; without one set beam_width.")
        most = self.max_beam_width or self.beam_width
        if most > 1 and not self.is_noisy(self.beam_noise):
            raise ValueError(
                "beam_width above 1 needs a beam_noise above 0, and a noise_clip above 0 if it is set: all "
                "candidates would be the policy's own action."
            )
        if self.time_budget is None:
            return
        self._set_number("time_budget", sys.float_info.max)
        if self.time_budget <= 0 or self.rollout_depth == 0:
            raise ValueError(
                f"time_budget must be above 0 seconds, and needs a rollout_depth of 1 or more; got "
                f"{self.time_budget} with rollout_depth={self.rollout_depth}."
            )
        for name in ("n_proposals", "antithetic"):
            if getattr(self, name):
                raise ValueError(
                    f"time_budget evaluates candidates in rounds, which {name} does not: leave one of "
                    "the two out."
                )

    @property
    def why_by_steps(self) -> str:
        return "" if self.time_budget is None else "time_budget may stop them between two steps"

    def distinct_simulations(self, deterministic: bool) -> int:
        # Only Algorithm 1 draws separate noise for each simulation.
        noisy = self.is_noisy(self.effective_rollout_noise)
        return self.n_simulations if noisy else super().distinct_simulations(deterministic)

    def simulated_steps(self, deterministic: bool = True) -> int:
        simulations, width = self.distinct_simulations(deterministic), self.max_beam_width or self.beam_width
        shared = min(self.noise_hold, self.horizon) if deterministic else 0
        return width * (shared + (self.horizon - shared) * simulations)


@dataclass(frozen=True)
class TreeSettings(SearchSettings):
    """Settings of ``strategy="tree"``, which expands the best ``beam_width`` nodes of every depth: those of
    :class:`SearchSettings`, and this in ``search_kwargs``.

    :param branching: children per node.
    """

    strategy = "tree"

    branching: int = 5

    @property
    def _factors(self) -> list[str]:
        drawn = ["beam_width", "branching"] if self.n_proposals is None else ["n_proposals"]
        return [*drawn, "n_simulations"]

    def _check_strategy(self) -> None:
        self._set_integer("branching", 1, MAX_ROLLOUTS)
        self._check_that_it_simulates()
        is_deep = self.rollout_depth > 1 and self.branching > 1
        if is_deep and not self.is_noisy(self.effective_rollout_noise):
            raise ValueError(
                "strategy='tree' needs a rollout_noise above 0 (None: as beam_noise), or branching=1: all "
                "children of a node would be the same."
            )

    def _check_proposals(self, least: int | None = None) -> None:
        super()._check_proposals(self.beam_width * self.branching)
        if self.n_proposals is not None and self.n_proposals % self.beam_width:
            raise ValueError(
                f"n_proposals must be a multiple of beam_width={self.beam_width} with strategy='tree', since "
                f"each node proposes equally many; got {self.n_proposals}."
            )

    @property
    def why_by_steps(self) -> str:
        return "a tree chooses the branches that go on after every step"

    def simulated_steps(self, deterministic: bool = True) -> int:
        return self.beam_width * self.branching * self.distinct_simulations(deterministic) * self.horizon


@dataclass(frozen=True)
class CEMSettings(SearchSettings):
    """Settings of ``strategy="cem"``, the cross-entropy method (``n_rounds`` of ``beam_width`` plans, each
    round around the best so far): those of :class:`SearchSettings`, and these in ``search_kwargs``.

    :param n_rounds: rounds per decision.
    :param n_elites: best plans to which the next round is fitted. ``None``: a quarter of ``beam_width``.
    :param min_noise: lower bound of the spread, in the scaled action space.
    """

    strategy = "cem"

    n_rounds: int = 3
    n_elites: int | None = None
    min_noise: float = 0.02

    @property
    def _factors(self) -> list[str]:
        return ["beam_width" if self.n_proposals is None else "n_proposals", "n_rounds", "n_simulations"]

    def _check_strategy(self) -> None:
        self._set_integer("n_rounds", 1, MAX_ROLLOUTS)
        if self.n_elites is not None:
            self._set_integer("n_elites", 1, self.beam_width)
        self._set_number("min_noise", MAX_NOISE)
        self._check_that_it_simulates()
        if self.beam_width == 1:
            raise ValueError("strategy='cem' needs a beam_width of 2 or more; got 1.")
        if self.n_rounds > 1 and self.effective_n_elites == 1 and self.min_noise == 0:
            raise ValueError(
                "strategy='cem' needs n_elites of 2 or more with min_noise=0: one elite has no spread, "
                "and all later rounds would repeat it (n_elites=None is a quarter of beam_width)."
            )

    @property
    def effective_n_elites(self) -> int:
        """Number of best plans to which the next round is fitted."""
        return max(1, self.beam_width // 4) if self.n_elites is None else self.n_elites

    def simulated_steps(self, deterministic: bool = True) -> int:
        return self.n_rounds * self.beam_width * self.distinct_simulations(deterministic) * self.horizon
