"""The end of an episode whose simulation gave up its state by itself."""

from typing import Any

#: Key in the ``info`` of a step in which the simulation diverged: the simulator reset itself, so that the
#: observation has nothing to do with the one before.
SIMULATION_DIVERGED = "simulation_diverged"

StepResult = tuple[Any, Any, bool, bool, dict[str, Any]]


class _LastStep:
    """Stands below a ``Monitor`` for one call."""

    def __init__(self, result: StepResult) -> None:
        self._result = result

    def step(self, action: Any) -> StepResult:
        return self._result


def diverged_step(result: StepResult, monitors: list[Any]) -> StepResult:
    """Make of a step in which the simulation diverged the end of an episode.

    :param result: what the environment returned.
    :param monitors: the environment's ``Monitor`` wrappers, which have taken note of the step already.
    :return: the same, truncated, with :data:`SIMULATION_DIVERGED` in ``info``. The reward is 0: the
        environment computed it from a jump.
    """
    observation, _, _, _, info = result
    info[SIMULATION_DIVERGED] = True
    ended = (observation, 0.0, False, True, info)
    for monitor in monitors:
        # They write down an episode, and allow a reset, only when they see its end.
        monitor.rewards.pop()
        monitor.total_steps -= 1
        below, monitor.env = monitor.env, _LastStep(ended)
        try:
            monitor.step(None)
        finally:
            monitor.env = below
    return ended
