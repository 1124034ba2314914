"""
What the import hook for RL Zoo costs every interpreter of the environment.

    python benchmarks/import_hook.py
"""

import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

REPETITIONS = 200


def main() -> None:
    """Execute the hook's module again and again, and print how long it takes."""
    spec = find_spec("_sb3_mcbs_hook")
    if spec is None or spec.origin is None:
        sys.exit("The hook is not installed: pip install -e . first.")
    code = compile(Path(spec.origin).read_text(), spec.origin, "exec")
    finders = list(sys.meta_path)
    milliseconds = []
    for _ in range(REPETITIONS):
        start = time.perf_counter()
        exec(code, {"__name__": "_sb3_mcbs_hook"})
        milliseconds.append(1000 * (time.perf_counter() - start))
        sys.meta_path[:] = finders
    median, high = np.percentile(milliseconds, (50, 99))
    print(f"executing the hook: median {median:.3f} ms, p99 {high:.3f} ms ({REPETITIONS} times)")


if __name__ == "__main__":
    main()
