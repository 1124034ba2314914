"""Does searching while training teach better? One run of one arm, both of its policies evaluated alike.

    python -m benchmarks.search_training td3 --seed 0

Every arm is evaluated on the same ten resets, as the bare actor and with the same search ("efficient": 18
simulated steps per decision), whatever it trained with. Results are written after every evaluation;
``python -m benchmarks.search_training_report`` puts them into tables.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from benchmarks.common import NETWORKS, machine
from benchmarks.search_training_arms import ARMS
from sb3_mcbs import SearchPolicy, SnapshotEnvWrapper

EVALUATION_SEED = 1000
EPISODES = 10
#: With a preset, what an agent searches with in training has no part in it.
EVALUATION_SEARCH: dict[str, Any] = {"preset": "efficient", "model_kwargs": {"n_threads": 1}}


class Evaluation(BaseCallback):
    """Evaluates the bare actor and the actor with search at some steps of the training.

    :param at: when, in environment steps, rising.
    :param env_id: the environment.
    :param path: the file that the results are written to.
    :param record: what is known of the run.
    """

    def __init__(self, at: list[int], env_id: str, path: Path, record: dict[str, Any]) -> None:
        super().__init__()
        self._at, self._path, self._record = list(at), path, record
        self._env = make_vec_env(env_id, EPISODES, wrapper_class=SnapshotEnvWrapper)
        self._returns: list[float] = []
        self._evaluating, self._start = 0.0, time.perf_counter()

    def _on_step(self) -> bool:
        self._returns += [info["episode"]["r"] for info in self.locals["infos"] if "episode" in info]
        return True

    def _on_rollout_start(self) -> None:
        # Here the gradient steps of the rollout before are done.
        if self._at and self.num_timesteps >= self._at[0]:
            self._at.pop(0)
            self._evaluate()

    def _on_training_end(self) -> None:
        self._on_rollout_start()
        self._env.close()

    def _evaluate(self) -> None:
        start = time.perf_counter()
        agent: Any = self.model
        searching = SearchPolicy(agent, self._env, seed=EVALUATION_SEED, **EVALUATION_SEARCH)
        returns: dict[str, Any] = {}
        for name, policy in (("actor", agent), ("search", searching)):
            self._env.seed(EVALUATION_SEED)
            returns[name], _ = evaluate_policy(policy, self._env, EPISODES, return_episode_rewards=True)
        searching.close()
        now = time.perf_counter()
        self._evaluating += now - start
        self._record["evaluations"].append(
            {
                "step": self.num_timesteps,
                "training": float(np.mean(self._returns[-10:])),
                **returns,
                "simulated_steps": getattr(agent, "n_simulated_steps", 0),
                "training_seconds": now - self._start - self._evaluating,
            }
        )
        self._path.write_text(json.dumps(self._record, indent=1) + "\n")
        means = {name: round(float(np.mean(values))) for name, values in returns.items()}
        print(self._record["arm"], self._record["seed"], self.num_timesteps, means, flush=True)


def make_agent(arm: str, env_id: str, seed: int) -> OffPolicyAlgorithm:
    """Make the agent of an arm, with RL Zoo's settings of TD3.

    :param arm: one of ``ARMS``.
    :param env_id: the environment.
    :param seed: of the agent and its environment.
    """
    agent_class, settings = ARMS[arm]
    env = make_vec_env(env_id, 1, seed=seed, wrapper_class=SnapshotEnvWrapper)
    (act_dim,) = env.action_space.shape or ()
    common: dict[str, Any] = {
        "learning_starts": 10_000,
        "action_noise": NormalActionNoise(np.zeros(act_dim), np.full(act_dim, 0.1)),
        "policy_kwargs": dict(NETWORKS),
        "seed": seed,
        "device": "cpu",
    }
    if not issubclass(agent_class, TD3):
        raise TypeError(f"arms are kinds of TD3, got {agent_class.__name__}")
    return agent_class("MlpPolicy", env, **{**common, **settings})


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("arm", choices=ARMS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--steps", type=int, default=60_000)
    parser.add_argument(
        "--evaluate-at", type=int, nargs="+", default=[15_000, 30_000, 45_000, 50_000, 55_000, 60_000]
    )
    parser.add_argument("--folder", type=Path, default=Path("logs/search_training"))
    args = parser.parse_args()
    th.set_num_threads(1)
    args.folder.mkdir(parents=True, exist_ok=True)
    path = args.folder / f"{args.env}-{args.arm}-{args.seed}.json"
    record = {"arm": args.arm, "env": args.env, "seed": args.seed, "steps": args.steps}
    record |= {"machine": machine(), "evaluations": []}
    agent = make_agent(args.arm, args.env, args.seed)
    agent.learn(args.steps, callback=Evaluation(args.evaluate_at, args.env, path, record))


if __name__ == "__main__":
    main()
