"""Train with exact checkpoints. Stop it at any time and run it again: the result is the same, bit for bit.

python examples/resume.py run --steps 20000
"""

import argparse
from pathlib import Path

import torch as th

from sb3_mcbs import MCBSTD3, ExactCheckpointCallback, resume

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("folder", type=Path)
parser.add_argument("--env", default="HalfCheetah-v5")
parser.add_argument("--steps", type=int, default=20_000)
parser.add_argument("--save-freq", type=int, default=5_000)
args = parser.parse_args()

checkpoints = args.folder / "checkpoints"
if checkpoints.exists():
    model = resume(checkpoints)
else:
    model = MCBSTD3("MlpPolicy", args.env, preset="efficient", learning_starts=args.steps // 2, seed=0)
# Ctrl-C writes a checkpoint and ends the process; after a kill or a power cut the last one is taken.
model.learn(args.steps, callback=[ExactCheckpointCallback(args.save_freq, checkpoints)])
model.save(args.folder / "agent.zip")
weights = th.cat([parameter.flatten() for parameter in model.actor.parameters()])
print(f"{model.num_timesteps} steps, sum of the actor's weights: {weights.double().sum().item()!r}")
