"""What a run runs on: versions and processor, and nothing that tells whose machine it is."""

import os
import platform
from pathlib import Path
from typing import Any

from sb3_mcbs.checkpoints.settings import versions

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


def processor_name() -> str:
    """
    :return: its name, which Python's own function knows on few systems; nothing if nobody knows it
    """
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
