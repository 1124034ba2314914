"""What one decision looked at: candidates, their values, and where their rollouts lead."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_mcbs.agents import SearchPolicy
from sb3_mcbs.agents.roots import ExactRoots
from sb3_mcbs.search import BeamSettings, SearchSettings, search
from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.video.bodies import find_bodies, mujoco_data
from sb3_mcbs.video.rollouts import RecordedModel, Rollout, replay

_ROUNDING = 2e-6


@dataclass(frozen=True)
class Look:
    """
    One decision in one environment.

    :param values: ``[candidates]``, over the value of the policy's own action; not finite for candidates
        whose simulation was invalid
    :param chosen: index of the chosen candidate; -1: none was valid
    :param traces: the candidates' rollouts: index of the candidate, and ``[steps, bodies, 3]``, positions
    :param own: ``[steps, bodies, 3]``, the same for the policy's own action; None: nothing is known of bodies
    """

    values: np.ndarray
    chosen: int
    traces: Sequence[tuple[int, np.ndarray]]
    own: np.ndarray | None

    @property
    def gain(self) -> float:
        """Value of the chosen candidate over that of the policy's own action; nan if there is none."""
        return float(self.values[self.chosen]) if self.chosen >= 0 else float("nan")

    @property
    def ranks(self) -> np.ndarray:
        """``[candidates]``, 0 for the lowest value to 1 for the highest."""
        order = np.argsort(np.argsort(self.values, kind="stable"), kind="stable")
        return order / max(len(order) - 1, 1)


class Onlooker:
    """
    Follows the decisions of a search.

    :param policy: the search, in a single environment
    :param env: that environment
    :param bodies: names of the bodies to follow; none: the first one that moves
    :raises ValueError: if there is no body of a name
    """

    def __init__(self, policy: SearchPolicy, env: SnapshotEnvWrapper, bodies: Sequence[str] = ()) -> None:
        self.policy = policy
        self._env = env
        data = mujoco_data(env)
        if data is None and bodies:
            raise ValueError(
                "This environment is not simulated with MuJoCo, so there are no bodies to follow."
            )
        self._bodies = find_bodies(data.model, bodies) if data is not None else []
        self._copy: SnapshotEnvWrapper | None = None
        # Not the search's own generator: looking on does not change what is chosen.
        self._rng = np.random.default_rng(0)
        self._recorded: RecordedModel | None = None

    def act(self, observations: Any) -> tuple[np.ndarray, Look]:
        """Decide, and see what was decided between.

        :param observations: ``[1, *]``, of the environment.
        :return: the action ``[1, *]``, and the decision.
        """
        recorded = self._record()
        policy, settings = self.policy, self.policy.settings
        action, _ = policy.predict(observations)
        result = policy.last_result
        assert result is not None
        rollouts = recorded.rollouts(settings) if recorded else []
        own_settings = _policy_alone(settings)
        if recorded:
            recorded.forget()
        own = search(
            policy.planner.capture_roots(observations, [0]),
            policy.planner.functions(),
            own_settings,
            self._rng,
        )
        own_rollouts = recorded.rollouts(own_settings) if recorded else []
        values = result.values[0].astype(np.float64)
        reference = own.values[0, 0]
        traces, own_trace = self._follow(rollouts, own_rollouts, n_candidates=len(values))
        # Where the policy's own rollout diverges there is nothing to compare with.
        values = values - reference if np.isfinite(reference) else np.full(len(values), np.nan)
        # The networks' float32 rounds differently in batches of other sizes.
        values[np.abs(values) < _ROUNDING * abs(reference)] = 0.0
        return action, Look(values, int(result.chosen[0]), traces, own_trace)

    def _record(self) -> RecordedModel | None:
        """Record the forward model, which an environment may make the search exchange."""
        source = self.policy.planner.source
        if not isinstance(source, ExactRoots):  # nothing is simulated, or only observations are
            return None
        if self._recorded is None or source.model is not self._recorded:
            self._recorded = RecordedModel(source.model)
            source.model = self._recorded
        self._recorded.forget()
        return self._recorded

    def _follow(
        self, rollouts: Sequence[Rollout], own: Sequence[Rollout], n_candidates: int
    ) -> tuple[list[tuple[int, np.ndarray]], np.ndarray | None]:
        if not self._bodies or not own:
            return [], None
        if self._copy is None:
            self._copy = self._env.clone()
        state = self._env.snapshot(monitor=False)
        # A round that a deadline interrupted has rollouts, but no values.
        known = [rollout for rollout in rollouts if rollout.candidate < n_candidates]
        positions = [
            replay(self._copy, state, rollout.actions, self._bodies, self._rng)
            for rollout in (*known, own[0])
        ]
        return [(rollout.candidate, way) for rollout, way in zip(known, positions, strict=False)], positions[
            -1
        ]

    def close(self) -> None:
        """Leave the search as it was."""
        source = self.policy.planner.source
        if source is not None and self._recorded is not None and source.model is self._recorded:
            source.model = self._recorded.recorded
        if self._copy is not None:
            self._copy.close()


def _policy_alone(settings: SearchSettings) -> BeamSettings:
    """Settings that evaluate the policy's own action as a search evaluates its candidates."""
    return BeamSettings(
        beam_width=1,
        rollout_depth=settings.rollout_depth,
        n_simulations=settings.n_simulations,
        beam_noise=settings.beam_noise,
        # Only Algorithm 1 has noise in what follows a candidate.
        rollout_noise=settings.effective_rollout_noise if isinstance(settings, BeamSettings) else 0.0,
        noise_clip=settings.noise_clip,
        include_policy_action=True,
        noise_hold=settings.noise_hold,
        forward_model=settings.forward_model,
        n_threads=settings.n_threads,
    )
