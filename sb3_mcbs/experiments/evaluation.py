"""The log that all algorithms share: what a run's policies return in the same episodes, and what it cost."""

import json
import time
from collections.abc import Collection
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, sync_envs_normalization

from sb3_mcbs.agents import SearchPolicy
from sb3_mcbs.agents.episodes import play
from sb3_mcbs.experiments.results import write

#: What every ``evaluations.npz`` has: the first three as SB3's ``EvalCallback`` writes them.
ARRAYS = ("timesteps", "results", "ep_lengths", "seeds", "simulated_steps", "seconds")
#: Seconds between two reports of progress.
_REPORT_EVERY = 1.0


def write_evaluations(folder: Path, arrays: dict[str, Any]) -> None:
    """
    :param folder: where ``evaluations.npz`` is to be
    :param arrays: its content, all of :data:`ARRAYS`
    """
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / ".evaluations.npz"
    content: dict[str, Any] = {name: np.asarray(arrays[name]) for name in ARRAYS}
    np.savez(partial, **content)
    partial.replace(folder / "evaluations.npz")


class PolicyEvaluation(BaseCallback):
    """
    One policy of an agent, evaluated in episodes with given reset seeds; :class:`RunLog` says when.

    Its ``evaluations.npz`` has what an ``EvalCallback`` writes (``timesteps``, ``results``, ``ep_lengths``)
    and besides ``seeds`` of the episodes, and by evaluation the ``simulated_steps`` and ``seconds`` that
    training had taken, without those of evaluations.

    :param eval_env: an environment of its own
    :param label: what is evaluated, ``actor`` or ``search``
    :param search_settings: settings of the search; None: those that the agent trains with, if it searches
    :param seeds: of the episodes
    :param deterministic: whether actions are
    :param log_path: the folder to write to
    """

    def __init__(
        self,
        eval_env: VecEnv,
        label: str,
        search_settings: dict[str, Any] | None,
        seeds: list[int],
        deterministic: bool,
        log_path: Path,
    ) -> None:
        super().__init__()
        self.eval_env = eval_env
        self.label = label
        self.search_settings = search_settings
        self.seeds = seeds
        self.deterministic = deterministic
        self.log_path = log_path
        self.timesteps: list[int] = []
        self.results: list[list[float]] = []
        self.ep_lengths: list[list[int]] = []
        self.simulated_steps: list[int] = []
        self.seconds: list[float] = []

    def init_callback(self, model: BaseAlgorithm) -> None:
        """
        :param model: the agent
        """
        if self.label == "search":
            assert isinstance(model, OffPolicyAlgorithm), "no other algorithm searches"
            settings = self.search_settings or {}
            super().init_callback(SearchPolicy(model, self.eval_env, seed=model.seed, **settings))  # type: ignore[arg-type]
        else:
            super().init_callback(model)

    def evaluate(self, seconds: float) -> None:
        """
        Evaluate the policy as it is now, and write all its evaluations.

        :param seconds: that training took until now
        """
        if isinstance(self.eval_env, VecNormalize):
            sync_envs_normalization(self.training_env, self.eval_env)
        episodes = [play(self.model, self.eval_env, seed, self.deterministic) for seed in self.seeds]
        returns, lengths = [each.total for each in episodes], [each.length for each in episodes]
        self.timesteps.append(self.num_timesteps)
        self.results.append(returns)
        self.ep_lengths.append(lengths)
        self.simulated_steps.append(int(getattr(self.model, "n_simulated_steps", 0)))
        self.seconds.append(seconds)
        self._write()
        name = "with search" if self.label == "search" else "alone"
        print(
            f"Actor {name} after {self.num_timesteps} steps: {np.mean(returns):.2f} +/- {np.std(returns):.2f}"
        )

    def _write(self) -> None:
        write_evaluations(self.log_path, {name: getattr(self, name) for name in ARRAYS})

    def _on_step(self) -> bool:
        return True


class RunLog(BaseCallback):
    """
    Evaluates an agent's policies at fixed steps, and says how far the run is.

    :param every: environment steps between two evaluations
    :param last: the step after which there is none
    :param policies: what to evaluate
    :param progress_path: the file that says how far the run is
    """

    not_checkpointed: ClassVar[Collection[str]] = {
        "_since": "a time of this process",
        "_next_report": "a time of this process",
    }

    def __init__(self, every: int, last: int, policies: list[PolicyEvaluation], progress_path: Path) -> None:
        super().__init__()
        self.every = every
        self.last = last
        self.policies = policies
        self.progress_path = progress_path
        self.seconds = 0.0
        self._next = every
        self._since = 0.0
        self._next_report = 0.0

    def init_callback(self, model: BaseAlgorithm) -> None:
        """
        :param model: the agent
        """
        super().init_callback(model)
        for policy in self.policies:
            policy.init_callback(model)

    def _on_training_start(self) -> None:
        self._since = time.perf_counter()
        for policy in self.policies:
            policy.on_training_start(self.locals, self.globals)

    def _on_step(self) -> bool:
        now = time.perf_counter()
        self.seconds += now - self._since
        due = self._next <= min(self.num_timesteps, self.last)
        if due:
            self._next = (self.num_timesteps // self.every + 1) * self.every
            for policy in self.policies:
                policy.num_timesteps = self.num_timesteps
                policy.evaluate(self.seconds)
        self._since = time.perf_counter()
        if due or now >= self._next_report:
            self._next_report = now + _REPORT_EVERY
            self._report()
        return True

    def _report(self) -> None:
        progress = {
            "step": self.num_timesteps,
            "evaluations": len(self.policies[0].results),
            "returns": {
                each.label: float(np.mean(each.results[-1])) for each in self.policies if each.results
            },
        }
        try:
            write(self.progress_path, json.dumps(progress) + "\n")
        except OSError as error:
            print(f"{self.progress_path} could not be written: {error}")
