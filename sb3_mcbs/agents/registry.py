"""The algorithms by their names on RL Zoo's command line."""

from sb3_contrib import TQC, CrossQ
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_mcbs.agents.mcbs import MCBS
from sb3_mcbs.agents.mcbs_crossq import MCBSCrossQ
from sb3_mcbs.agents.mcbs_ddpg import MCBSDDPG
from sb3_mcbs.agents.mcbs_sac import MCBSSAC
from sb3_mcbs.agents.mcbs_td3 import MCBSTD3
from sb3_mcbs.agents.mcbs_tqc import MCBSTQC

#: Without search: the baselines, and agents for :class:`~sb3_mcbs.SearchPolicy`.
BASELINES: dict[str, type[OffPolicyAlgorithm]] = {
    "td3": TD3,
    "ddpg": DDPG,
    "sac": SAC,
    "tqc": TQC,
    "crossq": CrossQ,
}
#: Algorithms that search while they train.
SEARCHING: dict[str, type[MCBS]] = {
    "mcbs_td3": MCBSTD3,
    "mcbs_ddpg": MCBSDDPG,
    "mcbs_sac": MCBSSAC,
    "mcbs_tqc": MCBSTQC,
    "mcbs_crossq": MCBSCrossQ,
}
ALGORITHMS: dict[str, type[OffPolicyAlgorithm]] = {**BASELINES, **SEARCHING}
