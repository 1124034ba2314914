"""Agents on the Hugging Face hub. Files of strangers are read without running code from them."""

import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_mcbs.agents import MCBS, SearchPolicy
from sb3_mcbs.loading import AgentFileError, load_agent, load_statistics, save_statistics
from sb3_mcbs.search.settings import OF_THE_MACHINE

AGENT, STATISTICS, SEARCH = "agent.zip", "statistics.npz", "search.json"
#: Of RL Zoo's repositories, which have no settings of a search, and statistics in a pickle.
_PICKLE, _NOT_AGENTS = "vec_normalize.pkl", ("train_eval_metrics.zip",)
#: How a model card shows the file ``replay``, a name that the hub itself looks for.
_VIDEOS = {
    ".mp4": '<video src="replay.mp4" controls autoplay loop muted></video>',
    ".gif": "![The agent with search](replay.gif)",
}
_CARD = """\
---
{metadata}---

# {algorithm} for {environment}

A {algorithm} agent for {environment} that looks ahead before it acts, with sb3-mcbs.

{video}| | mean return | standard deviation | episodes |
|---|---|---|---|
{rows}

The settings of the search:

{settings}

To act with it (`pip install 'sb3-mcbs[hub]'`; no code from these files is run):

```python
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_mcbs import load_from_hub

policy = load_from_hub("{repo_id}", make_vec_env("{environment}"))
print(evaluate_policy(policy, policy.vec_env))  # policy.model is the actor alone
```
"""


def push_to_hub(
    repo_id: str,
    file: str | Path,
    policy: SearchPolicy,
    environment: str,
    returns: Mapping[str, Sequence[float]],
    *,
    video: str | Path | None = None,
    private: bool = False,
    token: str | None = None,
) -> str:
    """
    Upload an agent with its statistics, its search settings and a model card. ``sb3-mcbs push`` does it all.

    :param repo_id: ``user/name``; made if it is not there
    :param file: the agent, as its ``save`` wrote it
    :param policy: the agent with search; its settings, and the statistics of its environment's
        ``VecNormalize``, are uploaded
    :param environment: its id
    :param returns: of some episodes, by what acted (``"actor alone"``, ``"actor with search"``)
    :param video: an ``.mp4`` or ``.gif``
    :param private: whether a new repository is private
    :param token: of the hub; None: the one of ``hf auth login``
    :return: the address of the commit
    :raises ImportError: if ``huggingface_hub`` is not installed
    """
    hub = import_hub()
    with tempfile.TemporaryDirectory() as folder:
        write_repository(Path(folder), repo_id, file, policy, environment, returns, video)
        api = hub.HfApi(token=token)
        api.create_repo(repo_id, private=private, exist_ok=True)
        message = f"{type(policy.model).__name__} for {environment}, by sb3-mcbs"
        return str(api.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=message))


def load_from_hub(
    repo_id: str,
    env: VecEnv,
    *,
    revision: str | None = None,
    token: str | None = None,
    normalize_reward: bool | None = None,
    **settings: Any,
) -> SearchPolicy:
    """
    Load an agent that :func:`push_to_hub` or RL Zoo uploaded, with search. No code from the files is run.

    The agent alone is the ``model`` of the returned policy. If its observations are normalised, act in
    ``policy.vec_env``, which is ``env`` with the statistics of the training.

    :param repo_id: ``user/name``
    :param env: the environment to act in, ``make_vec_env(...)`` as in training
    :param revision: a branch, tag or commit; name a commit to always get the same files
    :param token: of the hub, for private repositories; None: the one of ``hf auth login``
    :param normalize_reward: as for :class:`~sb3_mcbs.SearchPolicy`. None: as uploaded
    :param settings: further arguments of :class:`~sb3_mcbs.SearchPolicy` (``preset``, ``seed``, ...). Without
        those of the search the uploaded ones are used, or for agents of RL Zoo ``preset="efficient"``
    :return: the agent with search
    :raises ImportError: if ``huggingface_hub`` is not installed
    :raises AgentFileError: if the repository has no agent, or one that cannot be read safely
    """
    hub = import_hub()
    patterns = ["*.zip", "*.npz", SEARCH, _PICKLE]
    folder = hub.snapshot_download(
        repo_id, revision=revision, token=token, allow_patterns=patterns, ignore_patterns=list(_NOT_AGENTS)
    )
    return read_repository(Path(folder), env, normalize_reward, **settings)


def import_hub() -> Any:
    """
    :return: ``huggingface_hub``
    :raises ImportError: if it is not installed
    """
    try:
        import huggingface_hub
    except ImportError as error:
        raise ImportError("The hub needs huggingface_hub: pip install 'sb3-mcbs[hub]'") from error
    return huggingface_hub


def check_video(video: str | Path | None) -> None:
    """
    :param video: what a model card shall show, if anything
    :raises FileNotFoundError: if it is not there
    :raises ValueError: if it is of another kind
    """
    if video is None:
        return
    if Path(video).suffix not in _VIDEOS:
        raise ValueError(f"A model card shows .mp4 and .gif, not {video}.")
    if not Path(video).is_file():
        raise FileNotFoundError(f"There is no video {video}.")


