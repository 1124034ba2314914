"""One agent of ``training.py`` in a process of its own: trains when it is told to and says how long it took.

Runs in the environment of sb3-mcbs, and for the arm ``SBX TD3`` in one that has ``sbx-rl`` instead.
Reads numbers of steps from standard input, one a line, and answers each with a line of JSON.
"""

import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks import NETWORKS

WARM_UP = 400
SIZES = {"MCBSTD3 (6,3,5)": (6, 3, 5), "MCBSTD3 (6,3,1)": (6, 3, 1), "MCBSTD3 (18,6,5)": (18, 6, 5)}
#: ``mcbs_td3.yml`` in HalfCheetah, but searching in half of the steps, not of the episodes: rounds are short.
RECIPE: dict[str, Any] = {"preset": "train", "search_unit": "step", "policy_delay": 1}


def settings(n_envs: int) -> dict[str, Any]:
    """RL Zoo's TD3 settings for MuJoCo, a shorter warm-up; as many gradient steps as steps."""
    from stable_baselines3.common.noise import NormalActionNoise

    return {
        "learning_starts": WARM_UP,
        "batch_size": 256,
        "buffer_size": 200_000,
        "learning_rate": 1e-3,
        "train_freq": 1,
        "gradient_steps": -1 if n_envs > 1 else 1,
        "action_noise": NormalActionNoise(np.zeros(6), 0.1 * np.ones(6)),
        "policy_kwargs": NETWORKS,
        "seed": 0,
    }


def make_agent(arm: str, env_id: str, n_envs: int) -> Any:
    """Build the agent of an arm."""
    if arm == "SBX TD3":
        from sbx import TD3 as SBXTD3
        from stable_baselines3.common.env_util import make_vec_env

        return SBXTD3("MlpPolicy", make_vec_env(env_id, n_envs, seed=0), **settings(n_envs))

    import torch as th
    from stable_baselines3 import TD3
    from stable_baselines3.common.env_util import make_vec_env

    from sb3_mcbs import MCBSTD3

    env = make_vec_env(env_id, n_envs, seed=0)
    common: dict[str, Any] = {**settings(n_envs), "device": th.device("cpu")}
    if arm == "SB3 TD3":
        return TD3("MlpPolicy", env, **common)
    if arm == "SB3 TD3, our update":
        from sb3_mcbs.networks.td3_update import TD3Update

        agent = TD3("MlpPolicy", env, **common)
        agent.train = TD3Update(agent).train  # type: ignore[assignment, method-assign]
        return agent
    if arm == "the usual way (6,3,5)":
        from benchmarks.naive import UsualMCBSTD3

        return UsualMCBSTD3("MlpPolicy", env, **common)
    if arm == "MCBSTD3, HalfCheetah's entry":
        return MCBSTD3("MlpPolicy", env, **common, **RECIPE)
    size, _, precision = arm.partition(", ")
    beam_width, rollout_depth, n_simulations = SIZES[size]
    return MCBSTD3(
        "MlpPolicy",
        env,
        **{**common, "matmul_precision": precision or None},
        beam_width=beam_width,
        rollout_depth=rollout_depth,
        n_simulations=n_simulations,
    )


class Stopwatch:
    """Adds up the seconds inside some calls, without those of watched calls that they make."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._inside: list[float] = []

    def watch(self, owner: Any, name: str, part: str) -> None:
        """Replace a method by one that is timed."""
        setattr(owner, name, self.wrap(getattr(owner, name), part))

    def wrap(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        """Time a function."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            self._inside.append(0.0)
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                seconds = time.perf_counter() - start
                self.seconds[part] += seconds - self._inside.pop()
                if self._inside:
                    self._inside[-1] += seconds

        return timed


def watch_parts(agent: Any) -> Stopwatch:
    """Time the parts of an agent's training."""
    stopwatch = Stopwatch()
    stopwatch.watch(agent, "train", "gradient")
    stopwatch.watch(agent.env, "step", "environment")
    stopwatch.watch(agent, "_sample_action", "rest of choosing actions")
    planner = getattr(agent, "planner", None)
    if planner is not None:
        for name in ("step", "roll_out"):
            if hasattr(planner.model, name):
                stopwatch.watch(planner.model, name, "rollouts")
        make_functions = planner.functions

        def timed_functions() -> Any:
            functions = make_functions()
            return functions._replace(
                policy=stopwatch.wrap(functions.policy, "networks outside of rollouts"),
                value=stopwatch.wrap(functions.value, "networks outside of rollouts"),
            )

        planner.functions = timed_functions
    return stopwatch


def main() -> None:
    """Arguments: arm, environment, number of environments."""
    arm, env_id, n_envs = sys.argv[1], sys.argv[2], int(sys.argv[3])
    probe = gym.make(env_id)
    act_dim = probe.action_space.shape[0]  # type: ignore[index]
    if act_dim != 6:
        raise SystemExit(f"{env_id} has {act_dim} action entries; the noise of the settings is for 6")
    agent = make_agent(arm, env_id, n_envs)
    agent.learn(WARM_UP + 100)
    stopwatch = watch_parts(agent)
    print("ready", flush=True)
    for line in sys.stdin:
        steps = int(line)
        stopwatch.seconds.clear()
        start = time.perf_counter()
        agent.learn(steps, reset_num_timesteps=False)
        answer = {"seconds": time.perf_counter() - start, "parts": dict(stopwatch.seconds)}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
