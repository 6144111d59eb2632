"""Speeds that no shaft can have: doubted from a jump in neutral until they agree in a gear."""

from __future__ import annotations

import pytest

from can_dbc.messages import DrivelineSpeeds, Gear
from controller.speeds import ReportTimes, SpeedsWatch
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


def test_they_have_agreed_once_they_did_so_in_a_gear_and_until_they_do_not_in_the_next() -> None:
    assert not watched((0.1, N), (0.1, N)).agreed, "in neutral any difference is possible"
    assert watched((0.1, N), (0.1, B)).agreed
    assert watched((0.1, B), (0.0, U), (30.0, N), (90.0, N)).agreed
    assert not watched((0.1, B), (0.0, U), (20.0, N), (20.0, B)).agreed


class TestReportTimes:
    def times_ms(self, *reports: tuple[int, int | None]) -> list[float]:
        """Return the times of reports, each a step in ms and a number."""
        own = ReportTimes()
        return [own.at_ns(step_ms * MS, number) / MS for step_ms, number in reports]

    def test_reports_of_their_cycle_count_from_the_steps_that_see_them(self) -> None:
        steps = [10 * k for k in range(40)]
        assert self.times_ms(*((ms, ms // 10) for ms in steps)) == steps

    def test_one_that_comes_just_before_its_step_counts_as_those_that_come_after(self) -> None:
        """Two in the step at 20 ms, none in that at 30 ms; two early ones in a row."""
        seen = (0, 14), (10, 15), (20, 17), (40, 18), (50, 19), (60, 21), (70, 22), (90, 23)
        assert self.times_ms(*seen) == [0, 10, 30, 40, 50, 70, 80, 90]

    def test_from_the_first_one_that_comes_after_its_step_all_count_so(self) -> None:
        seen = (0, 0), (10, 1), (30, 2), (40, 3), (50, 5), (60, 6), (70, 7)
        assert self.times_ms(*seen) == [0, 10, 30, 40, 60, 70, 80]

    def test_a_report_that_was_lost_does_not_matter(self) -> None:
        assert self.times_ms((0, 0), (10, 1), (40, 4), (50, 5)) == [0, 10, 40, 50]

    def test_a_sender_that_stopped_and_one_that_is_faster_count_from_the_step(self) -> None:
        assert self.times_ms((0, 0), (10, 1), (500, 2), (510, 3)) == [0, 10, 500, 510]
        assert self.times_ms((0, 0), (10, 1), (20, 9)) == [0, 10, 20]
        faster = [(10 * k, 2 * k) for k in range(20)]
        assert self.times_ms(*faster) == [ms for ms, _ in faster]

    def test_after_a_gap_it_begins_anew(self) -> None:
        """Without numbers, or without valid speeds, each counts from the step."""
        seen = (0, 0), (10, 1), (20, None), (30, None), (50, 3), (60, 5)
        assert self.times_ms(*seen) == [0, 10, 20, 30, 50, 60]
