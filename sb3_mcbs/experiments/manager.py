"""RL Zoo's ExperimentManager, for one run of an experiment."""

from pathlib import Path
from typing import ClassVar

from sb3_mcbs.agents.registry import ALGORITHMS, SEARCHING
from sb3_mcbs.checkpoints import ExactCheckpointCallback
from sb3_mcbs.experiments.evaluation import PolicyEvaluation, RunLog
from sb3_mcbs.experiments.plan import Run
from sb3_mcbs.experiments.results import RunFolder
from sb3_mcbs.zoo.manager import CHECKPOINTS, MCBSExperimentManager
from sb3_mcbs.zoo.paths import sibling_folder


class RunManager(MCBSExperimentManager):
    """
    Adds exact checkpoints, where the algorithm has them, and the log that all algorithms share.

    The parameters are those of ``rl_zoo3.exp_manager.ExperimentManager``.
    """

    #: What this process trains, and where.
    run: ClassVar[Run]
    folder: ClassVar[RunFolder]

    def create_callbacks(self) -> None:
        """Create RL Zoo's callbacks, and those of an experiment."""
        super().create_callbacks()
        has_own = any(isinstance(callback, ExactCheckpointCallback) for callback in self.callbacks)
        if self.algo in ALGORITHMS and not has_own:
            path = Path(self.save_path) / CHECKPOINTS
            self.callbacks.insert(0, ExactCheckpointCallback(self.run.checkpoint_every, path))
        self.callbacks.append(
            RunLog(self.run.evaluation.every, self.run.steps, self._policies(), self.folder.progress_file)
        )

    def _policies(self) -> list[PolicyEvaluation]:
        searches = self.algo in SEARCHING
        labels = ["actor", "search"] if searches or self.search_evaluation is not None else ["actor"]
        own = "search" if searches else "actor"
        seeds = self.run.evaluation.seeds
        policies = []
        for label in labels:
            is_other = label == "search" and not searches
            env = self._create_second_eval_envs() if is_other else self.create_envs(1, eval_env=True)
            folder = Path(self.save_path) if label == own else sibling_folder(self.save_path, label)
            settings = self.search_evaluation if is_other else None
            policies.append(PolicyEvaluation(env, label, settings, seeds, self.deterministic_eval, folder))
        return policies
