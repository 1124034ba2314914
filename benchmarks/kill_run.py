"""One run that may be killed at any moment: it begins or goes on, and says how it ended."""

import argparse
import glob
import hashlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecNormalize

from benchmarks import NETWORKS
from sb3_mcbs import MCBSDDPG, MCBSSAC, MCBSTD3, MCBSTQC, MCBSCrossQ, SnapshotEnvWrapper
from sb3_mcbs.checkpoints import ExactCheckpointCallback, resume
from sb3_mcbs.networks.functions import STOCHASTIC


class Case(NamedTuple):
    """What is trained on.

    :param env_id: the environment.
    :param n_envs: how many; more than one are in worker processes.
    :param normalized: whether ``VecNormalize`` is around them.
    :param zoo: whether networks and batches are those of RL Zoo, on two threads; else small, on one.
    """

    env_id: str
    n_envs: int = 1
    normalized: bool = False
    zoo: bool = False


CASES = {
    "HalfCheetah-v5": Case("HalfCheetah-v5", zoo=True),
    "Ant-v5": Case("Ant-v5"),
    "Walker2d-v5": Case("Walker2d-v5", 4, normalized=True),
    "Pendulum-v1": Case("Pendulum-v1"),
    "Pendulum-v1 in workers": Case("Pendulum-v1", 4, normalized=True),
}
ALGORITHMS: dict[str, tuple[type[OffPolicyAlgorithm], dict[str, Any]]] = {
    "mcbs_td3": (MCBSTD3, {"model_kwargs": {"n_threads": 1}}),
    "mcbs_ddpg": (MCBSDDPG, {"model_kwargs": {"n_threads": 1}}),
    "mcbs_sac": (MCBSSAC, {"model_kwargs": {"n_threads": 1}, "use_sde": True, "search_share": 0.5}),
    "mcbs_tqc": (MCBSTQC, {"model_kwargs": {"n_threads": 1}, "preset": "balanced"}),
    "mcbs_crossq": (MCBSCrossQ, {"model_kwargs": {"n_threads": 1}, "search_share": 0.5}),
    "mcbs_td3 with schedules": (
        MCBSTD3,
        {
            "model_kwargs": {"n_threads": 1},
            "search_schedule": "saturation",
            "search_unit": "episode",
            "search_share": 0.7,
            "schedule_kwargs": {"saturation_window": 1000},
        },
    ),
    "mcbs_td3 with expanded targets": (
        MCBSTD3,
        {
            "model_kwargs": {"n_threads": 1},
            "preset": "efficient",
            "search_unit": "episode",
            "search_share": 0.5,
            "value_expansion": 2,
        },
    ),
    # An error that it is allowed from the first fit, so that the searches use it.
    "mcbs_td3 with a learned model": (
        MCBSTD3,
        {
            "model_kwargs": {"n_threads": 1, "ensemble_max_error": 10.0},
            "preset": "efficient",
            "forward_model": "ensemble",
        },
    ),
    "td3": (TD3, {}),
    "sac": (SAC, {}),
    "td3_one_rollout": (TD3, {"train_freq": 1_000_000}),
}
RESULT, STARTED = "result.npz", "started"


class SayStarted(BaseCallback):
    """Leaves a mark when training goes on, so that whoever kills knows that there is something to kill.

    :param folder: where.
    """

    not_checkpointed = ("folder",)

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def _on_step(self) -> bool:
        (self.folder / STARTED).touch()
        return True


def make_env(case: str, folder: Path | None) -> VecEnv:
    """Make the environments of a case.

    :param case: a key of ``CASES``.
    :param folder: for Monitor's files; None makes one environment to evaluate in.
    """
    env_id, n_envs, normalized, _ = CASES[case]
    if folder is None:
        vec_env: VecEnv = make_vec_env(env_id, 1, seed=1000)
    else:
        vec_env = make_vec_env(
            env_id,
            n_envs,
            seed=0,
            monitor_dir=str(folder / "monitor"),
            wrapper_class=SnapshotEnvWrapper,
            vec_env_cls=SubprocVecEnv if n_envs > 1 else None,
        )
    return VecNormalize(vec_env, training=folder is not None) if normalized else vec_env


