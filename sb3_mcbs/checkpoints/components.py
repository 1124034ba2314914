"""What a run consists of, and which of its attributes are not state."""

import os
import re
from collections.abc import Iterable, Iterator
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper
from torch import nn

from sb3_mcbs.agents import SearchPolicy
from sb3_mcbs.checkpoints.buffers import row_attributes

_HOOKS = "functions that somebody attached to the network"
_RESOURCE = "made anew in a new process"
_OUTPUT = "what the last step returned; written again before it is read"
_FILE = "an open file; its content is saved"
#: The end of a word in the names of attributes that say where something is written.
_PLACE = re.compile(r"(path|dir|directory|folder|file|filename|prefix)(_|$)")

#: Class of SB3 or torch (and those derived from it) -> attribute -> why it is neither saved nor restored.
#: This package's classes say so themselves, as ``not_checkpointed``; so may those of the user.
NOT_STATE: dict[type, dict[str, str]] = {
    BaseAlgorithm: {
        "start_time": "the time that was used so far is saved instead",
        "tensorboard_log": "a setting, which was checked when the run was resumed",
    },
    nn.Module: {
        "_parameters": "saved as state_dict",
        "_buffers": "saved as state_dict",
        "_modules": "components of their own",
        "_non_persistent_buffers_set": "follows from the class",
        "_is_full_backward_hook": _HOOKS,
        "_forward_hooks": _HOOKS,
        "_forward_hooks_with_kwargs": _HOOKS,
        "_forward_hooks_always_called": _HOOKS,
        "_forward_pre_hooks": _HOOKS,
        "_forward_pre_hooks_with_kwargs": _HOOKS,
        "_backward_hooks": _HOOKS,
        "_backward_pre_hooks": _HOOKS,
        "_state_dict_hooks": _HOOKS,
        "_state_dict_pre_hooks": _HOOKS,
        "_load_state_dict_pre_hooks": _HOOKS,
        "_load_state_dict_post_hooks": _HOOKS,
    },
    VecEnv: {
        "envs": "saved one by one",
        "buf_infos": _OUTPUT,
        "reset_infos": _OUTPUT,
        "metadata": "how environments are drawn",
        "render_mode": "how environments are drawn",
        "class_attributes": "follows from the class",
        "remotes": _RESOURCE,
        "work_remotes": _RESOURCE,
        "processes": _RESOURCE,
        "waiting": _RESOURCE,
        "closed": _RESOURCE,
        "results_writer": _FILE,
    },
    BaseCallback: {
        "model": "the agent, or its SearchPolicy, is a component of its own",
        "locals": "variables of learn()",
        "globals": "variables of SB3's module",
    },
    ProgressBarCallback: {"pbar": "drawn anew"},
    Logger: {"dir": "where to write is not for a checkpoint to decide; checked when the run was resumed"},
    KVWriter: {"file": _FILE, "writer": _FILE},
}


def not_state_of(component: Any, saved: Iterable[str] = ()) -> frozenset[str]:
    """Return the names of a component's attributes that are neither saved nor restored.

    :param component: from :func:`components`.
    :param saved: names of attributes that it may not have, but a checkpoint does.
    """
    names = {name for cls, reasons in NOT_STATE.items() if isinstance(component, cls) for name in reasons}
    if isinstance(component, ReplayBuffer):
        names |= row_attributes(component)
    if isinstance(component, BaseCallback | VecEnv):
        names |= {name for name in {*vars(component), *saved} if _is_place(component, name)}
    for cls in type(component).__mro__:
        names |= set(vars(cls).get("not_checkpointed", ()))
    return frozenset(names)


def _is_place(component: Any, name: str) -> bool:
    """Whether an attribute says where something is written, which is not for a checkpoint to decide."""
    value = vars(component).get(name, getattr(type(component), name, None))
    if isinstance(value, os.PathLike):
        return True
    return (value is None or isinstance(value, str)) and _PLACE.search(name) is not None


def components(agent: OffPolicyAlgorithm, callback: BaseCallback) -> dict[str, Any]:
    """Find everything whose attributes are a run's state.

    :param agent: the agent that learns.
    :param callback: the callback of its ``learn``.
    :return: by a name that is the same in every process.
    """
    found: dict[str, Any] = {"agent": agent}
    for name, module in agent.policy.named_modules():
        found[f"agent.policy.{name}".rstrip(".")] = module
    found["agent.replay_buffer"] = agent.replay_buffer
    found["logger"] = agent.logger
    for index, output_format in enumerate(agent.logger.output_formats):
        found[f"logger.output_formats[{index}]"] = output_format
    for name, each in callbacks("callback", callback):
        found[name] = each
        if isinstance(each.model, SearchPolicy):
            found[f"{name}.model"] = each.model
    # The agent's environment, and those that callbacks evaluate in.
    vec_envs = {"agent.env": agent.env}
    for name, part in found.items():
        if isinstance(part, BaseCallback | SearchPolicy):
            held = vars(part).items()
            vec_envs |= {
                f"{name}.{attribute}": value for attribute, value in held if isinstance(value, VecEnv)
            }
    for name, vec_env in vec_envs.items():
        assert vec_env is not None
        for depth, layer in enumerate(layers_of(vec_env)):
            found[f"{name}.layers[{depth}]"] = layer
    first_names = {id(part): name for name, part in reversed(found.items())}
    return {name: found[name] for name in found if first_names[id(found[name])] == name}


def callbacks(name: str, callback: BaseCallback) -> Iterator[tuple[str, BaseCallback]]:
    """Find a callback and those within it, in a fixed order.

    :param name: of the outermost.
    :param callback: the outermost.
    """
    yield name, callback
    for attribute, value in vars(callback).items():
        if attribute in ("parent", "model"):
            continue
        if isinstance(value, BaseCallback):
            yield from callbacks(f"{name}.{attribute}", value)
        elif isinstance(value, list):
            for index, item in enumerate(value):
                if isinstance(item, BaseCallback):
                    yield from callbacks(f"{name}.{attribute}[{index}]", item)


def layers_of(vec_env: VecEnv) -> Iterator[VecEnv]:
    """Return the layers of a vectorized environment, outermost first.

    :param vec_env: the outermost.
    """
    yield vec_env
    while isinstance(vec_env, VecEnvWrapper):
        vec_env = vec_env.venv
        yield vec_env
