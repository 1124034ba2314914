"""One page about all runs of a folder: curves, statistics, and published figures beside them."""
