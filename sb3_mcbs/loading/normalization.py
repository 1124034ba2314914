"""Statistics of ``VecNormalize`` in a file of numbers instead of SB3's pickle."""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_mcbs.loading.archive import AgentFileError, about, read_members, reading

MAX_ARRAY_BYTES = 2**26

_FLAGS = ("norm_obs", "norm_reward")
_SETTINGS = ("clip_obs", "clip_reward", "gamma", "epsilon")
_STATISTICS = ("mean", "var", "count")


def save_statistics(vec_normalize: VecNormalize, path: str | Path) -> None:
    """
    Write the statistics and settings of a ``VecNormalize`` as npz.

    :param vec_normalize: the wrapper; its observations must be a Box if it normalises them
    :param path: the file to write
    :raises TypeError: if it is not a ``VecNormalize``, or normalises Dict observations
    """
    if not isinstance(vec_normalize, VecNormalize):
        raise TypeError(f"Expected a VecNormalize, got a {type(vec_normalize).__name__}.")
    arrays = {name: np.asarray(getattr(vec_normalize, name)) for name in (*_FLAGS, *_SETTINGS)}
    arrays |= {f"ret_{name}": np.asarray(getattr(vec_normalize.ret_rms, name)) for name in _STATISTICS}
    if vec_normalize.norm_obs:
        if not isinstance(vec_normalize.obs_rms, RunningMeanStd):
            raise TypeError("Statistics of Dict observations cannot be written; only those of a Box.")
        arrays |= {f"obs_{name}": np.asarray(getattr(vec_normalize.obs_rms, name)) for name in _STATISTICS}
    # ``np.savez`` would append .npz to a name without it.
    with Path(path).open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]


def load_statistics(path: str | Path, venv: VecEnv, training: bool = False) -> VecNormalize:
    """
    Normalise an environment with statistics that :func:`save_statistics` wrote. Nothing is unpickled.

    :param path: the npz file
    :param venv: the environment to wrap
    :param training: whether the statistics are updated further; SB3 does so after loading, the default here
        is not to
    :return: the normalised environment
    :raises FileNotFoundError: if there is no such file
    :raises AgentFileError: if the file is damaged, has other arrays than it should, or values out of range
    """
    path = Path(path)
    statistics = [f"{kind}_{name}" for kind in ("ret", "obs") for name in _STATISTICS]
    names = [*_FLAGS, *_SETTINGS, *statistics]
    with about(path):
        contents, _ = read_members(path, {f"{name}.npy": MAX_ARRAY_BYTES for name in names})
        arrays = {name.removesuffix(".npy"): _read_array(name, text) for name, text in contents.items()}
        settings: dict[str, Any] = {name: bool(_array(arrays, name, "b", ())) for name in _FLAGS}
        settings |= {name: _setting(arrays, name) for name in _SETTINGS}
        space = venv.observation_space
        if settings["norm_obs"] and not isinstance(space, spaces.Box):
            raise AgentFileError(f"the statistics are for observations that are a Box, not {space}.")
        returns = _statistics(arrays, "ret", ())
        observations = _statistics(arrays, "obs", space.shape or ()) if settings["norm_obs"] else None
    normalizer = VecNormalize(venv, training=training, **settings)
    normalizer.ret_rms = returns
    if observations is not None:
        normalizer.obs_rms = observations  # type: ignore[assignment]
    return normalizer


def _read_array(name: str, content: bytes) -> np.ndarray:
    with reading(repr(name)):
        return np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)


def _array(arrays: dict[str, np.ndarray], name: str, kinds: str, shape: tuple[int, ...]) -> np.ndarray:
    if name not in arrays:
        raise AgentFileError(f"the file has no array {name!r}; write it with save_statistics.")
    array = arrays[name]
    if array.dtype.kind not in kinds or array.shape != shape:
        raise AgentFileError(
            f"{name} must have the shape {shape}, as the environment needs it, and real values; got "
            f"{array.shape} and {array.dtype}."
        )
    return array


def _setting(arrays: dict[str, np.ndarray], name: str) -> float:
    value = float(_array(arrays, name, "fiu", ()))
    high = 1.0 if name == "gamma" else math.inf
    # A clip may be infinite: nothing is clipped.
    if not 0 < value <= high or (name == "epsilon" and math.isinf(value)):
        raise AgentFileError(f"{name} must be above 0 and at most {high}, got {value}.")
    return value


def _statistics(arrays: dict[str, np.ndarray], kind: str, shape: tuple[int, ...]) -> RunningMeanStd:
    statistics = RunningMeanStd(shape=shape)
    statistics.mean = _array(arrays, f"{kind}_mean", "f", shape).astype(np.float64)
    statistics.var = _array(arrays, f"{kind}_var", "f", shape).astype(np.float64)
    statistics.count = float(_array(arrays, f"{kind}_count", "fiu", ()))
    if not (np.isfinite(statistics.mean).all() and np.isfinite(statistics.var).all()):
        raise AgentFileError(f"the statistics {kind}_mean and {kind}_var must be finite.")
    if not ((statistics.var > 0).all() and 0 < statistics.count < math.inf):
        raise AgentFileError(f"{kind}_var and {kind}_count must be above 0.")
    return statistics
