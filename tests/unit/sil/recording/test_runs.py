"""Runs of true values: where each begins and ends, and the longest."""

from __future__ import annotations

import numpy as np

from sil.recording.runs import longest_run, true_runs


def test_runs_begin_and_end_also_at_the_ends_of_the_samples() -> None:
    assert true_runs(np.array([True, False, True, True])).tolist() == [[0, 1], [2, 4]]
    assert true_runs(np.zeros(3, dtype=bool)).tolist() == []


def test_longest_run() -> None:
    assert longest_run(np.array([False, True, True, False, True])) == 2
    assert longest_run(np.array([True, True, True])) == 3
    assert longest_run(np.zeros(4, dtype=bool)) == 0
