"""Backward and forward are filled neither together nor too soon one after the other."""

from __future__ import annotations

import pytest

from can_dbc.messages import Chamber
from controller.config import FirmwareConfig
from controller.firmware import Interlock
from controller.strategies import OFF, Duties

MS = 1_000_000


@pytest.mark.parametrize("chamber", [Chamber.B, Chamber.N, Chamber.F])
def test_a_chamber_is_clear_after_the_interlock_and_the_period_that_it_was_on(
    chamber: Chamber,
) -> None:
    interlock = Interlock(FirmwareConfig())
    assert interlock.clear(0, chamber)
    interlock.note(7, OFF, chamber)
    assert not interlock.clear(7 + 50 * MS - 1, chamber)
    assert interlock.clear(7 + 50 * MS, chamber)


@pytest.mark.parametrize(
    ("duties", "allowed"),
    [
        ((0.0, 0.0, 0.0), True),
        ((1.0, 1.0, 0.33), True),
        ((0.33, 1.0, 1.0), True),
        ((0.331, 0.0, 0.331), False),
        ((0.33, 0.0, 0.331), True),
        ((0.331, 0.0, 0.33), True),
        ((-0.001, 0.0, 0.0), False),
        ((1.001, 0.0, 0.0), False),
        ((0.0, -0.001, 0.0), False),
        ((0.0, 1.001, 0.0), False),
        ((0.0, 0.0, -0.001), False),
        ((0.0, 0.0, 1.001), False),
        ((float("nan"), 0.0, 0.0), False),
    ],
)
def test_duties_that_are_none_or_fill_both_ends_are_refused(
    duties: tuple[float, float, float], allowed: bool
) -> None:
    assert Interlock(FirmwareConfig()).allows(0, Duties(*duties)) is allowed


def test_an_end_is_not_filled_while_the_other_is_not_clear() -> None:
    b_only, f_only = Duties(0.98, 0.0, 0.0), Duties(0.0, 0.0, 0.98)
    for filled, opposite in ((f_only, b_only), (b_only, f_only)):
        interlock = Interlock(FirmwareConfig())
        interlock.note(0, filled, Chamber.NONE)
        assert not interlock.allows(50 * MS - 1, opposite)
        assert interlock.allows(50 * MS - 1, filled)
        assert interlock.allows(50 * MS, opposite)
