"""Hostile input for every command: no traceback, no hang, one line, no file outside --out."""

from __future__ import annotations

import gc

import pytest

from tests.fuzz.hostile import campaign_of_cases


# asammdf leaves the temporary file of a measurement that it refuses to the collector
@pytest.mark.filterwarnings(
    r"ignore:Exception ignored in. <_io\.FileIO name='/.*:pytest.PytestUnraisableExceptionWarning"
)
@pytest.mark.parametrize(
    ("cases", "seed"), [(25, 7), pytest.param(3000, 1, marks=pytest.mark.slow)]
)
def test_hostile_input_is_refused_in_one_line(cases: int, seed: int) -> None:
    lines: list[str] = []
    ends, failures = campaign_of_cases(cases, seed, lines.append)
    gc.collect()
    assert failures == 0, "\n".join(lines)
    assert sum(ends.values()) == cases and len({name.partition(":")[0] for name in ends}) >= 5
