"""Runs of true values in a row of samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def true_runs(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return begin and end, exclusive, of each run of true values in flags [n]: indices [runs, 2]."""
    changes = np.diff(flags.astype(np.int8), prepend=0, append=0)
    return np.flatnonzero(changes).reshape(-1, 2)


def longest_run(flags: NDArray[np.bool_]) -> int:
    """Return the length of the longest run of true values in flags [n], in samples."""
    return int(np.diff(true_runs(flags)).max(initial=0))
