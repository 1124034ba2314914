"""What can go wrong with a snapshot."""


class SnapshotError(RuntimeError):
    """Base class of everything that this package raises about snapshots."""


class SnapshotUnsupportedError(SnapshotError):
    """Part of an environment can neither be captured nor be left out.

    :param reason: why the object cannot be captured.
    :ivar path: attribute names and keys that lead from a layer of the environment to the object,
        outermost first. Filled on the way up.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason
        self.path: list[str] = []

    def __str__(self) -> str:
        if not self.path:
            return self.reason
        return (
            f"{''.join(self.path)} cannot be part of a snapshot: {self.reason}. Keep it outside of the "
            "environment, or say how it is captured with sb3_mcbs.snapshot.register_adapter(...)."
        )


class SnapshotMismatchError(SnapshotError):
    """A snapshot was given to an environment that it was not taken from, or to one of another shape."""
