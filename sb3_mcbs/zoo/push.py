"""``sb3-mcbs push RUN|ZIP USER/NAME``: an agent to the Hugging Face hub, with both returns."""

import argparse
from pathlib import Path

from sb3_mcbs.search import PRESETS
from sb3_mcbs.sharing import push_to_hub
from sb3_mcbs.sharing.hub import check_video, import_hub, write_repository
from sb3_mcbs.zoo.arguments import add_agent, add_episodes, errors_in_words
from sb3_mcbs.zoo.evaluate import evaluate, searching_policies
from sb3_mcbs.zoo.subject import DEFAULT_PRESET, find_subject


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-mcbs push",
        description="Evaluate an agent, its actor alone and with search, and upload it to the Hugging Face "
        "hub with a model card. Log in first: hf auth login. No code from AGENT is run.",
    )
    add_agent(parser)
    parser.add_argument("repo_id", metavar="USER/NAME", help="the repository; made if it is not there")
    parser.add_argument(
        "--preset",
        choices=PRESETS,
        metavar="PRESET",
        help=f"how to search ({', '.join(PRESETS)}); by default as in training, or {DEFAULT_PRESET}",
    )
    add_episodes(parser)
    parser.add_argument("--video", type=Path, metavar="FILE", help="from sb3-mcbs watch: .mp4 or .gif")
    parser.add_argument("--private", action="store_true", help="make the repository private")
    parser.add_argument(
        "--folder", type=Path, metavar="FOLDER", help="write the files there, and upload nothing"
    )
    return parser


def _check_destination(folder: Path | None, video: Path | None) -> None:
    """
    :param folder: made here; None: the hub
    :param video: see :func:`push_to_hub`
    :raises FileExistsError: if the folder is there already
    """
    check_video(video)
    if folder is None:
        import_hub()
    elif folder.exists():
        raise FileExistsError(f"{folder} is there already: name a folder that is not.")
    else:
        folder.mkdir(parents=True)


def main() -> None:
    """Read the command line, evaluate and upload."""
    parser = _parser()
    args = parser.parse_args()
    presets = [args.preset] if args.preset else []
    with errors_in_words(parser.prog):
        subject = find_subject(args)
        env = subject.make_env()
        agent = subject.load(env)
        _check_destination(args.folder, args.video)  # before what takes long
        returns = {}
        for result in evaluate(agent, env, presets, range(args.seed, args.seed + args.episodes)):
            returns[result.policy] = [episode.total for episode in result.episodes]
            print(f"{result.policy}: {sum(returns[result.policy]) / args.episodes:.1f}", flush=True)
        (policy,) = searching_policies(agent, env, presets, args.seed).values()
        if args.folder is None:
            about = (args.repo_id, subject.file, policy, subject.environment, returns)
            print(push_to_hub(*about, video=args.video, private=args.private))
            return
        write_repository(
            args.folder, args.repo_id, subject.file, policy, subject.environment, returns, args.video
        )
        print(f"wrote {args.folder}")


if __name__ == "__main__":
    main()
