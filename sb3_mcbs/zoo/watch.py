"""``sb3-mcbs watch AGENT --env ENV -o FILE``: a video of an agent and of what its search looks at."""

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_mcbs.agents import MCBS, SearchPolicy
from sb3_mcbs.loading import AgentFileError, load_agent, load_statistics
from sb3_mcbs.search.settings import PRESETS
from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotUnsupportedError
from sb3_mcbs.types import ForwardModelError
from sb3_mcbs.video import Performer, RenderingError, record_episodes

#: Of an agent that was not trained with search.
DEFAULT_PRESET = "efficient"


def watch(args: argparse.Namespace) -> None:
    """
    Record a video, and print what it shows.

    :param args: see :func:`parser`
    """
    vec_env = _make_env(args.env, args.vecnormalize)
    agent = load_agent(args.agent, vec_env, device="cpu")
    preset = args.preset or (None if isinstance(agent, MCBS) else DEFAULT_PRESET)
    searching = SearchPolicy(agent, vec_env, seed=args.seed, preset=preset)
    name = type(agent).__name__
    performers = [Performer(f"{name} with search", searching, vec_env)]
    if args.compare:
        alone = _make_env(args.env, args.vecnormalize)
        performers.insert(0, Performer(f"{name} alone", agent, alone))
    outcomes = record_episodes(
        args.output,
        performers,
        [args.seed],
        steps=args.steps,
        start=args.start,
        bodies=args.body,
        magnify=args.magnify,
        title=performers[-1].label,
        subtitle=f"{args.env}, {preset or 'settings of its training'}",
        progress=True,
    )
    for outcome in outcomes:
        ended = f", {outcome.ended}" if outcome.ended else ""
        print(f"{outcome.label}: return {outcome.total:.1f} in {outcome.steps} steps{ended}")
    print(f"wrote {args.output}")
    searching.close()


def _make_env(env_id: str, statistics: str | None) -> VecEnv:
    """A vectorized environment that draws pictures.

    :raises ValueError: if there is no such environment, or it cannot be made.
    """
    try:
        env = SnapshotEnvWrapper(gym.make(env_id, render_mode="rgb_array"))
    except (gym.error.Error, ModuleNotFoundError, TypeError) as error:
        raise ValueError(f"{env_id} cannot be made with render_mode='rgb_array': {error}") from error
    vec_env = DummyVecEnv([lambda: env])
    return vec_env if statistics is None else load_statistics(statistics, vec_env)


def _count(least: int) -> Callable[[str], int]:
    def count(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"must be a whole number, at least {least}; got {text!r}.")
        return int(text)

    return count


def _factor(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number above 0; got {text!r}.")
    return value


def _statistics(text: str) -> str:
    if Path(text).suffix == ".pkl":
        raise argparse.ArgumentTypeError(
            f"{text} is a pickle, which can run code. If you trust it, convert it first: "
            f"sb3-mcbs convert-statistics {text} statistics.npz --trusted"
        )
    return text


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        prog="sb3-mcbs watch",
        description="Record a trained TD3, DDPG, SAC, TQC or CrossQ agent that looks ahead. In MuJoCo's "
        "scene are the candidates' rollouts, coloured by value, the chosen one thick; beside it their "
        "values, the gain over the policy's own action, and the return. No code from AGENT is run.",
    )
    add: Any = result.add_argument
    add("agent", metavar="AGENT", help="the agent's zip file, as SB3 saves it")
    add("--env", required=True, help="the environment to act in, for example HalfCheetah-v5 or module:Id-v0")
    add("-o", "--output", required=True, metavar="FILE", help="ends with .mp4, .gif, or .png (four moments)")
    add("--compare", action="store_true", help="show the actor alone beside it, from the same seed")
    add("--seed", type=_count(0), default=0, help="of the environment and the search (default: %(default)s)")
    add("--steps", type=_count(1), default=200, help="steps to record, at most (default: %(default)s)")
    add("--start", type=_count(0), default=0, help="steps before those, not recorded (default: %(default)s)")
    add(
        "--preset",
        choices=list(PRESETS),
        help=f"of the search (default: the agent's settings, or {DEFAULT_PRESET} if it was trained without)",
    )
    add(
        "--vecnormalize",
        type=_statistics,
        metavar="NPZ",
        help="statistics of VecNormalize, from convert-statistics",
    )
    add(
        "--body",
        action="append",
        default=[],
        metavar="NAME",
        help="follow this body; several times: these bodies",
    )
    add(
        "--magnify",
        type=_factor,
        metavar="X",
        help="draw differences between rollouts X times as large (default: so that they are seen; 1: as is)",
    )
    return result


def main() -> None:
    """Read the command line and record."""
    own = parser()
    args = own.parse_args()
    try:
        watch(args)
    except (
        AgentFileError,
        FileNotFoundError,
        ForwardModelError,
        ImportError,
        RenderingError,
        SnapshotUnsupportedError,
        ValueError,
    ) as error:
        sys.exit(f"{own.prog}: {error}")


if __name__ == "__main__":
    main()
