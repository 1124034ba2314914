"""SAC that looks ahead before it acts."""

from typing import Any

import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.sac.policies import SACPolicy

from sb3_mcbs.agents.hyperparameters import sb3_arguments
from sb3_mcbs.agents.mcbs import MCBS


class MCBSSAC(MCBS, SAC):
    """
    Monte Carlo Beam Search for SAC (MCBS-SAC).

    As :class:`~sb3_mcbs.MCBSTD3`, with the losses of SAC: ``matmul_precision`` holds for them too.
    Searched actions lie around the actor's mean action, not around one that the actor (or gSDE) drew, and
    rollouts end with the minimum of the critics' values, without an entropy term. Before ``learning_starts``
    the agent acts as SAC does.

    ``predict`` is the actor alone, without search, as for every SB3 algorithm: it needs no environment.
    To act with search use :class:`~sb3_mcbs.SearchPolicy`.

    What is simulated needs environments in :class:`~sb3_mcbs.SnapshotEnvWrapper`: the algorithm wraps them
    itself, except in a ``SubprocVecEnv``, where they must be wrapped when they are made.

    The parameters before ``beam_width`` are those of :class:`~stable_baselines3.SAC`. What there is to
    say of them here:

    :param learning_starts: how many steps of the model to collect transitions for before learning, and
        searching, starts
    :param gamma: the discount factor, of the critics and of the rollouts
    :param action_noise: noise on actions chosen without search (before ``learning_starts`` and where
        the schedule leaves the search out). Searched actions are executed as they are unless
        ``action_noise_after_search`` is set.
    :param use_sde: Whether to use generalized State Dependent Exploration (gSDE), for actions chosen without
        search and for the losses
    :param seed: Seed for the pseudo random generators, the search's own included
    :param device: Device (cpu, cuda, ...) on which the networks run; simulation is on the CPU
    :param beam_width: number of candidate actions per decision (None: the preset's, or 6)
    :param rollout_depth: simulated steps per rollout; 0 ranks by the critics alone (None: the preset's, or 3)
    :param n_simulations: rollouts per candidate (None: the preset's, or 5)
    :param beam_noise: spread of the candidates, in scaled actions (None: the preset's, or 0.1)
    :param strategy: ``"beam"``, ``"tree"`` or ``"cem"`` (None: the preset's, or ``"beam"``)
    :param search_kwargs: additional settings of the strategy, see :class:`~sb3_mcbs.BeamSettings`,
        :class:`~sb3_mcbs.TreeSettings` and :class:`~sb3_mcbs.CEMSettings`
    :param preset: a name of :data:`~sb3_mcbs.search.PRESETS`: where the settings of the search start from
    :param search_schedule: when to search: ``"constant"``, ``"saturation"`` or ``"anneal"``
    :param search_share: the share of decisions that are searched
    :param search_unit: whether that is drawn for every ``"step"`` or every ``"episode"``
    :param schedule_kwargs: additional settings of the schedule, see
        :class:`~sb3_mcbs.agents.ScheduleSettings`
    :param forward_model: what simulates: ``"auto"``, ``"mujoco"``, ``"pool"`` or ``"ensemble"`` (learned)
    :param model_kwargs: additional settings of that: ``n_threads``, and for ``"ensemble"`` those of
        :class:`~sb3_mcbs.agents.EnsembleSettings`
    :param value_expansion: simulated steps before the critics' targets close (0: none, as SB3)
    :param expanded_share: the share of every batch that this is done for
    :param action_noise_after_search: add ``action_noise`` to searched actions too
    :param matmul_precision: of the networks' float32 products (None: as the process has it)
    """

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
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
        strategy: str | None = None,
        search_kwargs: dict[str, Any] | None = None,
        preset: str | None = None,
        search_schedule: str = "constant",
        search_share: float = 1.0,
        search_unit: str = "step",
        schedule_kwargs: dict[str, Any] | None = None,
        forward_model: str = "auto",
        model_kwargs: dict[str, Any] | None = None,
        value_expansion: int = 0,
        expanded_share: float = 0.5,
        action_noise_after_search: bool = False,
        matmul_precision: str | None = None,
    ) -> None:
        super().__init__(**sb3_arguments(locals()))
        self._init_search(locals())

        if _init_setup_model:
            self._setup_model()
