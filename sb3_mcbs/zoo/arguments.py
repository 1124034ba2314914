"""Arguments that several commands have, and how a command ends that cannot go on."""

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from sb3_mcbs.agents.registry import ALGORITHMS
from sb3_mcbs.models import ForwardModelError
from sb3_mcbs.snapshot import SnapshotError
from sb3_mcbs.video import RenderingError
from sb3_mcbs.zoo.environments import ENV_HELP

#: Errors whose messages say what is wrong and what to do.
_IN_WORDS = (
    OSError,
    ImportError,
    ValueError,
    SnapshotError,
    ForwardModelError,
    RenderingError,
)


def add_agent(parser: argparse.ArgumentParser) -> None:
    """
    Add what :func:`sb3_mcbs.zoo.subject.find_subject` needs: an agent and its environment.

    :param parser: of a command
    """
    parser.add_argument(
        "agent", metavar="AGENT", type=Path, help="the folder of an RL Zoo run, or the zip of an agent"
    )
    parser.add_argument("--env", help=f"the environment, by default that of the run: {ENV_HELP}")
    add_wrappers(parser)
    parser.add_argument(
        "--algo", choices=ALGORITHMS, metavar="ALGO", help="td3, mcbs_sac, ...: if it cannot be inferred"
    )
    add_statistics(parser)


def add_episodes(parser: argparse.ArgumentParser) -> None:
    """
    Add how many episodes are played, and the reset seed of the first.

    :param parser: of a command
    """
    parser.add_argument(
        "--episodes", type=whole_number(1), metavar="N", default=10, help="episodes to play, by default 10"
    )
    parser.add_argument(
        "--seed", type=whole_number(0), metavar="N", default=0, help="reset seed of the first, by default 0"
    )


def add_wrappers(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of a command
    """
    parser.add_argument(
        "--wrapper",
        nargs="+",
        action="extend",
        default=[],
        metavar="W",
        help="its wrappers (module.Class), innermost first",
    )


def add_statistics(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of a command
    """
    parser.add_argument(
        "--vecnormalize",
        type=Path,
        metavar="FILE",
        help="statistics of the observations (npz or pkl); by default those beside the agent",
    )
    parser.add_argument("--trusted", action="store_true", help="open statistics that are a pickle")


def whole_number(least: int) -> Callable[[str], int]:
    """
    :param least: the smallest that is accepted
    :return: reads an argument
    """

    def read(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"must be a whole number, at least {least}; got {text!r}")
        return int(text)

    return read


def positive(text: str) -> float:
    """
    :param text: an argument
    :return: a finite number above 0
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number above 0; got {text!r}")
    return value


@contextmanager
def errors_in_words(command: str) -> Iterator[None]:
    """
    End a command with one sentence where an error says what to do. Others keep their traceback.

    :param command: its name
    """
    try:
        yield
    except KeyboardInterrupt:
        print(f"{command}: stopped", file=sys.stderr)
        sys.exit(130)
    except _IN_WORDS as error:
        sys.exit(f"{command}: {error}")
