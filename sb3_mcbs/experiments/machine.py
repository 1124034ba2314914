"""What a run runs on: versions and processor, and nothing that tells whose machine it is."""

import os
import platform
from typing import Any

from sb3_mcbs.checkpoints.settings import processor_name, versions

PACKAGES = (
    "sb3-mcbs",
    "stable-baselines3",
    "sb3-contrib",
    "rl-zoo3",
    "torch",
    "numpy",
    "gymnasium",
    "mujoco",
)


def describe_machine() -> dict[str, Any]:
    """
    :return: the system, the processor, its cores, and the versions of Python and of packages
    """
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": processor_name() or "unknown",
        "cores": os.cpu_count(),
        **versions(PACKAGES),
    }