def make_agent(algorithm: str, case: str, folder: Path) -> OffPolicyAlgorithm:
    """Make a new agent that logs into a folder.

    :param algorithm: a key of ``ALGORITHMS``.
    :param case: a key of ``CASES``.
    :param folder: of the run.
    """
    cls, settings = ALGORITHMS[algorithm]
    agent = cls(
        "MlpPolicy",
        make_env(case, folder),
        learning_starts=200,
        buffer_size=1500,  # wraps around
        batch_size=256 if CASES[case].zoo else 64,
        policy_kwargs=dict(NETWORKS) if CASES[case].zoo else {"net_arch": [64, 64]},
        seed=0,
        device="cpu",
        **settings,
    )
    agent.set_logger(configure(str(folder / "log"), ["csv", "log", "tensorboard"]))
    return agent


def train(algorithm: str, case: str, folder: Path, steps: int, save_freq: int) -> None:
    """Begin a run or go on with it, to its end.

    :param algorithm: a key of ``ALGORITHMS``.
    :param case: a key of ``CASES``.
    :param folder: of the run.
    :param steps: environment steps in all.
    :param save_freq: environment steps between checkpoints.
    """
    th.set_num_threads(2 if CASES[case].zoo else 1)
    folder.mkdir(parents=True, exist_ok=True)
    checkpoints = folder / "checkpoints"
    begun = any(checkpoints.glob("step_*"))
    agent = resume(checkpoints) if begun else make_agent(algorithm, case, folder)
    callbacks = [
        ExactCheckpointCallback(save_freq, checkpoints),
        EvalCallback(
            make_env(case, None),
            n_eval_episodes=1,
            eval_freq=save_freq,
            log_path=str(folder / "evaluations"),
            verbose=0,
            warn=False,
        ),
        SayStarted(folder),
    ]
    agent.learn(steps, callback=callbacks)
    np.savez(folder / "unfinished.npz", allow_pickle=False, **ending(agent, folder))
    (folder / "unfinished.npz").rename(folder / RESULT)


def ending(agent: OffPolicyAlgorithm, folder: Path) -> dict[str, np.ndarray]:
    """Say how a run ended.

    :param agent: the agent.
    :param folder: of the run.
    :return: digests of all parameters, optimizers, learned model and replay buffer, episode returns and
        evaluations.
    """
    result = {f"parameter {name}": _digest(value) for name, value in agent.policy.state_dict().items()}
    for part in ("actor", "critic"):
        for index, state in getattr(agent, part).optimizer.state_dict()["state"].items():
            result |= {f"{part} optimizer {index} {name}": _digest(value) for name, value in state.items()}
    if isinstance(agent, STOCHASTIC) and agent.log_ent_coef is not None:
        result["logarithm of the entropy coefficient"] = _digest(agent.log_ent_coef.detach())
    if getattr(agent, "learned_model", None) is not None:
        ensemble = agent.learned_model.ensemble  # type: ignore[attr-defined]
        result["learned model"] = _digest(ensemble.parameters.detach())
        result["held-out error"] = np.array(ensemble.held_out_error)
    assert agent.replay_buffer is not None
    for name, value in vars(agent.replay_buffer).items():
        if isinstance(value, np.ndarray):
            result[f"replay buffer {name}"] = _digest(value)
    for path in sorted(glob.glob(str(folder / "monitor" / "*"))):
        rows = [line.split(",")[:2] for line in Path(path).read_text().splitlines()[2:]]
        result[f"returns {Path(path).name}"] = np.array(rows, dtype=np.float64).reshape(-1, 2)
    evaluations = np.load(folder / "evaluations" / "evaluations.npz")
    result |= {f"evaluations {name}": evaluations[name] for name in evaluations.files}
    return result


def _digest(value: th.Tensor | np.ndarray) -> np.ndarray:
    return np.array(hashlib.sha256(np.ascontiguousarray(np.asarray(value)).tobytes()).hexdigest())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("algorithm", choices=ALGORITHMS)
    parser.add_argument("case", choices=CASES)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--save-freq", type=int, required=True)
    arguments = parser.parse_args()
    train(**vars(arguments))


if __name__ == "__main__":
    main()
