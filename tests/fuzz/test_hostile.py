"""Hostile input for every command: no traceback, no hang, one line, no file outside --out."""

from __future__ import annotations

import pytest

from tests.fuzz.hostile import campaign_of_cases


def test_hostile_input_is_refused_in_one_line() -> None:
    told: list[str] = []
    ends, failures = campaign_of_cases(25, 7, told.append)
    assert failures == 0, "\n".join(told)
    assert sum(ends.values()) == 25 and len({name.partition(":")[0] for name in ends}) >= 5


@pytest.mark.slow
def test_much_hostile_input_is_refused_in_one_line() -> None:
    told: list[str] = []
    _, failures = campaign_of_cases(3000, 1, told.append)
    assert failures == 0, "\n".join(told)
