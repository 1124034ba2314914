"""``python -m sb3_mcbs.zoo.train``: the command line of ``rl_zoo3.train``, also without the import hook."""

from sb3_mcbs.zoo.registration import register


def main() -> None:
    """Train as ``python -m rl_zoo3.train`` does, with this package registered."""
    register()
    from rl_zoo3.train import train

    train()


if __name__ == "__main__":
    main()
