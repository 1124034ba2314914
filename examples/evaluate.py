"""Compare the actor alone with the actor with search, in the same episodes, and say what each costs.

python examples/evaluate.py agent.zip --env HalfCheetah-v5 --presets efficient balanced
"""

import argparse
import time

from stable_baselines3.common.env_util import make_vec_env

from sb3_mcbs import SearchPolicy, load_agent

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("agent", help="a zip of TD3, DDPG, SAC, TQC or CrossQ, or of one of our agents")
parser.add_argument("--env", default="HalfCheetah-v5")
parser.add_argument("--presets", nargs="+", default=["efficient"])
parser.add_argument("--episodes", type=int, default=5)
args = parser.parse_args()

env = make_vec_env(args.env)
model = load_agent(args.agent, env)  # runs no code from the file
policies = {"actor alone": model}
policies |= {name: SearchPolicy(model, env, preset=name, seed=0) for name in args.presets}
print(f"{'':12} {'return':>10} {'simulated steps':>16} {'ms per action':>14}")
for name, policy in policies.items():
    rewards = simulated = steps = seconds = 0.0
    for episode in range(args.episodes):
        env.seed(episode)
        observation, done = env.reset(), [False]
        while not done[0]:
            start = time.perf_counter()
            action, _ = policy.predict(observation, deterministic=True)
            seconds += time.perf_counter() - start
            simulated += policy.last_result.simulated_steps if policy is not model else 0
            observation, reward, done, _ = env.step(action)
            rewards, steps = rewards + reward[0], steps + 1
    print(f"{name:12} {rewards / args.episodes:10.1f} {simulated:16,.0f} {1000 * seconds / steps:14.2f}")
