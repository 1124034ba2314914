"""``sb3-mcbs export RUN|ZIP -o policy.onnx``: an agent's networks as ONNX files."""

import argparse
from pathlib import Path

from sb3_mcbs.sharing import export_onnx
from sb3_mcbs.zoo.arguments import add_agent, errors_in_words
from sb3_mcbs.zoo.subject import find_subject


def main() -> None:
    """Read the command line and export."""
    parser = argparse.ArgumentParser(
        prog="sb3-mcbs export",
        description="Write an agent's actor and critics as ONNX files, with the normalization of its "
        "observations, for programs without torch. No code from AGENT is run.",
    )
    add_agent(parser)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE.onnx",
        help="the actor; the critics go to FILE-critics.onnx beside it",
    )
    args = parser.parse_args()
    with errors_in_words(parser.prog):
        subject = find_subject(args)
        env = subject.make_env()
        for path in export_onnx(subject.load(env), args.output, env):
            print(f"wrote {path}")


if __name__ == "__main__":
    main()
