"""Applies the wrappers of a vectorized environment to simulated observations and rewards.

A forward model simulates the environments themselves, while the networks see observations through the
``VecEnv`` wrappers around them. A search applies the same wrappers without changing their statistics.
"""

import warnings
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnv,
    VecExtractDictObs,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
    VecVideoRecorder,
    unwrap_vec_normalize,
)
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

from sb3_mcbs.agents.faults import check_whole
from sb3_mcbs.models import Environments, LocalEnvironments, WorkerEnvironments
from sb3_mcbs.snapshot import SnapshotEnvWrapper
from sb3_mcbs.types import Observations

_TRANSPARENT = (VecCheckNan, VecMonitor, VecVideoRecorder)
_PURE = (VecNormalize, VecTransposeImage, VecExtractDictObs)


class ObservationPipeline:
    """Converts observations and rewards from the replay buffer's form to that of the networks.

    Only ``VecNormalize`` lies between the two, whatever other wrappers there are.

    :param vec_env: the environment that the agent acts in.
    :param reward_normalizer: the ``VecNormalize`` whose reward scale the critics learned, if any.
    :raises ValueError: see :func:`~sb3_mcbs.agents.faults.check_whole`.
    """

    def __init__(self, vec_env: VecEnv, reward_normalizer: VecNormalize | None) -> None:
        check_whole(vec_env)
        self.vec_env = vec_env
        self.reward_normalizer = reward_normalizer

    def observe(self, observations: Observations, normalize: bool = True) -> Observations:
        """Turn observations of the replay buffer into those of the networks.

        :param observations: ``[rows, *obs_shape]`` as stored in replay buffers.
        :param normalize: False leaves them unchanged.
        :return: ``[rows, *]`` as the networks expect them.
        """
        normalizer = unwrap_vec_normalize(self.vec_env)
        return observations if normalizer is None or not normalize else normalizer.normalize_obs(observations)

    def original(self, observations: Observations) -> Observations:
        """The last observations of all environments as stored in replay buffers.

        :param observations: the same as the agent got them.
        :return: ``[n_envs, *obs_shape]``.
        :raises ValueError: if these are not the environment's last observations.
        """
        normalizer = unwrap_vec_normalize(self.vec_env)
        if normalizer is None:
            return observations
        original = normalizer.get_original_obs()
        if not np.array_equal(normalizer.normalize_obs(original), observations):  # type: ignore[arg-type]
            raise ValueError(
                "The observations to act on are not those that the environment's VecNormalize gave last. Act "
                "in the environment that the search was given."
            )
        return original

    def unnormalize(self, observation: np.ndarray) -> np.ndarray:
        """Undo the normalisation of an episode's last observation, as SB3 does.

        :param observation: ``[*obs_shape]``.
        """
        normalizer = unwrap_vec_normalize(self.vec_env)
        return observation if normalizer is None else normalizer.unnormalize_obs(observation)  # type: ignore[return-value]

    def scale_reward(self, rewards: np.ndarray) -> np.ndarray:
        """Scale rewards as in the critics' training.

        :param rewards: ``[rows]`` as the environments return them.
        :return: ``[rows]``.
        """
        normalizer = self.reward_normalizer
        if normalizer is None:
            return rewards
        scaled = rewards / np.sqrt(normalizer.ret_rms.var + normalizer.epsilon)
        return np.clip(scaled, -normalizer.clip_reward, normalizer.clip_reward)


