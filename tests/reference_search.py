"""Algorithm 1 of the paper, line by line: the oracle for the batched search.

One environment, loops, the environment's own ``step``. Line numbers in the comments are those of the
paper's listing, counted within each block. Nothing of ``sb3_mcbs.search`` is used except the recorded
noise, so that both can be given the same random numbers.
"""

from collections.abc import Callable

import numpy as np


def clip(action: np.ndarray) -> np.ndarray:
    return np.clip(action, np.float32(-1), np.float32(1))


class Reference:
    """What Algorithm 1 takes as input.

    :param env_step: scaled action ``[act_dim]`` -> (observation, reward, done) of the simulator
    :param restore: puts the simulator back to s_t
    :param policy: observation -> scaled action ``[act_dim]`` (pi_theta)
    :param critics: observation, scaled action -> one float per critic (Q_phi1, Q_phi2)
    :param gamma: discount factor
    """

    def __init__(
        self,
        env_step: Callable[[np.ndarray], tuple],
        restore: Callable[[], None],
        policy: Callable[[np.ndarray], np.ndarray],
        critics: Callable[[np.ndarray, np.ndarray], list[float]],
        gamma: float,
    ) -> None:
        self.env_step, self.restore = env_step, restore
        self.policy, self.critics, self.gamma = policy, critics, gamma

    def choose(
        self, observation, beam_noise: np.ndarray, rollout_noise: np.ndarray
    ) -> tuple[int, np.ndarray, list]:
        """Steps 1 to 3.

        :param observation: s_t
        :param beam_noise: ``[beam, act_dim]``, eta_i
        :param rollout_noise: ``[depth, beam, sim, act_dim]``, eta in ShortHorizon
        :return: the chosen candidate, Q~ ``[beam]`` and the undiscounted rewards of every rollout
        """
        depth, beam_width, n_simulations = rollout_noise.shape[:3]
        # 1) Generate B candidate actions
        candidates = []
        for i in range(beam_width):
            candidates.append(clip(self.policy(observation) + beam_noise[i]))

        # 2) Evaluate candidates via rollouts
        q = np.zeros(beam_width)
        rewards = []
        for i in range(beam_width):
            for j in range(n_simulations):
                value, seen = self.short_horizon(candidates[i], depth, rollout_noise[:, i, j])
                q[i] += value
                rewards.append(seen)
            q[i] /= n_simulations

        # 3) Select best action
        return int(np.argmax(q)), q, rewards

    def short_horizon(self, action: np.ndarray, depth: int, noise: np.ndarray) -> tuple[float, list[float]]:
        total, alpha = 0.0, 1.0
        seen = []
        self.restore()
        for d in range(depth):
            observation, reward, done = self.env_step(action)
            seen.append(float(reward))
            total += alpha * float(reward)
            alpha *= self.gamma
            if done:
                return total, seen
            action = clip(self.policy(observation) + noise[d])
        return total + alpha * min(self.critics(observation, action)), seen
