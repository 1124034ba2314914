"""How an agent and its environments were made, as data, and how to make them again."""

import functools
import inspect
import platform
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.monitor import Monitor, ResultsWriter
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
)

from sb3_mcbs.agents.hyperparameters import REMOVED
from sb3_mcbs.agents.observation_pipeline import snapshot_environments
from sb3_mcbs.checkpoints.components import layers_of
from sb3_mcbs.checkpoints.encoding import Decoder, Encoded, Encoder, name_of
from sb3_mcbs.checkpoints.environments import monitors_of
from sb3_mcbs.checkpoints.errors import CheckpointError
from sb3_mcbs.checkpoints.files import file_of
from sb3_mcbs.checkpoints.handlers import HANDLERS, handler_of
from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotUnsupportedError
from sb3_mcbs.snapshot.object_graph import Capture, Restore

#: On whose versions it depends what a run computes.
_PACKAGES = (
    "numpy", "torch", "numba", "llvmlite",
    "gymnasium", "stable-baselines3", "sb3-contrib", "mujoco", "sb3-mcbs",
)  # fmt: skip
#: Parameters of constructors that are kept under another name.
_ATTRIBUTES = {"policy": "policy_class", "stats_window_size": "_stats_window_size"}
_NOT_SETTINGS = ("self", "env", "_init_setup_model")
_VEC_ENVS = {"DummyVecEnv": DummyVecEnv, "SubprocVecEnv": SubprocVecEnv}
_NORMALIZE = (
    "training", "norm_obs", "norm_reward", "clip_obs", "clip_reward", "gamma", "epsilon", "norm_obs_keys",
)  # fmt: skip


def describe_agent(agent: OffPolicyAlgorithm) -> Encoded:
    """Read the settings that an agent was made with.

    :param agent: the agent.
    :return: the class's name and its constructor's arguments.
    :raises CheckpointError: if one cannot be written as data; names it.
    """
    encoder, capture = Encoder(), Capture(handler_of, {}, 0)
    settings = {}
    for parameter in inspect.signature(type(agent).__init__).parameters.values():
        if parameter.name in _NOT_SETTINGS or parameter.kind is parameter.VAR_KEYWORD:
            continue
        attribute = _ATTRIBUTES.get(parameter.name, parameter.name)
        if not hasattr(agent, attribute):
            raise CheckpointError(
                f"{type(agent).__name__} keeps no attribute {attribute!r} for its parameter, so it could "
                "not be made again. Keep it."
            )
        value = getattr(agent, attribute)
        if value is NStepReplayBuffer and agent.n_steps > 1:
            value = None  # SB3 chose it by itself, and warns where it is given
        if isinstance(value, np.generic):
            value = value.item()  # as which SB3 keeps what it is given
        try:
            settings[parameter.name] = capture(value)
        except SnapshotUnsupportedError as error:
            raise CheckpointError(
                f"{parameter.name} cannot be part of a checkpoint: {error.reason}."
            ) from error
    for kind, payload in capture.nodes:
        if kind == "function" and (payload[1] or "<" in payload[0].qualname):
            raise CheckpointError(
                f"The settings hold the function {payload[0].qualname}, which cannot be written as data. For "
                "a learning rate use SB3's LinearSchedule; else define it at the top of a module."
            )
    data = {
        "class": name_of(type(agent)),
        "settings": {name: encoder.encode(value) for name, value in settings.items()},
        "nodes": encoder.encode_nodes(tuple(capture.nodes)),
    }
    return Encoded(data, encoder.arrays)


def make_agent(encoded: Encoded, names: dict[str, Any], env: GymEnv) -> OffPolicyAlgorithm:
    """Make an agent as it was made.

    :param encoded: from :func:`describe_agent`.
    :param names: classes and functions that the checkpoint may name.
    :param env: its environment.
    """
    decoder = Decoder(encoded.arrays, names)
    cls = decoder.decode({"name": encoded.json["class"]})
    if not (isinstance(cls, type) and issubclass(cls, OffPolicyAlgorithm)):
        raise CheckpointError(f"The checkpoint names {cls!r} as the class of its agent.")
    _refuse_removed(encoded.json["settings"], inspect.signature(cls.__init__).parameters)
    restore = Restore(decoder.decode_nodes(encoded.json["nodes"]), HANDLERS, [], "restore")
    settings = {name: restore(decoder.decode(value)) for name, value in encoded.json["settings"].items()}
    restore.commit()
    try:
        return cls(env=env, **settings)
    except TypeError as reason:  # of a version with other settings
        raise CheckpointError(f"The agent cannot be made as the checkpoint says: {reason}") from reason


def describe_vec_env(vec_env: VecEnv) -> dict[str, Any] | None:
    """Say how to make a vectorized environment like this one.

    :param vec_env: the agent's environment; environments in this process are wrapped for snapshots.
    :return: None if ids and plain arguments are not all that it takes.
    """
    *wrappers, base = layers_of(vec_env)
    if type(base) not in _VEC_ENVS.values():
        return None
    layers: list[list[Any]] = []
    for layer in reversed(wrappers):
        if type(layer) is VecNormalize:
            layers.append(["VecNormalize", {name: getattr(layer, name) for name in _NORMALIZE}])
        elif type(layer) is VecMonitor:
            file = file_of(layer)
            filename = None if file is None else file.name
            layers.append(["VecMonitor", {"filename": filename, "info_keywords": list(layer.info_keywords)}])
        elif type(layer) is not VecTransposeImage:  # which SB3 adds by itself
            return None
    environments = snapshot_environments(base)
    described = environments.apply(range(len(environments)), describe_environment)
    if any(description is None for description in described):
        return None
    return {"class": type(base).__name__, "environments": described, "layers": layers}