def write_repository(
    folder: Path,
    repo_id: str,
    file: str | Path,
    policy: SearchPolicy,
    environment: str,
    returns: Mapping[str, Sequence[float]],
    video: str | Path | None = None,
) -> None:
    """
    Write what :func:`push_to_hub` uploads.

    :param folder: an empty folder; the other parameters are those of :func:`push_to_hub`
    :raises FileNotFoundError: if there is no such agent or video
    :raises ValueError: if the video is of another kind
    """
    check_video(video)
    shutil.copyfile(file, folder / AGENT)
    normalizer = unwrap_vec_normalize(policy.vec_env)
    if normalizer is not None:
        save_statistics(normalizer, folder / STATISTICS)
    found = {
        "algorithm": type(policy.model).__name__,
        "environment": environment,
        "normalize_reward": policy.planner.normalize_reward is True,
        "search": {
            name: value for name, value in policy.settings.grouped().items() if name not in OF_THE_MACHINE
        },
    }
    (folder / SEARCH).write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    shown = None
    if video is not None:
        shown = f"replay{Path(video).suffix}"
        shutil.copyfile(video, folder / shown)
    card = model_card(repo_id, found, returns, shown)
    (folder / "README.md").write_text(card, encoding="utf-8")


def model_card(
    repo_id: str, found: Mapping[str, Any], returns: Mapping[str, Sequence[float]], video: str | None
) -> str:
    """
    :param repo_id: ``user/name``
    :param found: the content of ``search.json``
    :param returns: see :func:`push_to_hub`
    :param video: its name in the repository
    :return: the page of the repository, in Markdown
    """
    algorithm, environment = found["algorithm"], found["environment"]
    measured = {name: (np.mean(each), np.std(each), len(each)) for name, each in returns.items()}
    metrics = [
        {"type": "mean_reward", "name": name, "value": f"{mean:.2f} +/- {std:.2f}", "verified": False}
        for name, (mean, std, _) in measured.items()
    ]
    task = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
    result = {"task": task, "dataset": {"name": environment, "type": environment}, "metrics": metrics}
    metadata = {
        "library_name": "stable-baselines3",
        "tags": [environment, "deep-reinforcement-learning", "reinforcement-learning", "sb3-mcbs"],
        "model-index": [{"name": algorithm, "results": [result]}],
    }
    rows = [f"| {name} | {mean:.1f} | {std:.1f} | {n} |" for name, (mean, std, n) in measured.items()]
    settings = [f"    {name}: {value!r}" for name, value in found["search"].items() if value is not None]
    return _CARD.format(
        metadata=yaml.safe_dump(metadata, sort_keys=False),
        algorithm=algorithm,
        environment=environment,
        video="" if video is None else f"{_VIDEOS[Path(video).suffix]}\n\n",
        rows="\n".join(rows),
        settings="\n".join(settings),
        repo_id=repo_id,
    )


def read_repository(
    folder: Path, env: VecEnv, normalize_reward: bool | None = None, **settings: Any
) -> SearchPolicy:
    """
    Read the downloaded files; the parameters and errors are those of :func:`load_from_hub`.

    :param folder: with the files of a repository
    """
    files = [path for path in sorted(folder.glob("*.zip")) if path.name not in _NOT_AGENTS]
    if len(files) != 1:
        names = ", ".join(path.name for path in files) or "none"
        raise AgentFileError(
            f"The repository must have one agent in a zip, and has {names}. Download a file with "
            "huggingface_hub.hf_hub_download and give it to load_agent."
        )
    found = _read_settings(folder / SEARCH)
    statistics = folder / STATISTICS
    if not statistics.is_file() and (folder / _PICKLE).is_file():
        raise AgentFileError(
            f"The observations are normalised, with statistics in a pickle ({_PICKLE}), which runs its "
            "author's code when it is opened. If you trust the author, download both files, convert the "
            "pickle with sb3-mcbs convert-statistics, and use load_agent and load_statistics."
        )
    if statistics.is_file():
        env = load_statistics(statistics, env)
        env.norm_reward = False  # returns in their own unit
        if normalize_reward is None:
            normalize_reward = found.get("normalize_reward")
    agent = load_agent(files[0], env)
    if not {*settings} - {"seed"}:
        # Settings that are not named have their defaults, not those of the agent's training.
        default = {} if isinstance(agent, MCBS) else {"preset": "efficient"}
        settings |= {"preset": "paper", **found["search"]} if "search" in found else default
    return SearchPolicy(agent, env, normalize_reward=normalize_reward, **settings)


def _read_settings(path: Path) -> dict[str, Any]:
    """:param path: of ``search.json``; an agent of RL Zoo has none."""
    if not path.is_file():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise AgentFileError(f"{path.name} is damaged: {error}.") from error
    known = {"beam_width", "rollout_depth", "n_simulations", "beam_noise", "strategy", "search_kwargs"}
    search = found.get("search", {}) if isinstance(found, dict) else None
    if not isinstance(search, dict) or not set(search) <= known:
        raise AgentFileError(
            f"{path.name} must hold the settings of a search, only {', '.join(sorted(known))}."
        )
    if not isinstance(found.get("normalize_reward", False), bool):
        raise AgentFileError(f"normalize_reward in {path.name} must be true or false.")
    return found
