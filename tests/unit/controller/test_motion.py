"""What samples of the position tell of a push."""

from __future__ import annotations

import pytest

from controller.position import Sample
from controller.strategies.motion import (
    ARRIVED,
    BLOCK_M,
    FAR_M,
    HIGHEST_M,
    LOWEST_M,
    MEAN_PA,
    SCATTER_S,
    Motion,
)

PERIOD_S, STROKE_M = 0.01, 0.01285
MM = 0.001


def taken(
    *ways_mm: float, falls_at: int = 6, supply_pa: float = MEAN_PA, rest_mm: float = 0.0
) -> Motion:
    """Return the motion after samples every 10 ms, m from neutral plus `rest_mm`; from one on the speeds fall."""
    motion = Motion(PERIOD_S, STROKE_M, supply_pa)
    for k, way_mm in enumerate(ways_mm):
        at_m, was_unknown = MM * (rest_mm + way_mm), motion.onset_s is None
        found = motion.position([Sample(at_m, at_m, 0.0)], PERIOD_S * k, k >= falls_at)
        assert found == (was_unknown and motion.onset_s is not None)
    return motion


def test_the_onset_is_found_in_the_first_sample_on_the_way_to_the_block() -> None:
    for before_mm, way_mm in ((0.0, 0.4), (0.1, 2.0), (0.2, 5.3)):
        motion = taken(0.0, 0.0, 0.0, before_mm, way_mm, 5.99)
        assert motion.onset_s == pytest.approx(0.04 - motion._taken(MM * way_mm))
        assert 0.015 < motion.onset_s < 0.036
    moved = taken(0.0, 0.0, 0.0, 0.0, 2.0, 5.99, rest_mm=-0.3)
    assert moved.onset_s == pytest.approx(0.04 - motion._taken(2.0 * MM))
    jumped = taken(0.0, 0.0, 0.0, 0.0, 1e3 * HIGHEST_M + 0.01, 5.99)
    assert jumped.onset_s is None and not jumped.seeks_onset
    still = taken(*[0.5e3 * LOWEST_M] * 6)
    assert still.onset_s is None and still.seeks_onset


def test_a_way_takes_longer_the_farther_and_the_less_pressure() -> None:
    motions = [Motion(PERIOD_S, STROKE_M, 1e5 * bar) for bar in (8.0, 8.5, 9.0)]
    for motion in motions:
        times_s = [motion._taken(MM * 0.1 * k) for k in range(3, 55)]
        assert times_s == sorted(times_s)
    low, mean, high = (motion._taken(2.0 * MM) for motion in motions)
    assert low - mean == pytest.approx(mean - high)
    assert 0.0005 < low - mean < 0.002


def test_two_samples_in_a_step_tell_no_onset() -> None:
    motion = taken(0.0, 0.0)
    two = [Sample(MM * mm, MM * mm, 0.0) for mm in (0.1, 2.0)]
    assert not motion.position(two, 0.04, False)
    assert motion.onset_s is None and not motion.seeks_onset


def test_the_release_is_found_in_the_first_sample_beyond_the_block() -> None:
    """The block is where the sample before was, if that was near it: the sensor's scale is not exact."""
    at_block = (0.0, 0.0, 0.0, 0.0, 2.0, 6.05, 6.05)
    for beyond_mm in (0.3, 1.5, 3.0, 6.0):
        motion = taken(*at_block, 6.05 + beyond_mm, 12.85)
        assert motion.left == pytest.approx((0.07, MM * beyond_mm))
        assert motion.onset_s is not None
        for is_plain in (True, False):
            found = motion.released_s(0.09, is_plain)
            assert found is not None
            assert 0.054 < found[0] < 0.07
            assert found[1] == SCATTER_S[is_plain, MM * beyond_mm >= FAR_M] ** 2
    away = taken(0.0, 0.0, 0.0, 0.0, 2.0, 5.79, 6.05)
    assert away.left is None, "on the way to the block"
    away = taken(0.0, 0.0, 0.0, 0.0, 2.0, 5.7, 7.0)
    assert away.left == pytest.approx((0.06, MM * 7.0 - BLOCK_M))
    assert taken(*at_block, 6.2, 6.25).left is None, "it gives way a little"
    assert taken(*at_block, 7.0, falls_at=9).left is None, "the speeds have not begun to fall"
    assert taken(*at_block).released_s(0.09, True) is None
    early = taken(*at_block, 7.0, falls_at=4)
    assert early.left == pytest.approx((0.07, MM * 0.95)), (
        "they fell before the stay was at the block"
    )


def test_the_farther_from_the_block_the_longer_ago_and_the_faster_the_later() -> None:
    for is_plain in (True, False):
        times_s = []
        for k in range(26, 170):
            motion = Motion(PERIOD_S, STROKE_M, MEAN_PA)
            motion.left = 0.1, 1e-5 * k
            late, early = motion.released_s(0.2, is_plain), motion.released_s(0.09, is_plain)
            assert late is not None and early is not None
            assert late[0] > early[0]
            times_s.append(early[0])
        assert times_s == sorted(times_s, reverse=True)


def test_the_arrival_is_between_two_samples_and_only_while_the_speeds_fall() -> None:
    ways = (0.0, 0.0, 0.0, 0.0, 2.0, 6.0, 6.0, 9.0, 12.0, 12.85)
    motion = taken(*ways)
    over_mm = 12.0 - 1e3 * ARRIVED * STROKE_M
    assert motion.arrived_s == pytest.approx(0.08 - 0.01 * over_mm / 3.0)
    assert motion.fastest_m_s == pytest.approx(0.3)
    assert taken(*ways, falls_at=20).arrived_s is None
    assert taken(*ways, falls_at=20).fastest_m_s == 0.0
