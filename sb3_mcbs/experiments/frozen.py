"""Trained agents, alone or with search around them: nothing is trained."""

import json
import time
from typing import Any

import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_mcbs.agents import SearchPolicy
from sb3_mcbs.agents.episodes import Episode, play
from sb3_mcbs.experiments.evaluation import write_evaluations
from sb3_mcbs.experiments.plan import Run
from sb3_mcbs.experiments.results import RunFolder, write
from sb3_mcbs.loading import load_agent, load_statistics
from sb3_mcbs.snapshot import SnapshotEnvWrapper


def evaluate_agent(folder: RunFolder) -> None:
    """
    Play a run's episodes, and write them as the evaluation of a training is written.

    ``simulated_steps`` and ``seconds`` are those that acting in all these episodes took.

    :param folder: of the run
    """
    run = folder.run()
    env, policy = _make_policy(run)
    seeds = run.evaluation.seeds
    episodes: list[Episode] = []
    started = time.perf_counter()
    for seed in seeds:
        episodes.append(play(policy, env, seed))
        mean = float(np.mean([each.total for each in episodes]))
        progress = {"step": len(episodes), "evaluations": len(episodes), "returns": {run.algorithm: mean}}
        write(folder.progress_file, json.dumps(progress) + "\n")
        print(f"Episode with seed {seed}: {episodes[-1].total:.2f} in {episodes[-1].length} steps")
    write_evaluations(
        folder.training(run),
        {
            "timesteps": [0],
            "results": [[each.total for each in episodes]],
            "ep_lengths": [[each.length for each in episodes]],
            "seeds": seeds,
            "simulated_steps": [sum(each.simulated_steps for each in episodes)],
            "seconds": [time.perf_counter() - started],
        },
    )


def _make_policy(run: Run) -> tuple[VecEnv, Any]:
    assert run.agent is not None
    env: VecEnv = make_vec_env(run.environment, seed=run.seed, wrapper_class=SnapshotEnvWrapper)
    if run.agent.statistics is not None:
        env = load_statistics(run.agent.statistics, env)
    agent = load_agent(run.agent.file, env)
    if run.algorithm == "actor":
        return env, agent
    return env, SearchPolicy(agent, env, seed=run.seed, **run.params)
