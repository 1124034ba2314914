"""Classes that a checkpoint may name: those of Stable-Baselines3 and plain containers, no more."""

import functools
import random
import sys
from collections import OrderedDict, defaultdict, deque
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch as th
from sb3_contrib.crossq import policies as crossq_policies
from sb3_contrib.tqc import policies as tqc_policies
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common import buffers, noise, running_mean_std, torch_layers, type_aliases, utils
from stable_baselines3.common.vec_env import stacked_observations
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy
from stable_baselines3.sac import policies as sac_policies
from stable_baselines3.td3 import policies as td3_policies

from sb3_mcbs.agents.branches import Branches
from sb3_mcbs.agents.registry import ALGORITHMS
from sb3_mcbs.checkpoints.encoding import name_of
from sb3_mcbs.snapshot.functions import FunctionName

_CLASSES: tuple[type, ...] = (
    np.float32, np.float64, np.int32, np.int64, np.uint8, np.bool_,
    bool, int, float, str, bytes, list, tuple, dict, set, frozenset, deque, OrderedDict, defaultdict,
    random.Random, np.random.Generator, np.random.RandomState, np.random.PCG64, np.random.MT19937,
    np.random.PCG64DXSM, np.random.Philox, np.random.SFC64,
    *ALGORITHMS.values(), Branches,
    buffers.ReplayBuffer, buffers.NStepReplayBuffer, buffers.DictReplayBuffer, HerReplayBuffer,
    GoalSelectionStrategy, type_aliases.TrainFreq, type_aliases.TrainFrequencyUnit,
    noise.NormalActionNoise, noise.OrnsteinUhlenbeckActionNoise, noise.VectorizedActionNoise,
    utils.FloatSchedule, utils.LinearSchedule, utils.ConstantSchedule,
    torch_layers.FlattenExtractor, torch_layers.NatureCNN, torch_layers.CombinedExtractor,
    running_mean_std.RunningMeanStd, stacked_observations.StackedObservations,
    th.nn.ReLU, th.nn.Tanh, th.nn.ELU, th.nn.LeakyReLU, th.nn.GELU, th.nn.SiLU, th.nn.Sigmoid, th.nn.Softplus,
    th.optim.Adam, th.optim.AdamW, th.optim.SGD, th.optim.RMSprop,
)  # fmt: skip


@functools.cache
def _own_names() -> dict[str, Any]:
    policies = (td3_policies, sac_policies, tqc_policies, crossq_policies)
    networks = [
        cls
        for module in policies
        for cls in vars(module).values()
        if isinstance(cls, type) and cls.__module__ == module.__name__
    ]
    return {name_of(cls): cls for cls in (*_CLASSES, *networks)}


def known_names(classes: Iterable[Any] = ()) -> dict[str, Any]:
    """Return what a checkpoint may name.

    :param classes: classes and functions that the caller trusts, besides.
    """
    names = dict(_own_names())
    zoos = getattr(sys.modules.get("rl_zoo3.utils"), "SimpleLinearSchedule", None)  # not imported for this
    for trusted in (*classes, *([] if zoos is None else [zoos])):
        is_function = type(trusted) is type(known_names)
        names[name_of(FunctionName(trusted) if is_function else trusted)] = trusted
    return names
