"""The command ``sb3-mcbs``."""

import os
import sys

from sb3_mcbs import __version__
from sb3_mcbs.zoo import MissingZooError, import_with_zoo

COMMANDS = {
    "train": ("sb3_mcbs.zoo.train", "train an agent: the arguments of python -m rl_zoo3.train"),
    "experiment": ("sb3_mcbs.experiments.command", "train all runs of a spec, or go on with them"),
    "resume": ("sb3_mcbs.zoo.resume", "continue a run from its exact checkpoints"),
    "repeat": ("sb3_mcbs.zoo.repeat", "repeat a run from its folder"),
    "doctor": ("sb3_mcbs.doctor.command", "whether look-ahead works for an environment, and its cost"),
    "evaluate": ("sb3_mcbs.zoo.evaluate", "an agent's returns, actor alone and with search"),
    "report": (
        "sb3_mcbs.experiments.report.command",
        "a page with curves and numbers of all runs of a folder",
    ),
    "watch": ("sb3_mcbs.zoo.watch", "a video of an agent and of what its search looks at"),
    "export": ("sb3_mcbs.zoo.export", "an agent's networks as ONNX files"),
    "push": ("sb3_mcbs.zoo.push", "an agent to the Hugging Face hub, with both returns"),
    "convert-statistics": ("sb3_mcbs.zoo.convert_statistics", "write a trusted vecnormalize.pkl as npz"),
}


def main() -> None:
    """Run the command that the first argument names."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name == "--version":
        print(f"sb3-mcbs {__version__}")
        return
    if name not in COMMANDS:
        lines = [f"  {command:18} {text}" for command, (_, text) in COMMANDS.items()]
        print("\n".join(["usage: sb3-mcbs COMMAND [ARGUMENTS]", "       sb3-mcbs --version", "", *lines]))
        sys.exit(0 if name in ("-h", "--help") else f"sb3-mcbs: unknown command {name!r}" if name else 2)
    # The command sees its own name as the program, as with python -m.
    sys.argv = [f"sb3-mcbs {name}", *sys.argv[2:]]
    try:
        import_with_zoo(COMMANDS[name][0]).main()
    except BrokenPipeError:  # the reader of the output, as head, wants no more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except MissingZooError as error:
        sys.exit(f"sb3-mcbs {name}: {error}")


if __name__ == "__main__":
    main()
