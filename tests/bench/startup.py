"""Cold starts: whole processes, compared with a bare interpreter."""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence

REPEATS = 7


def wall_s(command: Sequence[str]) -> float:
    """Median wall seconds of a command, after one run that warms the file cache."""
    times = []
    for _ in range(REPEATS + 1):
        begin = time.perf_counter()
        subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True)
        times.append(time.perf_counter() - begin)
    return statistics.median(times[1:])


def measure() -> Iterator[str]:
    bare = wall_s([sys.executable, "-c", "pass"])
    opc4 = [sys.executable, "-m", "sil.cli"]
    yield f"bare interpreter {1e3 * bare:6.0f} ms"
    libraries = wall_s([sys.executable, "-c", "import numpy, can, matplotlib.pyplot"])
    yield f"import numpy, can, pyplot {1e3 * libraries:6.0f} ms  {libraries / bare:5.1f} x bare"
    with tempfile.TemporaryDirectory() as folder:
        run = [*opc4, "run", "lab_n_b", "--out", f"{folder}/run", "--force"]
        for name, command in (
            ("opc4 --help", [*opc4, "--help"]),
            ("opc4 run lab_n_b", [*run, "--no-report"]),
            ("with page, picture", run),
        ):
            wall = wall_s(command)
            yield f"{name:20} {1e3 * wall:6.0f} ms  {wall / bare:5.1f} x bare  {wall / libraries:5.2f} x the libraries"
