"""Act with search around your own trained agent, here SAC under VecNormalize.

python examples/trained_agent.py sac.zip --env Pendulum-v1 --vecnormalize vecnormalize.pkl
"""

import argparse

from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs import SearchPolicy

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("agent", help="the zip that agent.save() wrote")
parser.add_argument("--env", default="HalfCheetah-v5")
parser.add_argument("--vecnormalize", help="the statistics of the training, if it used VecNormalize")
parser.add_argument("--preset", default="efficient", help="efficient, balanced, strong or paper")
parser.add_argument("--episodes", type=int, default=5)
args = parser.parse_args()

env = make_vec_env(args.env)
if args.vecnormalize:
    env = VecNormalize.load(args.vecnormalize, env)
    env.training = False  # keep the statistics as they are
    env.norm_reward = False  # report returns in their own unit
model = SAC.load(args.agent)  # or TD3, DDPG, TQC, CrossQ
# The critics learned scaled rewards, unless the training said VecNormalize(env, norm_reward=False).
searching = SearchPolicy(model, env, preset=args.preset, seed=0, normalize_reward=bool(args.vecnormalize))

for name, policy in (("actor alone", model), ("actor with search", searching)):
    env.seed(0)  # the same episodes for both
    mean, std = evaluate_policy(policy, env, n_eval_episodes=args.episodes)
    print(f"{name}: {mean:.1f} +- {std:.1f}")