def make_vec_env(description: dict[str, Any]) -> VecEnv:
    """Make a vectorized environment as it was made.

    :param description: from :func:`describe_vec_env`.
    """
    makers = [functools.partial(make_environment, each) for each in description["environments"]]
    for environment in description["environments"]:
        if environment["id"] not in gym.registry:
            raise CheckpointError(
                f"The environment {environment['id']!r} is not registered here. Import the package that "
                "registers it, or pass env."
            )
    vec_env: VecEnv = _VEC_ENVS[description["class"]](makers)
    for name, arguments in description["layers"]:
        if name == "VecNormalize":
            vec_env = VecNormalize(vec_env, **arguments)
        else:
            keywords, filename = tuple(arguments["info_keywords"]), arguments["filename"]
            vec_env = VecMonitor(vec_env, info_keywords=keywords)
            if filename is not None:  # emptied only when the run goes on
                vec_env.results_writer = ResultsWriter(filename, None, keywords, override_existing=False)
    return vec_env


def log_files(description: dict[str, Any]) -> list[str]:
    """Return the files that a vectorized environment would write.

    :param description: from :func:`describe_vec_env`.
    """
    monitors = [environment["monitor"] for environment in description["environments"]]
    names = [monitor["filename"] for monitor in monitors if monitor is not None]
    names += [arguments["filename"] for name, arguments in description["layers"] if name == "VecMonitor"]
    return [name for name in names if name is not None]


def describe_environment(wrapper: SnapshotEnvWrapper) -> dict[str, Any] | None:
    """Say how to make an environment like this one, if its id and arguments are all that it takes.

    :param wrapper: the environment.
    :return: id, arguments and its Monitor's; None if it takes more.
    """
    spec, monitors = wrapper.spec, list(monitors_of(wrapper))
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
        file = file_of(monitors[0])
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


def circumstances(agent: OffPolicyAlgorithm) -> dict[str, Any]:
    """Return what has to be equal for a resumed run to be exact.

    :param agent: the agent.
    """
    return {
        "device": str(agent.device),
        "torch threads": th.get_num_threads(),
        "float32 matrix products": th.get_float32_matmul_precision(),
        "processor": processor(),
        **versions(),
    }


def processor() -> str:
    """Return what this machine's processor can do, as far as PyTorch cares."""
    return f"{platform.machine()} {th.backends.cpu.get_cpu_capability()}"


def processor_name() -> str:
    """Return its name, which Python's own function knows on few systems; nothing if nobody knows it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def versions(packages: Iterable[str] = _PACKAGES) -> dict[str, str | None]:
    """Return versions of Python and of packages.

    :param packages: by default those on which it depends what a run computes.
    """
    return {"python": platform.python_version(), **{package: _version(package) for package in packages}}


@functools.cache
def _version(package: str) -> str | None:
    try:
        return version(package)
    except ImportError:
        return None


def inexact(agent: OffPolicyAlgorithm) -> list[str]:
    """Return why a run cannot be repeated to the bit, whatever is saved.

    :param agent: the agent.
    """
    reasons = []
    if (getattr(agent, "search_kwargs", None) or {}).get("time_budget") is not None:
        reasons.append("time_budget makes decisions depend on how fast the machine is")
    if agent.device.type != "cpu":
        reasons.append(f"on {agent.device} networks are not computed in a fixed order")
    return reasons


def check_settings(saved: Encoded, ours: Encoded) -> None:
    """Refuse to continue a run with an agent that was made with other settings.

    :param saved: those of the checkpoint.
    :param ours: the agent's own.
    :raises CheckpointError: names the settings that differ.
    """
    if saved.json["class"] != ours.json["class"]:
        raise CheckpointError(
            f"The checkpoint is of a {saved.json['class']}, the agent is a {ours.json['class']}."
        )
    _refuse_removed(saved.json["settings"], ours.json["settings"])
    theirs, mine = (
        {name: _content(value, each.json["nodes"]) for name, value in each.json["settings"].items()}
        for each in (saved, ours)
    )
    differ = sorted(name for name in theirs.keys() | mine.keys() if theirs.get(name) != mine.get(name))
    same_content = all(
        name in ours.arrays and np.array_equal(array, ours.arrays[name])
        for name, array in saved.arrays.items()
    )
    if differ or not same_content:
        what = ", ".join(differ) or "the content of its settings"
        raise CheckpointError(
            f"The agent was made with other settings than the run of the checkpoint: {what}."
        )


def _content(value: Any, nodes: list[Any], within: tuple[int, ...] = ()) -> Any:
    """Follow references, and sort dictionaries by their keys: RL Zoo sorts what it saves with a run.

    :param value: encoded.
    :param nodes: what it refers to.
    :param within: the nodes that the value is part of.
    """
    if isinstance(value, dict):
        number = value.get("ref")
        if number is None or number in within:
            return {key: _content(part, nodes, within) for key, part in value.items()}
        return _content(nodes[number], nodes, (*within, number))
    if isinstance(value, list):
        parts = [_content(part, nodes, within) for part in value]
        if len(parts) == 2 and parts[0] == "dict":
            return ["dict", {"tuple": sorted(parts[1]["tuple"], key=repr)}]
        return parts
    return value


def _refuse_removed(theirs: dict[str, Any], known: Iterable[str]) -> None:
    """Say more than the constructor would where a run is older than a change of the search's settings."""
    removed = [f"{name} ({REMOVED[name][1]})" for name in theirs if name in REMOVED and name not in known]
    if removed:
        raise CheckpointError(
            f"The run was made with settings that were removed since then: {', '.join(removed)}. Continue it "
            "with the version of sb3-mcbs that it was started with."
        )
