"""The block for a hyperparameter file that fits what the doctor found."""

from pathlib import Path
from typing import Any

import yaml

from sb3_mcbs.agents.hyperparameters import SETTINGS
from sb3_mcbs.zoo.environments import is_file
from sb3_mcbs.zoo.paths import hyperparams_path

#: Entries of this package's files whose search is known to suit such environments.
FAST, NOTHING_SIMULATED = "HalfCheetah-v5", "LunarLanderContinuous-v3"
_SNAPSHOTS = "sb3_mcbs.SnapshotEnvWrapper"


def recipe(findings: dict[str, Any], name: str, wrappers: list[str], exact: bool, simulate: bool) -> str:
    """
    Write an entry of a hyperparameter file, below comments that say how to use it.

    :param findings: of the doctor
    :param name: of the environment
    :param wrappers: of the environment
    :param exact: whether it can be simulated exactly
    :param simulate: whether training can afford to simulate
    :return: YAML
    """
    # Without an agent, the algorithm that needs the fewest steps; it takes no images and dictionaries.
    base = "crossq" if findings["environment"]["policy"] == "MlpPolicy" else "td3"
    algo = f"mcbs_{findings.get('agent', {}).get('base', base)}"
    known = yaml.safe_load(hyperparams_path(algo).read_text())
    module, _, function = name.rpartition(":")
    env_id = f"{findings['environment']['class']}-v0" if is_file(name) else function
    options = "-conf doctor.yml"
    if module:
        options += f" --gym-packages {Path(module).stem if is_file(name) else module}"
    lines = [f"# python -m rl_zoo3.train --algo {algo} --env {env_id} \\", f"#     {options}"]
    if is_file(name):
        lines += [
            "# RL Zoo finds environments by their id. Give yours one at the end of the file:",
            f'#     gymnasium.register("{env_id}", entry_point="{Path(module).stem}:{function}")',
            "# and train in its folder.",
        ]
    entry = known.get(env_id) if not wrappers else None
    if entry is None or not exact or (entry.get("rollout_depth") == 0) == simulate:
        like = known.get(env_id, known["default"])
        entry = {key: value for key, value in like.items() if key not in SETTINGS}
        entry |= _search(known, findings, exact, simulate)
    layers = [*wrappers, _SNAPSHOTS] if exact else wrappers
    entry = {key: value for key, value in entry.items() if key != "env_wrapper"}
    entry["policy"] = findings["environment"]["policy"]
    if findings.get("agent", {}).get("normalize"):
        entry["normalize"] = str(findings["agent"]["normalize"])
    if layers:
        entry["env_wrapper"] = layers if len(layers) > 1 else layers[0]
    if not module and entry == known.get(env_id):
        lines.append("# This is the entry that sb3-mcbs has anyway, so -conf may be left out.")
    return "\n".join([*lines, yaml.safe_dump({env_id: entry}, sort_keys=False).rstrip()])


def _search(known: dict[str, Any], findings: dict[str, Any], exact: bool, simulate: bool) -> dict[str, Any]:
    """The settings of a search that suits an environment."""
    model = findings.get("forward_model", {})
    if not exact or not simulate:
        like = known[NOTHING_SIMULATED]
    elif not model["deterministic"]:
        like = known["default"]
    elif model["kind"] == "pool":
        return {"preset": "efficient", "search_share": 0.5, "search_unit": "episode"}
    else:
        like = known[FAST]
    # With simulated transitions the actor is updated more often.
    return {key: value for key, value in like.items() if key in (*SETTINGS, "policy_delay")}
