"""CrossQ that looks ahead before it acts."""

from typing import Any

import torch as th
from sb3_contrib import CrossQ
from sb3_contrib.crossq.policies import CrossQPolicy
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_mcbs.agents.hyperparameters import sb3_arguments
from sb3_mcbs.agents.mcbs import MCBS
from sb3_mcbs.networks.crossq_update import CrossQSteps
from sb3_mcbs.types import Backend, MatmulPrecision, Preset, ScheduleName, SearchUnit, Strategy


class MCBSCrossQ(MCBS, CrossQSteps, CrossQ):
    """
    Monte Carlo Beam Search for CrossQ (MCBS-CrossQ).

    Like :class:`~sb3_mcbs.MCBSTD3`, with the losses of CrossQ. Candidates are around the actor's mean action,
    not around a sample of the actor (or gSDE), and rollouts bootstrap from the minimum of the critics,
    without an entropy term. Before ``learning_starts`` the agent acts as CrossQ.

    ``predict`` is the actor alone, without search, as for every SB3 algorithm: it needs no environment.
    To act with search use :class:`~sb3_mcbs.SearchPolicy`.

    Simulation needs environments in :class:`~sb3_mcbs.SnapshotEnvWrapper`. The algorithm wraps them itself,
    except in a ``SubprocVecEnv``, where they must be wrapped when they are made.

    The parameters before ``beam_width`` are those of :class:`~sb3_contrib.CrossQ`. Those that the
    search affects, and its own:

    :param learning_starts: how many steps of the model to collect transitions for before learning and
        searching start
    :param gamma: the discount factor of the critics and of the rollouts
    :param action_noise: noise on actions chosen without search (before ``learning_starts`` and where the
        schedule leaves the search out), and on searched ones if ``action_noise_after_search`` is set
    :param policy_delay: gradient steps of the critics for each one of the actor
    :param use_sde: Whether to use generalized State Dependent Exploration (gSDE), for actions chosen without
        search and for the losses
    :param seed: Seed for the pseudo random generators, including the search's own
    :param device: Device (cpu, cuda, ...) of the networks; simulation runs on the CPU
    :param beam_width: number of candidate actions per decision (None: the preset's, or 6)
    :param rollout_depth: simulated steps per rollout; 0 ranks by the critics alone (None: the preset's, or 3)
    :param n_simulations: rollouts per candidate (None: the preset's, or 5)
    :param beam_noise: standard deviation of candidates, in scaled actions (None: the preset's, or 0.1)
    :param strategy: ``"beam"``, ``"tree"`` or ``"cem"`` (None: the preset's, or ``"beam"``)
    :param search_kwargs: additional settings of the strategy, see :class:`~sb3_mcbs.BeamSettings`,
        :class:`~sb3_mcbs.TreeSettings` and :class:`~sb3_mcbs.CEMSettings`
    :param preset: one of :data:`~sb3_mcbs.search.PRESETS`, from which the settings of the search start;
        ``"train"`` also searches in half of the episodes, and learns from simulated transitions where batched
        MuJoCo simulates
    :param search_schedule: when to search: ``"constant"``, ``"saturation"`` or ``"anneal"``
    :param search_share: the share of decisions that are searched (None: the preset's, or 1)
    :param search_unit: whether search is drawn for every ``"step"`` or every ``"episode"`` (None: the
        preset's, or ``"step"``)
    :param schedule_kwargs: additional settings of the schedule, see
        :class:`~sb3_mcbs.agents.ScheduleSettings`
    :param forward_model: the simulator: ``"auto"``, ``"mujoco"``, ``"pool"`` or ``"ensemble"`` (learned)
    :param model_kwargs: additional settings of the forward model: ``n_threads``, and for ``"ensemble"`` those
        of :class:`~sb3_mcbs.agents.EnsembleSettings`
    :param value_expansion: simulated steps before critic targets bootstrap (0: none, as in SB3; None: the
        preset's, or 0)
    :param expanded_share: the share of every batch that is expanded
    :param branch_length: expand simulated transitions of the current actor instead of stored ones: the
        length of its rollouts from stored states (0: none; None: the preset's, or 0)
    :param action_noise_after_search: add ``action_noise`` to searched actions too
    :param matmul_precision: precision of the networks' float32 products (None: the process's setting)
    :param fast_update: compute gradient steps of plain MLPs with SB3's mathematics but fewer instructions;
        other networks use SB3's own
    :param cuda_graphs: on a GPU, capture the gradient steps of plain MLPs in CUDA graphs;
        other networks use SB3's own steps
    """

    def __init__(
        self,
        policy: str | type[CrossQPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        policy_delay: int = 3,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        use_sde_at_warmup: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        *,
        beam_width: int | None = None,
        rollout_depth: int | None = None,
        n_simulations: int | None = None,
        beam_noise: float | None = None,
        strategy: Strategy | None = None,
        search_kwargs: dict[str, Any] | None = None,
        preset: Preset | None = None,
        search_schedule: ScheduleName = "constant",
        search_share: float | None = None,
        search_unit: SearchUnit | None = None,
        schedule_kwargs: dict[str, Any] | None = None,
        forward_model: Backend = "auto",
        model_kwargs: dict[str, Any] | None = None,
        value_expansion: int | None = None,
        expanded_share: float = 0.5,
        branch_length: int | None = None,
        action_noise_after_search: bool = False,
        matmul_precision: MatmulPrecision | None = None,
        fast_update: bool = True,
        cuda_graphs: bool = True,
    ) -> None:
        super().__init__(**sb3_arguments(locals()))
        self._init_search(locals())
        self.fast_update = fast_update
        self.cuda_graphs = cuda_graphs

        if _init_setup_model:
            self._setup_model()
