"""Train with search: MCBS-TD3 or MCBS-CrossQ, with the recipe that trained best on HalfCheetah.

python examples/train.py --algo crossq --env HalfCheetah-v5 --steps 60000 -o crossq.zip
"""

import argparse

from sb3_mcbs import MCBSTD3, MCBSCrossQ

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--algo", choices=["td3", "crossq"], default="crossq")
parser.add_argument("--env", default="HalfCheetah-v5", help="an environment that MuJoCo simulates")
parser.add_argument("--steps", type=int, default=60_000)
parser.add_argument("--learning-starts", type=int, default=5_000)
parser.add_argument("--net-arch", type=int, nargs="+", default=[256, 256])
parser.add_argument("-o", "--output", default="agent.zip")
args = parser.parse_args()

algorithm = {"td3": MCBSTD3, "crossq": MCBSCrossQ}[args.algo]
model = algorithm(
    "MlpPolicy",
    args.env,
    learning_starts=args.learning_starts,
    policy_kwargs=dict(net_arch=args.net_arch),
    preset="train",  # search in half of the episodes, and learn from simulated transitions
    policy_delay={"td3": 2, "crossq": 1}[args.algo],
    seed=0,
    verbose=1,
)
model.learn(args.steps)
model.save(args.output)
