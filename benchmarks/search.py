"""What one decision costs: ``make bench-search``.

A decision is held against the floor of its own physics (its states and controls replayed through
``mujoco.batch``, nothing else), the floor of its own networks (the same matrix products with the
same weights through ``torch.mm``, nothing else), and the usual way of searching (``naive.py``). The first
is for environments that the batch simulates, the last for those of MuJoCo: elsewhere the table has a dash.
"""

import argparse
import time
from typing import Any

import gymnasium as gym
import matplotlib
import mujoco
import numpy as np
import torch as th
from gymnasium.envs.mujoco import MujocoEnv
from matplotlib import pyplot
from mujoco.batch import Batch

from benchmarks import NETWORKS
from benchmarks.common import (
    alternate,
    machine,
    parse_args,
    print_table,
    timed,
    write,
    write_picture,
)
from benchmarks.naive import usual_search
from sb3_mcbs import MCBSTD3
from sb3_mcbs.models import MujocoBatchModel
from sb3_mcbs.search import SearchResult

ENVS = ("HalfCheetah-v5", "Walker2d-v5", "Swimmer-v5", "Ant-v5", "Humanoid-v5")
SIZES = ((6, 1, 5), (6, 3, 5), (18, 6, 5), (18, 9, 10))


class Decision:
    """An agent in the middle of an episode, and everything that its search did once.

    :param env_id: the environment.
    :param size: beam width, rollout depth, simulations per candidate.
    """

    def __init__(self, env_id: str, size: tuple[int, int, int]) -> None:
        beam_width, rollout_depth, n_simulations = size
        self.size = size
        self.agent = MCBSTD3(
            "MlpPolicy",
            env_id,
            learning_starts=300,
            buffer_size=2000,
            batch_size=256,
            policy_kwargs=NETWORKS,
            seed=0,
            device="cpu",
            beam_width=beam_width,
            rollout_depth=rollout_depth,
            n_simulations=n_simulations,
        )
        self.agent.learn(310)
        planner = self.agent.planner
        assert planner is not None and self.agent.env is not None
        self.planner, self.model = planner, planner.model
        self.real: Any = self.agent.env.get_attr("unwrapped")[0]
        self.simulator = gym.make(env_id)
        self.simulator.reset()
        self.rng = np.random.default_rng(0)
        self._record()

    @property
    def is_batched(self) -> bool:
        """Whether the physics is the batch's, so that it has a floor."""
        return isinstance(self.model, MujocoBatchModel)

    def search(self) -> SearchResult:
        """One decision from the present state, which stays as it is."""
        observations: Any = self.agent._last_obs
        return self.planner.plan(observations, self.rng)

    def search_the_usual_way(self) -> None:
        """The same by :mod:`naive`."""
        observations: Any = self.agent._last_obs
        usual_search(self.agent, self.real, self.simulator, observations[0], self.size, 0.1, self.rng)

    def _record(self) -> None:
        """Note the rows of every network call, and the states before every step of the batch."""
        self.simulated_steps = self.search().simulated_steps
        functions = self.planner.functions()._replace(rollout=None)  # step by step, where one can look on
        self.planner.functions = lambda: functions  # type: ignore[method-assign]
        if self.is_batched:
            self._record_physics()
        policy_rows, value_rows = [], []

        def noted_policy(observations: Any) -> np.ndarray:
            policy_rows.append(len(observations))
            return functions.policy(observations)

        def noted_value(observations: Any, actions: np.ndarray) -> np.ndarray:
            value_rows.append(len(observations))
            return functions.value(observations, actions)

        noted = functions._replace(policy=noted_policy, value=noted_value)
        self.planner.functions = lambda: noted  # type: ignore[method-assign]
        self.search()
        del self.planner.functions
        critics: list[Any] = self.agent.critic.q_networks
        calls = [(self.agent.actor.mu, n) for n in policy_rows]
        calls += [(critic, n) for n in value_rows for critic in critics]
        linear = th.nn.Linear
        weights = [
            (layer.weight.detach(), n) for net, n in calls for layer in net if isinstance(layer, linear)
        ]
        # Both orders of storage: the quicker one is the floor.
        self.products = (
            [(th.randn(n, w.shape[1]), w.t(), th.empty(n, w.shape[0])) for w, n in weights],
            [(w, th.randn(w.shape[1], n), th.empty(w.shape[0], n)) for w, n in weights],
        )

    def _record_physics(self) -> None:
        """Note the states before every step of the batch."""
        model: Any = self.model
        step = model.step
        self.states: list[np.ndarray] = []
        self.controls: list[np.ndarray] = []

        def noted_step(actions: np.ndarray) -> Any:
            self.states.append(model.states.copy())
            self.controls.append(actions)
            return step(actions)

        model.step = noted_step
        self.search()
        del model.step
        self.simulated_steps = sum(len(states) for states in self.states)
        self.n_substeps = self.real.frame_skip
        most = max(len(states) for states in self.states)
        self.batch = Batch(self.real.model, most, 0)
        self.ids = np.arange(most, dtype=np.int32)

    def physics_floor(self) -> float:
        """Seconds that the batch alone needs for the decision's steps."""
        total = 0.0
        for states, controls in zip(self.states, self.controls, strict=True):
            self.batch.state[: len(states)] = states
            self.batch.bind("ctrl")[: len(states)] = controls
            start = time.perf_counter()
            self.batch.step(self.ids[: len(states)], self.n_substeps)
            total += time.perf_counter() - start
        return total

    def network_floor(self, order: int) -> float:
        """Seconds of the decision's matrix products, on one thread like the search's."""
        n_threads = th.get_num_threads()
        th.set_num_threads(1)
        start = time.perf_counter()
        for left, right, out in self.products[order]:
            th.mm(left, right, out=out)
        seconds = time.perf_counter() - start
        th.set_num_threads(n_threads)
        return seconds

    def search_after_gradient_step(self) -> float:
        """Seconds of a decision that follows a gradient step, as in training."""
        self.agent.train(gradient_steps=1, batch_size=256)
        return timed(self.search)()


