"""Control with a deadline: search for at most the given time, then act.

python examples/deadline.py agent.zip --env Walker2d-v5 --budget-ms 5
"""

import argparse
import time

import numpy as np
from stable_baselines3.common.env_util import make_vec_env

from sb3_mcbs import SearchPolicy, load_agent

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("agent", help="a zip of TD3, DDPG, SAC, TQC or CrossQ, or of one of our agents")
parser.add_argument("--env", default="Walker2d-v5")
parser.add_argument("--budget-ms", type=float, default=5.0)
parser.add_argument("--steps", type=int, default=1_000)
args = parser.parse_args()

env = make_vec_env(args.env)
model = load_agent(args.agent, env)
limits = dict(time_budget=args.budget_ms / 1000, max_beam_width=100)  # at most 100 candidates
policy = SearchPolicy(model, env, preset="efficient", search_kwargs=limits, seed=0)

milliseconds, candidates = [], []
env.seed(0)
observation = env.reset()
for step in range(-200, args.steps):  # the first 200 decisions measure how fast this machine is
    start = time.perf_counter()
    action, _ = policy.predict(observation)
    if step >= 0:
        milliseconds.append(1000 * (time.perf_counter() - start))
        candidates.append(policy.last_result.values.shape[1])
    observation, *_ = env.step(action)
late = np.mean(np.array(milliseconds) > args.budget_ms)
print(f"median {np.median(milliseconds):.2f} ms, 99 % within {np.percentile(milliseconds, 99):.2f} ms")
print(f"{late:.1%} of the decisions late, {np.mean(candidates):.1f} candidates on average")
