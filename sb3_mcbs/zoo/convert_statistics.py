"""``sb3-mcbs convert-statistics vecnormalize.pkl out.npz --trusted``: normalisation statistics as npz."""

import argparse
import pickle
import sys
from pathlib import Path

from sb3_mcbs.loading.normalization import save_statistics


def convert_statistics(pickle_path: str | Path, npz_path: str | Path, trusted: bool = False) -> None:
    """
    Write the statistics of a pickled ``VecNormalize`` as npz.

    :param pickle_path: a file from ``VecNormalize.save`` or RL Zoo, usually ``vecnormalize.pkl``
    :param npz_path: the file to write, for ``sb3_mcbs.loading.normalization.load_statistics``
    :param trusted: whether the caller trusts the pickle's author
    :raises PermissionError: without ``trusted``
    :raises ValueError: if the file is not a pickle, or its code fails
    :raises TypeError: if the file contains something else
    """
    if not trusted:
        raise PermissionError(
            f"{pickle_path} is a pickle: reading it runs whatever code its author put in. If you trust them, "
            "say so with --trusted (trusted=True); else convert it on a machine that has nothing to lose."
        )
    with Path(pickle_path).open("rb") as stream:
        try:
            vec_normalize = pickle.load(stream)
        except Exception as error:  # the pickle's code may raise anything
            raise ValueError(
                f"{pickle_path} cannot be unpickled ({type(error).__name__}: {error}). Name a file that "
                "VecNormalize.save or RL Zoo wrote, usually vecnormalize.pkl."
            ) from error
    save_statistics(vec_normalize, npz_path)


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
