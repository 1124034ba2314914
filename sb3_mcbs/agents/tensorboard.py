"""What only TensorBoard shows of an agent: hyperparameters beside returns, and a histogram of candidates."""

from typing import Any

import numpy as np
from stable_baselines3.common.logger import HParam, Logger, TensorBoardOutputFormat

from sb3_mcbs.agents.hyperparameters import SETTINGS

#: SB3's own hyperparameters, where an agent has them.
_OF_SB3 = (
    "seed",
    "n_envs",
    "learning_rate",
    "learning_starts",
    "buffer_size",
    "batch_size",
    "tau",
    "gamma",
    "gradient_steps",
    "ent_coef",
)
#: Columns of the HParams tab; TensorBoard fills them with the last values of the run's scalars.
_METRICS = ("rollout/ep_rew_mean", "eval/mean_reward", "eval_actor/mean_reward", "search/simulated_steps")
#: The histogram's name.
CANDIDATES = "search/candidate_values"


def outputs(logger: Logger) -> list[TensorBoardOutputFormat]:
    """Which outputs of a logger are TensorBoard's?

    :param logger: of an agent.
    """
    return [each for each in logger.output_formats if isinstance(each, TensorBoardOutputFormat)]


def write_hyperparameters(agent: Any) -> None:
    """Write the hyperparameters of a training for the HParams tab.

    :param agent: an :class:`~sb3_mcbs.MCBS` agent that is about to learn.
    """
    for output in outputs(agent.logger):
        described = HParam(hyperparameters(agent), dict.fromkeys(_METRICS, 0.0))
        output.write({"hyperparameters": described}, {"hyperparameters": ()})


def hyperparameters(agent: Any) -> dict[str, int | float | str]:
    """All settings of a search and its training that are not ``None``, and the main ones of SB3.

    :param agent: an :class:`~sb3_mcbs.MCBS` agent.
    """
    found: dict[str, Any] = {"algorithm": type(agent).__name__}
    for name in (*SETTINGS, *_OF_SB3):
        value = getattr(agent, name, None)
        found |= value if isinstance(value, dict) else {name: value}
    return {
        # The tab would show True as 1.0000.
        name: value if isinstance(value, int | float) and not isinstance(value, bool) else str(value)
        for name, value in found.items()
        if value is not None
    }


def write_candidates(agent: Any) -> None:
    """Write a histogram of candidates' values, each minus the mean of its decision, and forget them.

    :param agent: an :class:`~sb3_mcbs.MCBS` agent.
    """
    for output in outputs(agent.logger):
        if agent.candidate_values:
            centred = [values - values.mean(axis=1, keepdims=True) for values in agent.candidate_values]
            values = np.concatenate([each.ravel() for each in centred])
            output.write({CANDIDATES: values}, {CANDIDATES: ()}, agent.num_timesteps)
    agent.candidate_values.clear()