def measure(env_id: str, size: tuple[int, int, int], seconds: float) -> dict[str, Any]:
    """All figures of one environment and size, times in milliseconds; ``None`` where one has no meaning.

    :param env_id: the environment.
    :param size: beam width, rollout depth, simulations per candidate.
    :param seconds: how long to measure.
    """
    decision = Decision(env_id, size)
    calls = {
        "networks by rows": lambda: decision.network_floor(0),
        "networks by columns": lambda: decision.network_floor(1),
        "search": timed(decision.search),
    }
    if decision.is_batched:
        calls = {"physics": decision.physics_floor, **calls}
    times = alternate(calls, seconds, least=15)
    rows, columns = times["networks by rows"], times["networks by columns"]
    usual = versus_usual(decision, seconds / 2)
    training = alternate({"search": decision.search_after_gradient_step}, seconds, least=15)["search"]
    ms = _milliseconds(times["search"])
    control_period = 1e3 * decision.real.dt if hasattr(decision.real, "dt") else None
    return {
        "env": env_id,
        "size": size,
        "rounds": len(times["search"]),
        "simulated steps": decision.simulated_steps,
        "ms": ms,
        "p99 ms": 1e3 * float(np.percentile(times["search"], 99)),
        "physics floor ms": _milliseconds(times["physics"]) if decision.is_batched else None,
        "network floor ms": min(_milliseconds(rows), _milliseconds(columns)),
        # Of each round by itself, then the median: the machine's speed drifts less within a round.
        "ms / floors": float(np.median(times["search"] / (times["physics"] + np.minimum(rows, columns))))
        if decision.is_batched
        else None,
        **usual,
        "control period ms": control_period,
        "share of period": None if control_period is None else ms / control_period,
        "p99 ms while training": 1e3 * float(np.percentile(training, 99)),
    }


def _milliseconds(times: np.ndarray) -> float:
    return 1e3 * float(np.median(times))


def versus_usual(decision: Decision, seconds: float) -> dict[str, float | None]:
    """The usual way of searching, and how many times as long it takes; ``None`` without MuJoCo.

    :param decision: what is decided.
    :param seconds: how long to measure.
    """
    if not isinstance(decision.real, MujocoEnv):
        return {"usual way ms": None, "usual way / ours": None}
    pair = {"usual": timed(decision.search_the_usual_way), "ours": timed(decision.search)}
    times = alternate(pair, seconds, least=3)
    ratio = float(np.median(times["usual"] / times["ours"]))
    return {"usual way ms": _milliseconds(times["usual"]), "usual way / ours": ratio}


def draw(results: list[dict[str, Any]]) -> None:
    """One picture per environment, one group of bars per size: floors, ours, the usual way."""
    envs = list(dict.fromkeys(r["env"] for r in results))
    figure, all_axes = pyplot.subplots(1, len(envs), figsize=(3 * len(envs), 3.4), sharey=True, squeeze=False)
    for axes, env_id in zip(all_axes[0], envs, strict=True):
        shown = [r for r in results if r["env"] == env_id]
        places = np.arange(len(shown))
        if shown[0]["physics floor ms"] is not None:
            floors = [r["physics floor ms"] + r["network floor ms"] for r in shown]
            axes.bar(places - 0.27, floors, 0.25, label="physics + network floor", color="lightgrey")
        axes.bar(places, [r["ms"] for r in shown], 0.25, label="sb3-mcbs", color="C0")
        if shown[0]["usual way ms"] is not None:
            usual = [r["usual way ms"] for r in shown]
            axes.bar(places + 0.27, usual, 0.25, label="the usual way", color="C1")
        if shown[0]["control period ms"] is not None:
            period = shown[0]["control period ms"]
            axes.axhline(period, linestyle=":", color="black", label="control period")
        axes.set_yscale("log")
        axes.set_title(env_id, fontsize=9)
        axes.set_xticks(places, [",".join(map(str, r["size"])) for r in shown], fontsize=7)
    all_axes[0, 0].set_ylabel("ms per decision")
    all_axes[0, 0].legend(fontsize=7)
    figure.tight_layout()
    write_picture(figure, "search.png")


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", nargs="+", default=ENVS)
    parser.add_argument("--size", nargs="+", default=[",".join(map(str, size)) for size in SIZES])
    parser.add_argument("--seconds", type=float, default=4, help="for each environment and size")
    args = parse_args(parser)
    matplotlib.use("agg")
    print(machine())
    results = []
    for env_id in args.env:
        for size in args.size:
            beam_width, depth, n_simulations = map(int, size.split(","))
            results.append(measure(env_id, (beam_width, depth, n_simulations), args.seconds))
            print(env_id, size, f"{results[-1]['ms']:.2f} ms", flush=True)
    print_table(list(results[0]), [list(result.values()) for result in results])
    write("search", results)
    draw(results)


if __name__ == "__main__":
    mujoco.set_mju_user_warning(lambda message: None)
    main()
