"""Returns of a trained agent against the simulated steps per decision, for every strategy.

All reset seeds of an arm act side by side in one vectorised environment. Settings are chosen on one set of
seeds and reported on another:

    python -m benchmarks.strategies sac-HalfCheetah-v3.zip HalfCheetah-v4 --seeds choosing
    python -m benchmarks.strategies sac-HalfCheetah-v3.zip HalfCheetah-v4 --seeds reporting
    python -m benchmarks.strategies sac-Walker2d-v3.zip Walker2d-v4 --seeds confirming --arms "beam 6x3"
    python -m benchmarks.strategies --table

The second runs what was best of each strategy and budget in the first, and the presets. Arms are named by
their sizes: beam candidates x depth, tree width x branching x depth, cem width x rounds x depth; (2x3) is
a depth of 2 macro-steps of 3 steps, "in 2" two directions, "of 48" critic pre-selection. Arms that
the file of results holds already are left out, but for ``--again``. The third runs a hundred episodes, for
agents that fall in some: ten say little of them.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from benchmarks.common import known_path, parse_args, print_table, read, write, write_picture
from benchmarks.strategies_arms import ARMS, BUDGETS, SLACK
from sb3_mcbs import SearchPolicy, SearchSettings, SnapshotEnvWrapper, load_agent
from sb3_mcbs.search import PRESETS, make_settings

FILE = "strategies"
SEEDS = {"choosing": range(100, 102), "reporting": range(200, 210), "confirming": range(300, 400)}
#: On whose choosing seeds the arms that are reported of every agent were chosen.
CHOSEN_WITH = "sac-HalfCheetah-v3"


def budget_of(arm: str) -> int | None:
    """The budget that an arm's simulated steps are about; ``None``: none of them."""
    steps = make_settings(**ARMS[arm]).simulated_steps()
    near = [budget for budget in BUDGETS if abs(steps - budget) <= SLACK * budget]
    return near[0] if near else None


def run_arm(agent: OffPolicyAlgorithm, env_id: str, seeds: range, settings: dict[str, Any]) -> dict[str, Any]:
    """Act for one episode from every seed, side by side.

    :param agent: the trained agent.
    :param env_id: its environment.
    :param seeds: of the resets; the first is that of the search.
    :param settings: of the search.
    :return: returns, and means over all decisions. ``predicted`` is the value of the chosen action,
        ``realised`` the discounted return that followed, closed by the critics at a time limit.
    """
    env = make_vec_env(env_id, len(seeds), seed=seeds[0], wrapper_class=SnapshotEnvWrapper)
    policy = SearchPolicy(agent, env, seed=seeds[0], **{"model_kwargs": {"n_threads": 1}, **settings})
    planner, functions = policy.planner, policy.planner.functions()
    observations: Any = env.reset()
    running = list(range(len(seeds)))
    rewards: list[list[float]] = [[] for _ in seeds]
    predicted: list[list[float]] = [[] for _ in seeds]
    closing = np.zeros(len(seeds))
    simulated = evaluated = invalid = 0
    seconds = cpu_seconds = 0.0
    actions = np.zeros_like([env.action_space.sample() for _ in seeds])
    while running:
        start, cpu_start = time.perf_counter(), time.process_time()
        if settings.get("rollout_depth") == 0:
            result = planner.plan(observations[running], policy.rng)
        else:
            result = planner.plan(observations, policy.rng, running)
        planner.remember_actions(result.actions)
        seconds += time.perf_counter() - start
        cpu_seconds += time.process_time() - cpu_start
        simulated += result.simulated_steps
        evaluated += result.critic_evaluations
        invalid += result.invalid_rollouts
        actions[running] = planner.unscale(result.actions)
        observations, received, dones, infos = env.step(actions)
        for row, index in enumerate(running):
            rewards[index].append(float(received[index]))
            predicted[index].append(float(result.values[row, result.chosen[row]]))
            if dones[index] and infos[index]["TimeLimit.truncated"]:
                last = infos[index]["terminal_observation"][None]
                closing[index] = functions.value(last, functions.policy(last))[0]
        running = [index for index in running if not dones[index]]
    policy.close()
    env.close()
    realised = [discounted(*episode, agent.gamma) for episode in zip(rewards, closing, strict=True)]
    decisions = sum(map(len, rewards))
    errors = [np.mean(p) - np.mean(r) for p, r in zip(predicted, realised, strict=True)]
    return {
        "returns": [sum(episode) for episode in rewards],
        "lengths": [len(episode) for episode in rewards],
        "simulated steps": simulated / decisions,
        "critic evaluations": evaluated / decisions,
        "ms": 1000 * seconds / decisions,
        "cpu ms": 1000 * cpu_seconds / decisions,
        "invalid rollouts": invalid,
        "predicted": float(np.mean(np.concatenate(predicted))),
        "realised": float(np.mean(np.concatenate(realised))),
        "errors by episode": [float(error) for error in errors],
    }


