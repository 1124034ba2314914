"""Searching with a learned model of the environment, beside the exact one and beside no search. One run.

    python -m benchmarks.learned_model learned --env HalfCheetah-v5 --seed 0

Arms differ in nothing but what simulates while they train: "none" (TD3), "exact" (a copy of the simulator),
"learned" (an ensemble). Every agent is evaluated on the same resets as the bare actor, and with the same
search ("efficient": 18 simulated steps per decision) by each model that it has. For the learned model the
error of predictions over several steps is measured too.
"""

import argparse
import time
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise

from benchmarks.common import NETWORKS, parse_args, write
from benchmarks.search_training_arms import PlainTD3
from sb3_mcbs import MCBSTD3, SearchPolicy, SnapshotEnvWrapper
from sb3_mcbs.models import EnsembleModel

ARMS = {"none": None, "exact": "auto", "learned": "ensemble"}
EVALUATION_SEED = 1000
EPISODES = 10
HORIZONS = (1, 2, 3, 5, 10)
#: What RL Zoo's settings of TD3 for an environment are besides those for HalfCheetah.
SETTINGS: dict[str, dict[str, Any]] = {
    "LunarLanderContinuous-v3": {"gamma": 0.98, "buffer_size": 200_000},
}


def make_agent(args: argparse.Namespace) -> Any:
    """Make the agent of an arm.

    :param args: the command line.
    """
    wrapper = SnapshotEnvWrapper if args.arm == "exact" else None
    env = make_vec_env(args.env, 1, seed=args.seed, wrapper_class=wrapper)
    (act_dim,) = env.action_space.shape or ()
    settings = {
        "learning_starts": args.learning_starts,
        "action_noise": NormalActionNoise(np.zeros(act_dim), np.full(act_dim, 0.1)),
        "policy_kwargs": dict(NETWORKS),
        "seed": args.seed,
        "device": "cpu",
        **SETTINGS.get(args.env, {}),
    }
    if ARMS[args.arm] is None:
        return PlainTD3("MlpPolicy", env, **settings)
    model_kwargs: dict[str, Any] = {"n_threads": 1}
    if args.arm == "learned":
        model_kwargs |= {"ensemble_max_error": args.max_error, "ensemble_pessimism": args.pessimism}
    settings |= {"preset": "efficient", "forward_model": ARMS[args.arm], "model_kwargs": model_kwargs}
    return MCBSTD3("MlpPolicy", env, **settings)


def evaluate(agent: Any, env_id: str, models: list[str]) -> dict[str, list[float]]:
    """Evaluate the bare actor, and the actor with search by every model.

    :param agent: the agent.
    :param env_id: the environment.
    :param models: values of ``forward_model``.
    :return: returns by policy.
    """
    env = make_vec_env(env_id, EPISODES)
    policies: dict[str, Any] = {"actor": agent}
    for model in models:
        policies[f"search, {model}"] = SearchPolicy(
            agent,
            env,
            seed=EVALUATION_SEED,
            preset="efficient",
            model_kwargs=dict(n_threads=1),
            forward_model=model,
        )
    returns: dict[str, Any] = {}
    for name, policy in policies.items():
        env.seed(EVALUATION_SEED)
        returns[name], _ = evaluate_policy(policy, env, EPISODES, return_episode_rewards=True)
    env.close()
    return returns


def error_over_horizon(agent: Any, env_id: str, steps: int = 1000) -> list[dict[str, float]]:
    """Compare predictions over several steps with what happens under the actor with noise.

    :param agent: an agent with a learned model.
    :param env_id: the environment.
    :param steps: how long to act.
    :return: for every horizon the root mean square error of the last observation, in standard deviations of
        the observations on the way and averaged over their entries, the same of the last reward, and how far
        the members disagree in the last step.
    """
    env: Any = gym.make(env_id)
    rng = np.random.default_rng(0)
    rows = []
    observation, _ = env.reset(seed=EVALUATION_SEED)
    episode = 0
    for _ in range(steps):
        action, _ = agent.predict(observation, deterministic=True)
        action = np.clip(action + 0.1 * rng.standard_normal(action.shape), -1, 1).astype(np.float32)
        following, reward, terminated, truncated, _ = env.step(action)
        rows.append((observation, action, following, reward, episode))
        observation = following
        if terminated or truncated:
            episode += 1
            observation, _ = env.reset()
    observations, actions, followings, rewards, episodes = map(np.array, zip(*rows, strict=True))
    model = EnsembleModel(agent.learned_model.ensemble, env.observation_space, env.action_space, 0.0)
    starts = np.arange(0, steps - max(HORIZONS), 3)
    starts = starts[episodes[starts] == episodes[starts + max(HORIZONS) - 1]]
    model.set_roots(list(observations[starts]), np.arange(len(starts)), rng)
    scale = np.maximum(observations.std(axis=0), 1e-6)
    found = []
    for horizon in range(1, max(HORIZONS) + 1):
        at = starts + horizon - 1
        scaled = 2 * (actions[at] - env.action_space.low) / (env.action_space.high - env.action_space.low) - 1
        disagreement = model.ensemble.predict(model._observations, scaled).disagreement.mean()
        step = model.step(actions[at])
        difference = (step.observations - followings[at]) / scale
        if horizon in HORIZONS:
            found.append(
                {
                    "horizon": horizon,
                    "observation error": float(np.sqrt(np.square(difference).mean(axis=0)).mean()),
                    "reward error": float(
                        np.sqrt(np.square(step.rewards - rewards[at]).mean()) / rewards.std()
                    ),
                    "disagreement": float(disagreement),
                }
            )
    env.close()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("arm", choices=ARMS)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=40_000)
    parser.add_argument("--learning-starts", type=int, default=10_000)
    parser.add_argument("--max-error", type=float, default=0.5)
    parser.add_argument("--pessimism", type=float, default=1.0)
    args = parse_args(parser)
    th.set_num_threads(1)
    agent = make_agent(args)
    start = time.process_time()
    agent.learn(args.steps)
    result: dict[str, Any] = {**vars(args), "training cpu seconds": time.process_time() - start}
    episodes = [info["r"] for info in agent.ep_info_buffer]
    result["training return, last 10 episodes"] = float(np.mean(episodes[-10:]))
    exact = ["auto"] if args.env.startswith("HalfCheetah") else []
    result["returns"] = evaluate(agent, args.env, [*exact, *(["ensemble"] if args.arm == "learned" else [])])
    if args.arm == "learned":
        model = agent.learned_model
        result["held-out error"] = model.ensemble.held_out_error
        result["termination error"] = model.ensemble.termination_error
        result["decisions searched"] = agent.n_decisions
        result["error over horizon"] = error_over_horizon(agent, args.env)
    print({name: round(float(np.mean(values)), 1) for name, values in result["returns"].items()}, flush=True)
    write(f"learned_model-{args.env}-{args.arm}-{args.seed}", result)


if __name__ == "__main__":
    main()
