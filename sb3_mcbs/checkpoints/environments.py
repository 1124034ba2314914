"""One environment's whole state as data. These functions run where the environment lives."""

import functools
import random
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.monitor import Monitor

from sb3_mcbs.checkpoints.encoding import Decoder, Encoded, Encoder, register_state
from sb3_mcbs.checkpoints.errors import CheckpointError
from sb3_mcbs.checkpoints.files import file_of, read_written, write_again
from sb3_mcbs.checkpoints.names import known_names
from sb3_mcbs.snapshot import Snapshot, SnapshotEnvWrapper, SnapshotError
from sb3_mcbs.snapshot.layers import CapturedLayer
from sb3_mcbs.snapshot.mujoco import DataState, ModelState
from sb3_mcbs.snapshot.replay import RecordedEpisode

_Generators = dict[str, Any]


def read_generators() -> _Generators:
    """Return the states of this process's global generators: Python's, NumPy's, PyTorch's."""
    states: _Generators = {
        "python": random.getstate(),
        "numpy": np.random.get_state(legacy=False),
        "torch": th.get_rng_state().numpy(),
    }
    if th.cuda.is_available() and th.cuda.is_initialized():
        states["cuda"] = [state.cpu().numpy() for state in th.cuda.get_rng_state_all()]
    return states


def set_generators(states: _Generators) -> None:
    """Put this process's global generators into states.

    :param states: from :func:`read_generators`.
    """
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    th.set_rng_state(th.from_numpy(states["torch"]))
    if "cuda" in states:
        th.cuda.set_rng_state_all([th.from_numpy(state) for state in states["cuda"]])


def capture_environment(
    wrapper: SnapshotEnvWrapper, with_generators: bool, encoder: Encoder | None = None
) -> Encoded:
    """Read an environment's state.

    :param wrapper: the environment.
    :param with_generators: whether the process's global generators belong to it, as in a worker.
    :param encoder: a new one, if the names of the classes that the environment uses are wanted.
    :raises SnapshotUnsupportedError: if part of it cannot be captured.
    :raises CheckpointError: if part of it cannot be written as data.
    """
    snapshot, encoder = wrapper.snapshot(), encoder or Encoder()
    content = {
        "layers": [tuple(layer) for layer in snapshot.layers],
        "spaces": snapshot.spaces,
        "last_observation": snapshot.last_observation,
        "monitors": [(monitor.t_start, read_written(file_of(monitor))) for monitor in monitors_of(wrapper)],
        "generators": read_generators() if with_generators else None,
    }
    data = {"nodes": encoder.encode_nodes(snapshot.nodes), "content": encoder.encode(content)}
    return Encoded(data, encoder.arrays)


def restore_environment(
    wrapper: SnapshotEnvWrapper, encoded: Encoded, classes: tuple[Any, ...]
) -> list[np.ndarray | None]:
    """Put an environment into a state, all but the files of its Monitors.

    :param wrapper: the environment, made the same way.
    :param encoded: from :func:`capture_environment`.
    :param classes: classes and functions that the checkpoint may refer to, besides those that the
        environment uses.
    :return: what :func:`write_monitor_files` is to write.
    :raises CheckpointError: if the state is of another environment.
    """
    if wrapper.last_observation is None:
        wrapper.reset()  # what an environment makes in its first reset tells more of the classes it uses
    used_here = Encoder()
    capture_environment(wrapper, False, used_here)
    decoder = Decoder(encoded.arrays, {**known_names(classes), **used_here.names})
    nodes = decoder.decode_nodes(encoded.json["nodes"])
    content = decoder.decode(encoded.json["content"])
    layers = tuple(CapturedLayer(*layer) for layer in content["layers"])
    try:
        wrapper.restore(Snapshot(layers, nodes, content["spaces"], content["last_observation"]))
    except SnapshotError as error:
        raise CheckpointError(
            f"The environment is not made as the one of the checkpoint: {error} Pass an env that is."
        ) from error
    for monitor, (t_start, _) in zip(monitors_of(wrapper), content["monitors"], strict=False):
        monitor.t_start = t_start
    if content["generators"] is not None:
        set_generators(content["generators"])
    return [written for _, written in content["monitors"]]


def write_monitor_files(wrapper: SnapshotEnvWrapper, contents: list[np.ndarray | None]) -> None:
    """Make the files of an environment's Monitors hold what they held.

    :param wrapper: the environment.
    :param contents: from :func:`restore_environment`.
    """
    for monitor, written in zip(monitors_of(wrapper), contents, strict=False):
        write_again(file_of(monitor), written)


def monitors_of(env: gym.Env) -> Iterator[Monitor]:
    """Find the Monitors around an environment, outermost first.

    :param env: the environment.
    """
    while isinstance(env, gym.Wrapper):
        if isinstance(env, Monitor):
            yield env
        env = env.env


def _with_state(cls: Any, state: dict[str, Any]) -> Any:
    made = cls.__new__(cls)
    if hasattr(made, "__setstate__"):
        made.__setstate__(state)
    else:
        vars(made).update(state)
    return made


register_state(RecordedEpisode, tuple, lambda data: RecordedEpisode(*data))
for cls in (DataState, ModelState):
    register_state(cls, cls.__getstate__, functools.partial(_with_state, cls))
