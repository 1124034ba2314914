"""One environment's whole state as data. These functions run where the environment lives."""

import random
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.monitor import Monitor

from sb3_mcbs.checkpoints.encoding import Decoder, Encoded, Encoder, register_state
from sb3_mcbs.checkpoints.errors import CheckpointError
from sb3_mcbs.checkpoints.files import read_written, results_file, write_again
from sb3_mcbs.checkpoints.names import known_names
from sb3_mcbs.snapshot import Snapshot, SnapshotEnvWrapper, SnapshotError
from sb3_mcbs.snapshot.layers import CapturedLayer
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


def capture_environment(wrapper: SnapshotEnvWrapper, with_generators: bool) -> Encoded:
    """Read an environment's state.

    :param wrapper: the environment.
    :param with_generators: whether the process's global generators belong to it, as in a worker.
    :raises SnapshotUnsupportedError: if part of it cannot be captured.
    :raises CheckpointError: if part of it cannot be written as data.
    """
    return _encode(wrapper, with_generators)[1]


def _encode(wrapper: SnapshotEnvWrapper, with_generators: bool) -> tuple[Encoder, Encoded]:
    snapshot, encoder = wrapper.snapshot(), Encoder()
    content = {
        "layers": [tuple(layer) for layer in snapshot.layers],
        "spaces": snapshot.spaces,
        "last_observation": snapshot.last_observation,
        "monitors": [(monitor.t_start, _written(monitor)) for monitor in _monitors(wrapper)],
        "generators": read_generators() if with_generators else None,
    }
    data = {"nodes": encoder.encode_nodes(snapshot.nodes), "content": encoder.encode(content)}
    return encoder, Encoded(data, encoder.arrays)


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
    names = {**known_names(classes), **_encode(wrapper, False)[0].names}
    decoder = Decoder(encoded.arrays, names)
    nodes = decoder.decode_nodes(encoded.json["nodes"])
    content = decoder.decode(encoded.json["content"])
    layers = tuple(CapturedLayer(*layer) for layer in content["layers"])
    try:
        wrapper.restore(Snapshot(layers, nodes, content["spaces"], content["last_observation"]))
    except SnapshotError as error:
        raise CheckpointError(
            f"The environment is not made as the one of the checkpoint: {error} Pass an env that is."
        ) from error
    for monitor, (t_start, _) in zip(_monitors(wrapper), content["monitors"], strict=False):
        monitor.t_start = t_start
    if content["generators"] is not None:
        set_generators(content["generators"])
    return [written for _, written in content["monitors"]]


def write_monitor_files(wrapper: SnapshotEnvWrapper, contents: list[np.ndarray | None]) -> None:
    """Make the files of an environment's Monitors hold what they held.

    :param wrapper: the environment.
    :param contents: from :func:`restore_environment`.
    """
    for monitor, written in zip(_monitors(wrapper), contents, strict=False):
        file = results_file(monitor)
        if file is not None and written is not None:
            write_again(file, written)


def _monitors(env: gym.Env) -> Iterator[Monitor]:
    while isinstance(env, gym.Wrapper):
        if isinstance(env, Monitor):
            yield env
        env = env.env


def _written(monitor: Monitor) -> np.ndarray | None:
    file = results_file(monitor)
    return None if file is None else read_written(file)


def describe_environment(wrapper: SnapshotEnvWrapper) -> dict[str, Any] | None:
    """Say how to make an environment like this one, if its id and arguments are all that it takes.

    :param wrapper: the environment.
    :return: id, arguments and its Monitor's; None if it takes more.
    """
    spec, monitors = wrapper.spec, list(_monitors(wrapper))
    if spec is None or len(monitors) > 1:
        return None
    # Wrappers that Gymnasium adds by itself are not among these.
    own = [f"{cls.__module__}:{cls.__name__}" for cls in (Monitor, SnapshotEnvWrapper)]
    if any(wrapper_spec.entry_point not in own for wrapper_spec in spec.additional_wrappers):
        return None
    arguments = {key: value for key, value in spec.kwargs.items() if key != "render_mode"}
    description: dict[str, Any] = {
        "id": spec.id,
        "arguments": arguments,
        "max_episode_steps": spec.max_episode_steps,
        "verify": wrapper.verifies,
        "monitor": None,
    }
    if monitors:
        file = results_file(monitors[0])
        description["monitor"] = {
            "filename": None if file is None else file.name,
            "allow_early_resets": monitors[0].allow_early_resets,
            "reset_keywords": list(monitors[0].reset_keywords),
            "info_keywords": list(monitors[0].info_keywords),
        }
    return description if _is_json(arguments) else None


def _is_json(value: Any) -> bool:
    if isinstance(value, dict):
        return all(type(key) is str and _is_json(item) for key, item in value.items())
    if isinstance(value, list):
        return all(_is_json(item) for item in value)
    return value is None or type(value) in (bool, int, float, str)


def make_environment(description: dict[str, Any]) -> SnapshotEnvWrapper:
    """Make an environment that :func:`describe_environment` described.

    :param description: its id is looked up among the environments that are registered here.
    """
    limit = description["max_episode_steps"]
    registered = gym.spec(description["id"]).max_episode_steps
    arguments = dict(description["arguments"])
    if limit != registered:
        arguments["max_episode_steps"] = -1 if limit is None else limit
    env = gym.make(description["id"], **arguments)
    if description["monitor"] is not None:
        monitor = description["monitor"]
        env = Monitor(
            env,
            monitor["filename"],
            allow_early_resets=monitor["allow_early_resets"],
            reset_keywords=tuple(monitor["reset_keywords"]),
            info_keywords=tuple(monitor["info_keywords"]),
            override_existing=False,  # emptied only when the run goes on
        )
    return SnapshotEnvWrapper(env, verify=description.get("verify", True))


register_state(RecordedEpisode, tuple, lambda data: RecordedEpisode(*data))
try:
    from sb3_mcbs.snapshot.mujoco import DataState, ModelState
except ImportError:  # MuJoCo is an optional part of Gymnasium
    pass
else:

    def _data_state(data: dict[str, Any]) -> DataState:
        state = DataState.__new__(DataState)
        state.__setstate__(data)
        return state

    def _model_state(data: dict[str, Any]) -> ModelState:
        state = ModelState.__new__(ModelState)
        vars(state).update(data)
        return state

    register_state(DataState, DataState.__getstate__, _data_state)
    register_state(ModelState, lambda state: dict(vars(state)), _model_state)