def discounted(rewards: list[float], closing: float, gamma: float) -> np.ndarray:
    """The discounted return from every step on.

    :param rewards: of an episode.
    :param closing: value of its last state; 0 if it terminated.
    :param gamma: discount factor.
    """
    returns, value = np.zeros(len(rewards)), closing
    for step in reversed(range(len(rewards))):
        value = rewards[step] + gamma * value
        returns[step] = value
    return returns


def reported_arms(rows: list[dict[str, Any]]) -> list[str]:
    """The actor, the presets, and of each strategy and budget the best arm on the choosing seeds."""
    scores = {
        row["arm"]: np.mean(row["returns"])
        for row in rows
        if row["agent"] == CHOSEN_WITH and row["seeds"] == "choosing"
    }
    best: dict[Any, str] = {}
    for arm in sorted(scores, key=lambda arm: scores[arm]):
        best[ARMS[arm].get("strategy", "beam"), budget_of(arm)] = arm
    presets = [SearchSettings.preset(name) for name in PRESETS]
    wanted = {"actor alone", *best.values(), *(arm for arm in ARMS if make_settings(**ARMS[arm]) in presets)}
    return [arm for arm in ARMS if arm in wanted]


def by_cost(arms: list[str]) -> list[str]:
    """The cheapest first."""
    return sorted(arms, key=lambda arm: make_settings(**ARMS[arm]).simulated_steps())


def ended_early(row: dict[str, Any]) -> int:
    """How many episodes of an arm did not last until the time limit."""
    limit = gym.spec(row["environment"]).max_episode_steps or np.inf
    return sum(length < limit for length in row["lengths"])


def show(rows: list[dict[str, Any]]) -> None:
    """Print a table for every agent and set of seeds."""
    header = ["", "return", "least", "most", "ended early", "simulated steps", "critic evaluations", "cpu ms",
              "predicted", "predicted - realised"]  # fmt: skip
    for agent, seeds in dict.fromkeys((row["agent"], row["seeds"]) for row in rows):
        table = [
            [row["arm"], float(np.mean(row["returns"])), min(row["returns"]), max(row["returns"]),
             ended_early(row),
             *(float(row.get(name, "nan")) for name in header[5:9]), row["predicted"] - row["realised"]]
            for row in rows
            if (row["agent"], row["seeds"]) == (agent, seeds)
        ]  # fmt: skip
        print(f"\n{agent}, {seeds} seeds {SEEDS[seeds][0]} to {SEEDS[seeds][-1]}\n")
        print_table(header, sorted(table, key=lambda line: (round(line[5], -1), line[1])))


