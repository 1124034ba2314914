"""What goes wrong with checkpoints."""


class CheckpointError(Exception):
    """A checkpoint cannot be written, read or continued; the message says why and what to do."""
