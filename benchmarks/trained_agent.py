"""Put look-ahead around an agent that was trained before: the actor alone against the actor with search.

    python benchmarks/trained_agent.py sac-HalfCheetah-v3.zip --algo sac --env HalfCheetah-v4

Both act from the same reset seeds, without any training. Agents of the RL Zoo hub that were saved with the
old ``gym`` load too: their pickled spaces and schedules are replaced.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from sb3_contrib import TQC
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_mcbs import MCBSTD3, SearchPolicy

ALGOS: dict[str, type[OffPolicyAlgorithm]] = {
    "ddpg": DDPG,
    "mcbs_td3": MCBSTD3,
    "sac": SAC,
    "td3": TD3,
    "tqc": TQC,
}


class Row(NamedTuple):
    """What one policy got: returns per episode, and its costs per environment step."""

    policy: str
    returns: list[float]
    ms_per_step: float
    simulated_steps: int


def load_agent(path: Path, algo: str, env: VecEnv) -> OffPolicyAlgorithm:
    """
    Load a saved agent for the spaces of an environment.

    :param path: SB3 zip file; it is unpickled, so it must come from someone you trust
    :param algo: name of its algorithm
    :param env: the environment to act in
    :return: the agent, without an environment of its own
    """
    custom_objects: dict[str, Any] = {
        "observation_space": env.observation_space,
        "action_space": env.action_space,
        "learning_rate": 0.0,
        "lr_schedule": lambda _: 0.0,
    }
    return ALGOS[algo].load(path, custom_objects=custom_objects, buffer_size=1, device="cpu")


def evaluate(policy: Any, env: VecEnv, seeds: range) -> tuple[list[float], float]:
    """
    Run one episode per reset seed.

    :param policy: anything with SB3's ``predict``
    :param env: one environment
    :param seeds: reset seeds
    :return: the returns, and wall-clock milliseconds per environment step
    """
    returns: list[float] = []
    steps, start = 0, time.perf_counter()
    for seed in seeds:
        env.seed(seed)
        episode_returns, lengths = evaluate_policy(policy, env, 1, return_episode_rewards=True)
        assert isinstance(episode_returns, list) and isinstance(lengths, list)
        returns += episode_returns
        steps += sum(lengths)
    return returns, 1000 * (time.perf_counter() - start) / steps


def parse_args() -> argparse.Namespace:
    """
    :return: the command line
    """
    parser = argparse.ArgumentParser(description="A trained agent alone and with look-ahead.")
    parser.add_argument("path", type=Path, help="SB3 zip file of the agent")
    parser.add_argument("--algo", choices=sorted(ALGOS), required=True)
    parser.add_argument("--env", required=True)
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--beam-width", type=int, default=6)
    parser.add_argument("--rollout-depth", type=int, default=3)
    parser.add_argument("--n-simulations", type=int, default=5)
    parser.add_argument("--beam-noise", type=float, default=0.1)
    parser.add_argument("--rollout-noise", type=float)
    parser.add_argument("--include-policy-action", action="store_true")
    parser.add_argument("--json", type=Path, help="also write the numbers here")
    return parser.parse_args()


def main() -> None:
    """Evaluate both policies and print a table."""
    args = parse_args()
    env = make_vec_env(args.env, 1)
    agent = load_agent(args.path, args.algo, env)
    settings = {
        "beam_width": args.beam_width,
        "rollout_depth": args.rollout_depth,
        "n_simulations": args.n_simulations,
        "beam_noise": args.beam_noise,
        "search_kwargs": {
            "rollout_noise": args.rollout_noise,
            "include_policy_action": args.include_policy_action,
        },
    }
    searching = SearchPolicy(agent, env, seed=0, **settings)
    seeds = range(args.episodes)
    rows = []
    for name, policy in (("actor alone", agent), ("actor with search", searching)):
        returns, ms = evaluate(policy, env, seeds)
        simulated = 0 if searching.last_result is None else searching.last_result.simulated_steps
        rows.append(Row(name, returns, ms, simulated))
    print(f"{args.algo} on {args.env}, reset seeds {list(seeds)}, {settings}")
    print("| policy | mean return | every episode | simulated steps per decision | ms per step |")
    print("|---|---|---|---|---|")
    for row in rows:
        episodes = ", ".join(f"{value:.0f}" for value in row.returns)
        mean = np.mean(row.returns)
        print(f"| {row.policy} | {mean:.0f} | {episodes} | {row.simulated_steps} | {row.ms_per_step:.2f} |")
    print(f"with search / alone: {np.mean(rows[1].returns) / np.mean(rows[0].returns):.3f}")
    if args.json:
        about = {"env": args.env, "algo": args.algo, "settings": settings}
        args.json.write_text(json.dumps({**about, "rows": [row._asdict() for row in rows]}, indent=2))


if __name__ == "__main__":
    main()
