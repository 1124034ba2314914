"""Exploration at steps without search."""

import logging

import numpy as np
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_mcbs.networks.functions import STOCHASTIC

logger = logging.getLogger("sb3_mcbs")


def noise_without_search(agent: OffPolicyAlgorithm, noise: float, say: bool = True) -> ActionNoise | None:
    """Make noise for a deterministic actor's steps without search, if it has no ``action_noise``.

    :param agent: an agent that does not search at every step.
    :param noise: standard deviation of Gaussian noise, in the action space scaled to [-1, 1].
    :param say: whether to inform the user.
    :return: ``None`` if the agent needs none.
    """
    if agent.action_noise is not None or isinstance(agent, STOCHASTIC):
        return None
    message = (
        "action_noise is None, and not every decision is searched: where the actor acts, Gaussian noise of "
        f"beam_noise={noise} is added. Pass an action_noise to choose another."
    )
    if say:
        logger.info(message)
        if agent.verbose >= 1:
            print(message)
    shape = agent.action_space.shape or ()
    gaussian = NormalActionNoise(np.zeros(shape), np.full(shape, noise))
    return VectorizedActionNoise(gaussian, agent.n_envs) if agent.n_envs > 1 else gaussian


class DrawnNoise(ActionNoise):
    """Noise that keeps its last sample.

    :param noise: the noise to sample from.

    :ivar last: the last sample.
    """

    def __init__(self, noise: ActionNoise) -> None:
        super().__init__()
        self._noise = noise
        self.last = np.zeros(1)

    def __call__(self) -> np.ndarray:
        self.last = self._noise()
        return self.last
