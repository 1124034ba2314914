"""The strategies with loops, one simulation at a time: the oracles for the batched ones.

All use a :class:`~tests.reference_search.Reference` as the simulator of one environment: its ``restore``,
``env_step``, ``policy``, ``critics`` and ``gamma``. Every simulation starts at the root again and repeats its
actions. A step whose reward is NaN has diverged. Random numbers are handed in.

All noise of a decision (with ``time_budget``: of a round) is drawn from the search's generator before the
simulation, as float32, in this order:

- beam: candidates ``[n_envs, proposals, act_dim]``, later actions ``[D, n_envs, B, n_simulations, act_dim]``;
- tree: root actions ``[n_envs, 1, proposals, act_dim]``, later actions
  ``[D - 1, n_envs, B, proposals / B, act_dim]``;
- cem: ``[R, n_envs, proposals, D, act_dim]``.

``proposals`` is ``n_proposals``, or else the number that is simulated: ``B``, for a tree ``B * K``.
``antithetic`` draws half of a paired axis.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from tests.reference_search import Reference, clip


@dataclass
class Outcome:
    """What a reference found.

    :ivar action: the action to execute, None if nothing was valid.
    :ivar values: by candidate, the value with which it was left.
    :ivar steps: simulated steps.
    """

    action: np.ndarray | None = None
    candidates: list[np.ndarray] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    steps: int = 0
    surviving_roots: int = 0
    plan: np.ndarray | None = None


def principal_directions(actions: np.ndarray, number: int) -> np.ndarray:
    """``[number, act_dim]``, in which actions ``[n, act_dim]`` vary most around their mean."""
    deviations = np.array(actions, dtype=np.float64) - np.mean(actions, axis=0, dtype=np.float64)
    return np.linalg.svd(deviations)[2][:number]


def along(coordinates, directions) -> np.ndarray:
    """Walk some way along each direction; the other coordinates are not used."""
    total = np.zeros(len(directions[0]))
    for coordinate, direction in zip(coordinates[: len(directions)], directions, strict=True):
        total += float(coordinate) * direction
    return total


def low_dimensional(noise: np.ndarray, directions) -> np.ndarray:
    """Noise ``[n, act_dim]`` along the directions alone, with the total variance that it had in all."""
    widen = math.sqrt(len(directions[0]) / len(directions))
    return np.array([widen * along(one, directions) for one in noise])


class ReferenceBeam:
    """Algorithm 1 with noise that is held for several steps, in one environment.

    :param reference: the simulator and the agent
    :param depth: macro-steps
    :param hold: environment steps of each
    :param include_policy_action: whether the first candidate is the policy's own action
    """

    def __init__(self, reference: Reference, depth: int, hold: int, include_policy_action: bool) -> None:
        self.reference, self.depth, self.hold = reference, depth, hold
        self.include_policy_action = include_policy_action
        self.outcome = Outcome()

    def choose(self, observation, beam_noise, rollout_noise, shared: bool) -> Outcome:
        """
        :param observation: the present one
        :param beam_noise: ``[beam, act_dim]``
        :param rollout_noise: ``[depth, beam, sim, act_dim]``
        :param shared: whether simulations of a candidate count as one until their noise differs
        """
        n_simulations = rollout_noise.shape[2]
        for i, noise in enumerate(beam_noise):
            if self.include_policy_action and i == 0:
                noise = np.zeros_like(noise)
            action = clip(self.reference.policy(observation) + noise)
            self.outcome.candidates.append(action)
            values = []
            for j in range(n_simulations):
                offsets = [noise, *rollout_noise[:, i, j]]
                value, steps = self.rollout(action, offsets)
                values.append(value)
                self.outcome.steps += max(0, steps - self.hold) if shared and j > 0 else steps
            mean = sum(values) / n_simulations
            self.outcome.values.append(mean if math.isfinite(mean) else -math.inf)
        if max(self.outcome.values) > -math.inf:
            best = self.outcome.values.index(max(self.outcome.values))
            self.outcome.action = self.outcome.candidates[best]
        return self.outcome

    def rollout(self, action, offsets: list) -> tuple[float, int]:
        """
        :param offsets: the noise of every macro-step, and of the action that closes the rollout
        :return: the value and the simulated steps
        """
        reference, total, steps = self.reference, 0.0, 0
        reference.restore()
        for macro_step in range(self.depth):
            for _ in range(self.hold):
                if steps > 0:
                    action = clip(reference.policy(observation) + offsets[macro_step])  # noqa: F821
                observation, reward, done = reference.env_step(action)
                total += reference.gamma**steps * float(reward)
                steps += 1
                if done or math.isnan(total):
                    return total, steps
        action = clip(reference.policy(observation) + offsets[self.depth])
        return total + reference.gamma**steps * min(reference.critics(observation, action)), steps


@dataclass
class Node:
    actions: list[np.ndarray]
    root: int
    rewards: float
    observation: np.ndarray
    done: bool
    score: float


def shortlist(reference: Reference, observation, actions: list, keep: int, always: int) -> list[int]:
    """Places of the actions that the critics value most, and of the first ``always`` ones."""
    by_value = sorted(
        range(len(actions)),
        key=lambda i: -math.inf if i < always else -min(reference.critics(observation, actions[i])),
    )
    return sorted(by_value[:keep])


class ReferenceTree:
    """Partial tree expansion in one environment.

    :param reference: the simulator and the agent
    :param width: nodes that are kept at every depth
    :param branching: children of each
    :param include_policy_action: whether the first child's action is the policy's own
    :param hold: environment steps between two depths, with the same noise
    """

    def __init__(
        self,
        reference: Reference,
        width: int,
        branching: int,
        include_policy_action: bool = False,
        hold: int = 1,
    ) -> None:
        self.reference, self.width, self.branching = reference, width, branching
        self.include_policy_action, self.hold = include_policy_action, hold
        self.outcome = Outcome()

    def choose(self, observation, root_noise: np.ndarray, later_noise: np.ndarray) -> Outcome:
        """
        :param observation: the present one
        :param root_noise: ``[proposals, act_dim]``
        :param later_noise: ``[depth - 1, width, proposals / width, act_dim]``
        """
        n_roots = self.width * self.branching
        ranking = []
        for root, (action, noise) in enumerate(self.children(observation, root_noise, n_roots)):
            self.outcome.candidates.append(action)
            self.outcome.values.append(-math.inf)
            ranking += self.simulate([action], noise, root)
        kept = self.keep(ranking)
        for noise in later_noise:
            ranking = []
            for slot, node in enumerate(kept):
                if not node.done:
                    for action, held in self.children(node.observation, noise[slot], self.branching):
                        ranking += self.simulate([*node.actions, action], held, node.root)
            ranking += [node for node in kept if node.done]
            kept = self.keep(ranking)
        if kept:
            leaf = max(kept, key=lambda node: (node.score, -node.root))
            self.outcome.action = leaf.actions[0]
        self.outcome.surviving_roots = len({node.root for node in kept})
        return self.outcome

    def children(self, observation, noise: np.ndarray, number: int) -> list[tuple]:
        mean = self.reference.policy(observation)
        offsets = list(noise)
        if self.include_policy_action:
            offsets[0] = np.zeros_like(offsets[0])
        actions = [clip(mean + one) for one in offsets]
        always = int(self.include_policy_action)
        kept = shortlist(self.reference, observation, actions, number, always)
        return [(actions[i], offsets[i]) for i in kept]

    def simulate(self, actions: list[np.ndarray], noise: np.ndarray, root: int) -> list[Node]:
        """The node after some actions and what follows the last, in a list that is empty if it diverged."""
        reference, gamma = self.reference, self.reference.gamma
        reference.restore()
        total, n_new = 0.0, 0
        actions = list(actions)
        for depth, action in enumerate(actions):
            observation, reward, done = reference.env_step(action)
            total += gamma**depth * float(reward)
            # The last macro-step alone is new, the others are repetitions.
            n_new += n_new > 0 or depth == len(actions) - 1
            if 0 < n_new < self.hold and not done and not math.isnan(total):
                actions.append(clip(reference.policy(observation) + noise))
        self.outcome.steps += n_new
        if math.isnan(total):
            return []
        score = total
        if not done:
            score += gamma ** len(actions) * min(
                reference.critics(observation, reference.policy(observation))
            )
        return [Node(actions, root, total, observation, done, score)]

    def keep(self, ranking: list[Node]) -> list[Node]:
        for root in {node.root for node in ranking}:
            self.outcome.values[root] = max(node.score for node in ranking if node.root == root)
        places = sorted(range(len(ranking)), key=lambda i: -ranking[i].score)
        return [ranking[place] for place in sorted(places[: self.width])]


class ReferenceCEM:
    """The cross-entropy method in one environment.

    :param reference: the simulator and the agent
    :param width: plans per round
    :param n_elites: best plans that the next round is drawn around
    :param spreads: ``[depth]``, standard deviations of the first round
    :param min_noise: their floor in later rounds
    :param include_policy_action: whether the policy alone is a plan of the first round
    :param hold: environment steps for which each offset of a plan stays
    :param directions: ``[dims, act_dim]``, along which plans differ; the noise has those coordinates
    :param clip_at: what no entry of a plan exceeds
    """

    def __init__(
        self,
        reference: Reference,
        width: int,
        n_elites: int,
        spreads: list[float],
        min_noise: float,
        include_policy_action: bool = False,
        hold: int = 1,
        directions: np.ndarray | None = None,
        clip_at: float = math.inf,
    ) -> None:
        self.hold, self.directions, self.clip_at = hold, directions, clip_at
        self.reference, self.width, self.n_elites = reference, width, n_elites
        self.spreads, self.min_noise = spreads, min_noise
        self.include_policy_action = include_policy_action

    def choose(self, observation, noise: np.ndarray, remembered: np.ndarray) -> Outcome:
        """
        :param observation: the present one
        :param noise: ``[rounds, proposals, depth, act_dim]``
        :param remembered: ``[depth, act_dim]``, the plan to start around
        """
        outcome = Outcome()
        mean = np.asarray(remembered, dtype=np.float32)
        directions = np.eye(mean.shape[1]) if self.directions is None else self.directions
        dims = len(directions)
        widen = math.sqrt(mean.shape[1] / dims)
        spread = widen * np.repeat(np.float32(self.spreads)[:, None], dims, axis=1)
        plans: list[np.ndarray] = []
        for number, of_round in enumerate(noise):
            drawn = [
                np.float32(mean + [along(z[:dims] * s, directions) for z, s in zip(one, spread, strict=True)])
                for one in of_round
            ]
            drawn = [np.clip(plan, -self.clip_at, self.clip_at) for plan in drawn]
            drawn[0] = mean
            if number == 0 and self.include_policy_action and mean.any():
                drawn[1] = np.zeros_like(mean)
            first = [clip(self.reference.policy(observation) + plan[0]) for plan in drawn]
            always = 1 + (number == 0 and self.include_policy_action)
            for i in shortlist(self.reference, observation, first, self.width, always):
                plans.append(drawn[i])
                outcome.candidates.append(first[i])
                outcome.values.append(self.value(observation, drawn[i], outcome))
            ranked = sorted(range(len(plans)), key=lambda i: -outcome.values[i])[: self.n_elites]
            elites = [plans[i] for i in ranked if outcome.values[i] > -math.inf]
            if elites:
                mean = np.mean(elites, axis=0)
                floor = np.float32([[widen * min(self.min_noise, of_first)] for of_first in self.spreads])
                spread = np.maximum(np.std(np.array(elites) @ directions.T, axis=0), floor)
        if max(outcome.values) > -math.inf:
            chosen = outcome.values.index(max(outcome.values))
            outcome.action, outcome.plan = outcome.candidates[chosen], plans[chosen]
        return outcome

    def value(self, observation, plan: np.ndarray, outcome: Outcome) -> float:
        reference = self.reference
        reference.restore()
        total, discount = 0.0, 1.0
        for residual in np.repeat(plan, self.hold, axis=0):
            action = clip(reference.policy(observation) + residual)
            observation, reward, done = reference.env_step(action)
            outcome.steps += 1
            total += discount * float(reward)
            discount *= reference.gamma
            if math.isnan(total):
                return -math.inf
            if done:
                return total
        return total + discount * min(reference.critics(observation, reference.policy(observation)))
