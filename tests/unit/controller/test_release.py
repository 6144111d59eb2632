"""When a push was released, from reports of the speeds."""

from __future__ import annotations

import pytest

from controller.strategies.release import Release


def falling(*apart_rad_s: float) -> Release:
    """Return a release after reports every 10 ms from 0.1 s on, the difference before it 20 rad/s."""
    made = Release()
    for k, each in enumerate(apart_rad_s):
        assert made.speeds(0.1 + 0.01 * k, each, 20.0)
    return made


@pytest.mark.parametrize(
    ("apart_rad_s", "released_s"),
    [
        ((10.0, 0.0), 0.11),
        ((15.0, 10.0, 5.0, 0.0), 0.13),
        ((18.0, 14.0, 6.0, 0.0), 0.12 + 0.01 * 6.0 / (8.0 + 0.7 * 4.0)),
        ((15.0, 12.0, 9.0, 0.0), 0.13),
    ],
    ids=["after one report", "steadily", "ever faster", "not yet when it was expected"],
)
def test_the_release_is_where_the_fall_goes_on_to(
    apart_rad_s: tuple[float, ...], released_s: float
) -> None:
    made = falling(*apart_rad_s)
    assert made.released_s == pytest.approx(released_s)
    assert not made.is_open


@pytest.mark.parametrize("none_s", [0.14, 0.15, 0.16])
def test_reports_that_are_missing_do_not_move_the_release(none_s: float) -> None:
    """One between the last two of a difference, and up to two before the first of none."""
    made = Release()
    for at_s, apart_rad_s in ((0.1, 18.0), (0.11, 14.0), (0.13, 4.0), (none_s, 0.0)):
        assert made.speeds(at_s, apart_rad_s, 20.0)
    assert made.released_s == pytest.approx(0.13 + 0.01 * 4.0 / 5.7)


def test_a_fall_between_two_reports_gives_no_release() -> None:
    made = Release()
    assert not made.speeds(0.1, 0.5, 20.0)
    assert made.released_s is None
    assert falling(10.0).is_open and falling(10.0).is_falling
    assert not (falling().is_open or falling().is_falling)
