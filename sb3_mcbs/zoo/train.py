"""``python -m sb3_mcbs.zoo.train``: the command line of ``rl_zoo3.train``, also without the import hook."""

from sb3_mcbs.zoo import import_with_zoo, register


def main() -> None:
    """Train as ``python -m rl_zoo3.train`` does, with this package registered."""
    command = import_with_zoo("rl_zoo3.train")
    register()
    command.train()


if __name__ == "__main__":
    main()
