"""The process that examines an environment: it may hang or crash without taking the doctor along.

It writes a line of JSON for each thing that it begins, and for each that it finds out.
"""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_mcbs.agents import SearchPolicy
from sb3_mcbs.agents.episodes import play
from sb3_mcbs.agents.registry import BASELINES
from sb3_mcbs.doctor import questions
from sb3_mcbs.loading import load_agent
from sb3_mcbs.models import ForwardModelError
from sb3_mcbs.search import PRESETS
from sb3_mcbs.snapshot import SnapshotError
from sb3_mcbs.snapshot.verification import InexactError
from sb3_mcbs.zoo.environments import (
    NoEnvironmentError,
    find_environment,
    in_words,
    make_searchable,
    normalized,
)

#: A decision that would take longer is not measured.
MOST_SECONDS = 10.0
_FLAGS = ("norm_obs", "norm_reward")
#: Their messages say what is wrong and what to do. What else is raised comes from the environment.
_PLAIN = (NoEnvironmentError, questions.UnsuitableError, SnapshotError, ForwardModelError)


class Request(NamedTuple):
    """
    What to examine.

    :param environment: its name
    :param wrappers: names of its wrappers, innermost first
    :param agent: the file of an agent; None: none
    :param statistics: of its observations; None: they are not normalized
    :param trusted: whether statistics that are a pickle may be opened
    :param episodes: how many the agent plays with each policy
    :param seconds: that the episodes of one policy may take
    """

    environment: str
    wrappers: list[str]
    agent: str | None
    statistics: str | None
    trusted: bool
    episodes: int
    seconds: float


class Examination:
    """
    Asks one question after the other.

    :param request: what to examine
    :param tell: told of each stage that begins, and of each finding
    """

    def __init__(self, request: Request, tell: Callable[[dict[str, Any]], None]) -> None:
        self.request = request
        self.tell = tell

    def run(self) -> None:
        """Ask all questions. The first that has no good answer is the last."""
        try:
            self._ask_all()
        except InexactError as error:
            self.tell({"problem": error.what, "advice": error.what_to_do})
        except _PLAIN as error:
            self.tell({"problem": str(error)})
        except Exception as error:
            self.tell({"problem": f"While {self._stage}, the environment raised {in_words(error)}."})
        self.tell({"end": True})

    def _begin(self, stage: str) -> None:
        self._stage = stage
        self.tell({"stage": stage})

    def _find(self, name: str, value: Any) -> None:
        self.tell({"finding": name, "value": value})

    def _ask_all(self) -> None:
        request = self.request
        self._begin("making the environment")
        make = find_environment(request.environment, request.wrappers)
        env = make()
        self._find("environment", questions.describe(env))
        self._begin("looking at the actions")
        questions.check_actions(env.action_space)
        self._begin("resetting the environment")
        env.reset(seed=0)
        self._begin("stepping the environment")
        self._find("steps_per_second", questions.steps_per_second(env))
        env.close()

        self._begin("taking snapshots")
        vec_env = make_searchable(make)
        wrapper = vec_env.unwrapped.envs[0]  # type: ignore[attr-defined]
        self._find("snapshot", questions.check_snapshots(wrapper))
        self._begin("making a forward model")
        self._find("forward_model", questions.forward_model(wrapper))

        agent, vec_env = self._agent(vec_env)
        milliseconds = self._costs(agent, vec_env)
        if request.agent is not None:
            self._returns(agent, vec_env, milliseconds)

    def _agent(self, env: VecEnv) -> tuple[OffPolicyAlgorithm, VecEnv]:
        if self.request.agent is None:
            self._begin("making an agent")
            return questions.untrained_agent(env), env
        self._begin("loading the agent")
        try:
            statistics = None if self.request.statistics is None else Path(self.request.statistics)
            env = normalized(env, statistics, self.request.trusted)
            agent = load_agent(self.request.agent, env, device="cpu")
        except (OSError, ValueError) as error:
            raise questions.UnsuitableError(str(error)) from error
        normalizer = unwrap_vec_normalize(env)
        flags = None if normalizer is None else {key: getattr(normalizer, key) for key in _FLAGS}
        about = {
            "algorithm": type(agent).__name__,
            "base": _base(agent),
            "normalize": flags,
            "file": self.request.agent,
            "statistics": self.request.statistics,
        }
        self._find("agent", about)
        return agent, env

    def _costs(self, agent: OffPolicyAlgorithm, env: VecEnv) -> dict[str, float]:
        """Measure the presets. Return the milliseconds of a decision with each."""
        measured: dict[str, float] = {}
        per_step = 0.0
        policy = None
        for preset in PRESETS:
            if preset == "train":  # searches as "efficient" does
                continue
            self._begin(f"searching with preset {preset}")
            try:
                if policy is None:
                    env.reset()
                    policy = SearchPolicy(agent, env, seed=0, preset=preset)
                else:
                    policy.preset = preset
            except ValueError as error:  # random dynamics
                self._find("cost", {"preset": preset, "unsuitable": str(error)})
                continue
            deterministic = policy.planner.model is not None and policy.planner.model.deterministic
            n_steps = policy.settings.simulated_steps(deterministic)
            if per_step * n_steps > MOST_SECONDS:
                self._find("cost", {"preset": preset, "too_slow": per_step * n_steps})
                continue
            cost = questions.time_decisions(policy, env)
            measured[preset] = cost["milliseconds"]
            per_step = cost["milliseconds"] / 1000 / max(cost["simulated_steps"], 1)
            self._find("cost", {"preset": preset, **cost})
        return measured

    def _returns(self, agent: OffPolicyAlgorithm, env: VecEnv, milliseconds: dict[str, float]) -> None:
        """Play the same episodes without search, and with each preset for which there is time."""
        self._begin("playing episodes")
        episodes = self._play("actor alone", agent, env)
        n_steps = sum(episode["length"] for episode in episodes)
        for preset in ("efficient", "balanced"):
            seconds = milliseconds.get(preset, float("inf")) / 1000 * n_steps
            if seconds > self.request.seconds:
                self._find("not_played", {"preset": preset, "seconds": seconds})
                continue
            self._begin(f"playing episodes with preset {preset}")
            self._play(preset, SearchPolicy(agent, env, seed=0, preset=preset), env)

    def _play(self, name: str, policy: Any, env: VecEnv) -> list[dict[str, Any]]:
        episodes = [play(policy, env, seed)._asdict() for seed in range(self.request.episodes)]
        self._find("episodes", {"policy": name, "episodes": episodes})
        return episodes


def _base(agent: OffPolicyAlgorithm) -> str:
    """The name of an agent's algorithm without search."""
    names = {cls: name for name, cls in BASELINES.items()}
    return next(names[cls] for cls in type(agent).__mro__ if cls in names)  # DDPG is a TD3, too


def main() -> None:
    """Examine what the first argument says; write to the file descriptor that the second names."""
    request = Request(**json.loads(sys.argv[1]))
    os.set_inheritable(int(sys.argv[2]), False)
    with os.fdopen(int(sys.argv[2]), "w", buffering=1) as pipe:
        Examination(request, lambda message: print(json.dumps(message), file=pipe)).run()
        pipe.flush()
        # Threads and windows that the environment left behind must not keep the process.
        os._exit(0)


if __name__ == "__main__":
    main()