class EnvironmentPipeline(ObservationPipeline):
    """Converts the environments' own observations, which other wrappers may alter too.

    :param vec_env: the environment that the agent acts in.
    :param reward_normalizer: the ``VecNormalize`` whose reward scale the critics learned, if any.
    :raises ValueError: if an unknown wrapper may alter observations or actions.
    """

    def __init__(self, vec_env: VecEnv, reward_normalizer: VecNormalize | None) -> None:
        super().__init__(vec_env, reward_normalizer)
        self.layers: list[VecEnvWrapper] = []
        while isinstance(vec_env, VecEnvWrapper):
            if type(vec_env) in _PURE:
                self.layers.insert(0, vec_env)
            elif type(vec_env) not in _TRANSPARENT:
                known = ", ".join(cls.__name__ for cls in _PURE + _TRANSPARENT)
                raise ValueError(
                    f"Look-ahead cannot see through the vectorized wrapper {type(vec_env).__name__}: it may "
                    f"alter observations, actions or rewards. Known are {known}. Use a Gymnasium wrapper "
                    "inside the environment instead (as FrameStackObservation for VecFrameStack), or "
                    "rollout_depth=0."
                )
            vec_env = vec_env.venv
        self.base: VecEnv = vec_env

    def buffered_observation(self, index: int) -> Any:
        """The last observation of an environment in this process, even if it was wrapped later.

        :param index: the environment's index.
        :return: its observation, or ``None`` for environments in other processes.
        """
        if not isinstance(self.base, DummyVecEnv):
            return None
        rows: dict[Any, np.ndarray] = {key: values[index].copy() for key, values in self.base.buf_obs.items()}
        return rows.get(None, rows)

    def observe(self, observations: Observations, normalize: bool = True) -> Observations:
        """Pass observations of the environments through the wrappers.

        :param observations: ``[rows, *obs_shape]`` as the environments return them.
        :param normalize: False leaves ``VecNormalize`` out, as in replay buffers.
        :return: ``[rows, *]`` as the networks expect them.
        """
        if isinstance(self.base, DummyVecEnv):  # it copies them into its own arrays; workers send them
            observations = _as_space_dtype(observations, self.base.observation_space)
        return self._through_layers(observations, normalize)

    def observe_last(self, observations: Observations) -> Observations:
        """Pass the last observations of episodes through the wrappers, as ``infos`` have them.

        :param observations: ``[rows, *obs_shape]`` as the environments return them.
        :return: ``[rows, *]`` as stored in replay buffers.
        """
        return self.as_kept(self._through_layers(observations, normalize=True))

    def as_kept(self, observations: Any) -> Observations:
        """Round observations as replay buffers do.

        :param observations: ``[rows, *]`` as the networks expect them, or one of them.
        """
        return _as_space_dtype(observations, self.vec_env.observation_space)

    def _through_layers(self, observations: Observations, normalize: bool) -> Observations:
        for layer in self.layers:
            if isinstance(layer, VecNormalize):
                if normalize:
                    observations = layer.normalize_obs(observations)
            elif isinstance(layer, VecTransposeImage):
                observations = layer.transpose_observations(observations)
            else:
                observations = observations[layer.key]
        return observations


def reward_normalizer(
    training_env: VecEnv | None, vec_env: VecEnv, normalize_reward: bool | None
) -> VecNormalize | None:
    """Find the reward scale that the critics learned.

    :param training_env: the environment that the agent was trained in, if available.
    :param vec_env: the environment that it acts in; for evaluation its ``norm_reward`` is usually off,
        although its statistics contain the scale.
    :param normalize_reward: whether the critics learned from normalised rewards. ``None``: inferred from
        ``training_env``, or else from the statistics of ``vec_env``.
    :return: the layer whose ``ret_rms`` is the scale, or ``None`` if rewards were not normalised.
    :raises ValueError: if rewards were normalised but no statistics can be found.
    """
    trained_with = unwrap_vec_normalize(training_env) if training_env is not None else None
    acts_with = unwrap_vec_normalize(vec_env)
    if normalize_reward is None:
        if training_env is not None and training_env is not vec_env:
            normalize_reward = trained_with is not None and trained_with.norm_reward
        elif acts_with is None or acts_with.norm_reward:
            normalize_reward = acts_with is not None
        else:
            normalize_reward = _has_return_statistics(acts_with)
            if normalize_reward:
                warnings.warn(
                    "The environment's VecNormalize has return statistics but does not normalise rewards "
                    "now. The search assumes that the critics were trained on normalised rewards; pass "
                    "normalize_reward=True or False to say what is true.",
                    stacklevel=3,
                )
    if not normalize_reward:
        return None
    normalizer = trained_with or acts_with
    if normalizer is None:
        raise ValueError(
            "normalize_reward=True needs a VecNormalize around the environment, with its statistics."
        )
    return normalizer


def snapshot_environments(vec_env: VecEnv) -> Environments:
    """Access the environments inside a vectorized one, and wrap them if possible.

    Environments in this process are wrapped in place; those of a ``SubprocVecEnv`` cannot be wrapped
    afterwards.

    :param vec_env: the innermost vectorized environment.
    :return: access to the environments in their processes.
    :raises ValueError: if the environments of worker processes are not wrapped outermost.
    :raises TypeError: if the vectorized environment is of another kind.
    """
    if isinstance(vec_env, DummyVecEnv):
        wrapped = [SnapshotEnvWrapper(env) for env in vec_env.envs]
        vec_env.envs[:] = wrapped
        return LocalEnvironments(wrapped)
    if isinstance(vec_env, SubprocVecEnv):
        return WorkerEnvironments(vec_env)
    raise TypeError(f"Look-ahead needs a DummyVecEnv or a SubprocVecEnv, got {type(vec_env).__name__}.")


def _has_return_statistics(normalizer: VecNormalize) -> bool:
    return float(normalizer.ret_rms.count) >= 1.0


def _as_space_dtype(observations: Any, space: spaces.Space) -> Observations:
    if isinstance(space, spaces.Dict):
        return {
            key: np.asarray(value).astype(space[key].dtype, copy=False) for key, value in observations.items()
        }
    return np.asarray(observations).astype(space.dtype, copy=False)
