"""``sb3-mcbs convert-statistics vecnormalize.pkl out.npz --trusted``: normalisation statistics as npz."""

import argparse
import sys
from pathlib import Path

from sb3_mcbs.loading.normalization import save_statistics
from sb3_mcbs.zoo.environments import unpickle_statistics


def convert_statistics(pickle_path: str | Path, npz_path: str | Path, trusted: bool = False) -> None:
    """
    Write the statistics of a pickled ``VecNormalize`` as npz.

    :param pickle_path: a file from ``VecNormalize.save`` or RL Zoo, usually ``vecnormalize.pkl``
    :param npz_path: the file to write, for ``sb3_mcbs.loading.normalization.load_statistics``
    :param trusted: whether the caller trusts the pickle's author
    :raises PermissionError: without ``trusted``
    :raises ValueError: if the file is not a pickle, its code fails, or it contains something else
    :raises TypeError: if its statistics cannot be written
    """
    if not trusted:
        raise PermissionError(
            f"{pickle_path} is a pickle: reading it runs whatever code its author put in. If you trust them, "
            "say so with --trusted (trusted=True); else convert it on a machine that has nothing to lose."
        )
    save_statistics(unpickle_statistics(Path(pickle_path)), npz_path)


def main() -> None:
    """Read the command line and convert."""
    parser = argparse.ArgumentParser(
        prog="sb3-mcbs convert-statistics",
        description="Write the normalisation statistics of a vecnormalize.pkl as npz, which load_statistics "
        "reads without running code.",
    )
    parser.add_argument("pickle_path", help="the pickled VecNormalize, for example vecnormalize.pkl")
    parser.add_argument("npz_path", help="the file to write, for example statistics.npz")
    parser.add_argument(
        "--trusted",
        action="store_true",
        help="run the code in the pickle: you trust its author with this machine",
    )
    args = parser.parse_args()
    try:
        convert_statistics(args.pickle_path, args.npz_path, args.trusted)
    except PermissionError as reason:
        parser.error(str(reason))
    except (OSError, TypeError, ValueError) as error:
        sys.exit(f"{parser.prog}: {error}")
    print(f"Wrote {args.npz_path}.")


if __name__ == "__main__":
    main()
