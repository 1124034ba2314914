"""Choosing a forward model for given environments."""

import logging

from sb3_mcbs.models.environments import Environments
from sb3_mcbs.models.mujoco_batch import MujocoBatchModel
from sb3_mcbs.models.pool import EnvPoolModel
from sb3_mcbs.models.recognition import NotRecognizedError
from sb3_mcbs.types import BACKENDS, ForwardModelError

logger = logging.getLogger("sb3_mcbs")


def make_forward_model(
    environments: Environments, kind: str = "auto", n_threads: int = 0
) -> MujocoBatchModel | EnvPoolModel:
    """Make the forward model that simulates these environments.

    :param environments: the real environments.
    :param kind: "mujoco" for :class:`MujocoBatchModel`, "pool" for :class:`EnvPoolModel`, "auto"
        for the first if it can simulate the environments exactly, otherwise the second.
    :param n_threads: simulation threads of the batch model; 0 uses one per processor that this
        process may use.
    :return: the model; its ``description`` says which it is, and why it is the pool.
    :raises ForwardModelError: with "mujoco", if it cannot simulate these environments.
    :raises ValueError: for another kind, including ``"ensemble"``.
    """
    if kind == "ensemble":
        raise ValueError(
            "An ensemble is learned by an agent, not made from environments: train one with "
            "forward_model='ensemble', or fit an Ensemble and give it to EnsembleModel."
        )
    if kind not in BACKENDS:
        raise ValueError(f"unknown forward model {kind!r}; choose one of {', '.join(map(repr, BACKENDS))}")
    level, why_not_faster = logging.INFO, ""
    if kind != "pool":
        try:
            batch = MujocoBatchModel(environments, n_threads)
            logger.info("look-ahead: %s", batch.description)
            return batch
        except ForwardModelError as error:
            if kind == "mujoco":
                raise
            # The pool is much slower, so a user should know that a familiar environment needs it.
            if not isinstance(error, NotRecognizedError) or error.notable:
                level = logging.WARNING
            why_not_faster = str(error)
    pool = EnvPoolModel(environments)
    if why_not_faster:
        pool.why_not_faster = why_not_faster
        pool.description += f", because the batch cannot: {why_not_faster}"
    logger.log(level, "look-ahead: %s", pool.description)
    return pool