def draw(rows: list[dict[str, Any]]) -> None:
    """Draw returns against simulated steps, a panel for every agent.

    :param rows: of the file of results.
    """
    agents = sorted({row["agent"] for row in rows})
    columns = min(4, len(agents))
    lines = -(-len(agents) // columns)
    figure = Figure(figsize=(4 * columns, 3.5 * lines), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for panel in panels[len(agents) :]:
        panel.set_axis_off()
    for agent, panel in zip(agents, panels, strict=False):
        of_agent = [row for row in rows if row["agent"] == agent and row["seeds"] != "confirming"]
        actor = [np.mean(row["returns"]) for row in of_agent if row["arm"] == "actor alone"][-1]
        panel.axhline(actor, color="grey", linestyle=":", label="actor alone")
        for strategy, marker, color in (("beam", "o", "C0"), ("tree", "^", "C1"), ("cem", "s", "C2")):
            for seeds, filled in (("choosing", False), ("reporting", True)):
                points = [
                    (row["simulated steps"], np.mean(row["returns"]))
                    for row in of_agent
                    if row["seeds"] == seeds
                    and row["settings"].get("strategy", "beam") == strategy
                    and row["simulated steps"] > 0
                ]
                if points:
                    name = f"{strategy}, {seeds} seeds"
                    face = color if filled else "none"
                    panel.plot(
                        *zip(*points, strict=True), marker, label=name, color=color, markerfacecolor=face
                    )
        panel.set(xscale="log", xlabel="simulated steps per decision", ylabel="return", title=agent)
        panel.set_xticks(BUDGETS, [str(budget) for budget in BUDGETS])
        panel.minorticks_off()
    labelled = [panel.get_legend_handles_labels() for panel in panels]
    handles = {label: handle for pair in labelled for handle, label in zip(*pair, strict=True)}
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=len(handles))
    write_picture(figure, "strategies.png", dpi=90)


def run_arms(agent: OffPolicyAlgorithm, name: str, arms: list[str], arguments: argparse.Namespace) -> None:
    """Run the arms that were not run before, and say which were not run and why.

    :param agent: the trained agent.
    :param name: its name in the file of results.
    :param arms: the arms.
    :param arguments: the command line.
    """
    known, costly = [], []
    for arm in arms:
        of = {"agent": name, "environment": arguments.env, "seeds": arguments.seeds, "arm": arm}
        settings = ARMS[arm]
        row = {**of, "settings": settings}
        if not arguments.again and any(row.items() <= other.items() for other in read(FILE)):
            known.append(arm)
        elif make_settings(**settings).simulated_steps() > arguments.most:
            costly.append(arm)
        else:
            result = run_arm(agent, arguments.env, SEEDS[arguments.seeds], settings)
            # Others may have added arms meanwhile, so the file is read again.
            others = [other for other in read(FILE) if not row.items() <= other.items()]
            write(FILE, [*others, {**row, **result}])
            print(arm, f"{np.mean(result['returns']):.0f}", f"{result['simulated steps']:.0f}", flush=True)
    if known:
        print(f"Not run, since {known_path(FILE)} has them (--again runs them anew): {'; '.join(known)}")
    if costly:
        print(f"Not run, since they simulate more than {arguments.most} steps (--most): {'; '.join(costly)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("agent", type=Path, nargs="?", help="zip of a TD3, DDPG, SAC, TQC or CrossQ agent")
    parser.add_argument("env", nargs="?", help="its environment, for example HalfCheetah-v4")
    parser.add_argument("--seeds", choices=SEEDS, default="choosing")
    parser.add_argument("--arms", choices=ARMS, nargs="+", metavar="ARM", help="only these, in this order")
    parser.add_argument("--most", type=int, default=1000, help="simulated steps of the arms that are run")
    parser.add_argument("--again", action="store_true", help="also run arms that were measured before")
    parser.add_argument("--table", action="store_true", help="only show what was measured, and draw it")
    arguments = parse_args(parser)
    if arguments.table:
        show(read(FILE))
        draw(read(FILE))
        return
    if arguments.agent is None or arguments.env is None:
        parser.error("name an agent and its environment, or --table")
    th.set_num_threads(1)
    agent = load_agent(arguments.agent, make_vec_env(arguments.env, 1), device="cpu")
    arms = by_cost(list(ARMS) if arguments.seeds == "choosing" else reported_arms(read(FILE)))
    run_arms(agent, arguments.agent.stem, arguments.arms or arms, arguments)


if __name__ == "__main__":
    main()
