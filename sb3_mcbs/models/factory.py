"""Choosing a forward model for given environments."""

import logging

from sb3_mcbs.models.environments import Environments
from sb3_mcbs.models.mujoco_batch import MujocoBatchModel, NotRecognizedError
from sb3_mcbs.models.pool import EnvPoolModel
from sb3_mcbs.types import BACKENDS, ForwardModelError

logger = logging.getLogger("sb3_mcbs")


def make_forward_model(
    environments: Environments, kind: str = "auto", n_threads: int = 0
) -> MujocoBatchModel | EnvPoolModel:
    """Make the forward model that simulates these environments.

    :param environments: the real environments.
    :param kind: "mujoco" for :class:`MujocoBatchModel`, "pool" for :class:`EnvPoolModel`, "auto"
        for the first where it can simulate the environments exactly, otherwise the second.
    :param n_threads: simulation threads of the batch model; 0 takes one per processor that this
        process may use.
    :return: the model; its ``description`` says which it is, and why it is the pool.
    :raises ForwardModelError: with "mujoco", if it cannot simulate these environments.
    :raises ValueError: for another kind, ``"ensemble"`` among them.
    """
    if kind not in BACKENDS:
        raise ValueError(f"unknown forward model {kind!r}; choose one of {', '.join(map(repr, BACKENDS))}")
    level, reason = logging.INFO, ""
    if kind == "ensemble":
        raise ValueError(
            "An ensemble is learned by an agent, not made from environments: train one with "
            "forward_model='ensemble', or fit an Ensemble and give it to EnsembleModel."
        )
    if kind != "pool":
        try:
            batch = MujocoBatchModel(environments, n_threads)
        except ForwardModelError as error:
            if kind == "mujoco":
                raise
            # A known environment that has to take the slow way is worth a user's attention.
            if not isinstance(error, NotRecognizedError) or error.notable:
                level = logging.WARNING
            reason = str(error)
        else:
            logger.info("look-ahead: %s", batch.description)
            return batch
    pool = EnvPoolModel(environments)
    if reason:
        pool.description += f", because the batch cannot: {reason}"
    logger.log(level, "look-ahead: %s", pool.description)
    return pool
