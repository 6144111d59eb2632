"""Speeds that no shaft can have: doubted from a jump in neutral until they agree in a gear."""

from __future__ import annotations

import pytest

from can_dbc.messages import DrivelineSpeeds, Gear
from controller.speeds import SpeedsWatch
from tests.unit.controller.toy_actuator import MS, B, N, U

TOLERANCE_RAD_S = 2.0


def watched(*reports: tuple[float, Gear], every_ms: int = 10, referred: Gear = U) -> SpeedsWatch:
    """Return a watch after reports: difference of the speeds in rad/s, gear."""
    watch = SpeedsWatch(TOLERANCE_RAD_S)
    for k, (apart_rad_s, gear) in enumerate(reports):
        watch.update(k * every_ms * MS, DrivelineSpeeds(80.0 + apart_rad_s, 80.0, referred), gear)
    return watch


@pytest.mark.parametrize("jump_rad_s", [20.0, -20.0, 7.0])
def test_a_jump_in_neutral_is_doubted_also_when_it_stays(jump_rad_s: float) -> None:
    assert watched((15.0, N), (15.2, N)).steady
    assert not watched((15.0, N), (15.0 + jump_rad_s, N)).steady
    assert not watched((15.0, N), *[(15.0 + jump_rad_s, N)] * 50).steady


@pytest.mark.parametrize("every_ms", [10, 40])
def test_an_engine_that_synchronises_is_not(every_ms: int) -> None:
    ramp = [(40.0 - 0.15 * every_ms * k + 0.4 * (-1) ** k, N) for k in range(8)]
    assert watched(*ramp, every_ms=every_ms).steady


def test_a_pause_of_the_reports_excuses_what_a_shaft_can_do_in_it() -> None:
    watch = watched((15.0, N))
    watch.update(10 * MS, None, N)
    watch.update(50 * MS, DrivelineSpeeds(80.0, 80.0), N)
    assert watch.steady
    watch.update(60 * MS, DrivelineSpeeds(95.0, 80.0), N)
    assert not watch.steady


def test_leaving_a_gear_and_another_ratio_are_no_jumps() -> None:
    assert watched((0.1, B), (0.0, U), (30.0, U), (30.0, N), (29.0, N)).steady
    watch = watched((30.0, N), referred=B)
    watch.update(10 * MS, DrivelineSpeeds(95.0, 80.0, Gear.FORWARD), N)
    assert watch.steady


def test_speeds_that_agree_in_a_gear_are_believed_again() -> None:
    jumped = (15.0, N), (35.0, N), (35.0, U)
    assert not watched(*jumped, (20.0, B)).steady
    assert watched(*jumped, (0.5, B), (0.5, U), (15.0, N)).steady
    assert not watched((0.5, B), (20.0, B), (35.0, U), (35.0, N)).steady, "wrong in a gear"
