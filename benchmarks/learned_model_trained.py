"""A learned model of the environment around an agent that was trained before, beside the exact model.

    python -m benchmarks.learned_model_trained sac-HalfCheetah-v3.zip --algo sac --env HalfCheetah-v4

The agent acts with noise, the ensemble is fitted to what happens, and then the bare actor and the actor with
search by each model ("efficient": 18 simulated steps per decision) act from the same resets. There is no
training of the agent, so that only the model makes the difference.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.common import parse_args, write
from benchmarks.learned_model import error_over_horizon, evaluate
from benchmarks.trained_agent import ALGOS, load_agent
from sb3_mcbs.agents.learned_model import HELD_OUT_EVERY, EnsembleSettings, LearnedModel
from sb3_mcbs.models import Transitions


def collect(agent: Any, env_id: str, steps: int, noise: float) -> Transitions:
    """Act with the actor and Gaussian noise.

    :param agent: the agent; its actions are not scaled by the environment.
    :param env_id: the environment.
    :param steps: how long.
    :param noise: its standard deviation.
    """
    env, rng = gym.make(env_id), np.random.default_rng(0)
    rows = []
    observation, _ = env.reset(seed=0)
    for _ in range(steps):
        action, _ = agent.predict(observation, deterministic=True)
        action = np.clip(action + noise * rng.standard_normal(action.shape), -1, 1).astype(np.float32)
        following, reward, terminated, truncated, _ = env.step(action)
        rows.append((observation, action, following, reward, float(terminated)))
        observation = env.reset()[0] if terminated or truncated else following
    env.close()
    return Transitions(*map(np.array, zip(*rows, strict=True)))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("path", type=Path)
    parser.add_argument("--algo", choices=sorted(ALGOS), required=True)
    parser.add_argument("--env", required=True)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--noise", type=float, default=0.2)
    parser.add_argument("--gradient-steps", type=int, default=2500)
    parser.add_argument("--exact", default="auto", help="forward_model that is exact; empty: there is none")
    args = parse_args(parser)
    th.set_num_threads(1)
    agent: Any = load_agent(args.path, args.algo, make_vec_env(args.env, 1))
    agent.learned_model = LearnedModel(agent, EnsembleSettings())
    ensemble = agent.learned_model.ensemble
    transitions = collect(agent, args.env, args.steps, args.noise)
    held_out = np.arange(args.steps) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    ensemble.fit(transitions, held_out, args.gradient_steps, agent.learned_model.rng)
    result = {
        **vars(args),
        "path": args.path.name,
        "held-out error": ensemble.held_out_error,
        "error over horizon": error_over_horizon(agent, args.env),
        "returns": evaluate(agent, args.env, [*([args.exact] if args.exact else []), "ensemble"]),
    }
    means = {name: round(float(np.mean(values)), 1) for name, values in result["returns"].items()}
    print(result["held-out error"], result["error over horizon"], means, flush=True)
    write(f"learned_model-{args.algo}-{args.env}", result)


if __name__ == "__main__":
    main()
