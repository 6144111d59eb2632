"""A truck over months: what changes is found and dated, a steady truck is left in peace."""

from __future__ import annotations

import numpy as np
import pytest

from sil.shift_diagnosis.cells import BLOCK, CELLS
from sil.shift_diagnosis.track import Track
from tests.bench.watch_rates import information_of, observed, watched


def test_a_step_is_dated() -> None:
    sizes = np.zeros((6000, 5))
    sizes[3310:, 2] = 0.8
    (change,) = watched(sizes, 1).changes
    assert "p2" in (change.name, *change.alike)
    assert change.kind == "step"
    assert abs(change.shift - 3310) <= 2 * BLOCK
    assert change.low <= 3310 <= change.high
    assert 3310 < change.found < 3800


def test_a_drift_is_dated_and_its_slope_estimated() -> None:
    sizes = np.zeros((12_000, 5))
    sizes[4000:, 1] = np.arange(8000) / 4000.0
    track = watched(sizes, 2)
    drifts = [change for change in track.changes if change.kind == "drift"]
    assert len(track.changes) == 1 and drifts[0].name == "p1"
    assert abs(drifts[0].shift - 4000) <= 200
    assert drifts[0].low <= 4000 <= drifts[0].high
    now, slope, covariance = track.drift(1)
    assert now == pytest.approx(2.0, abs=5.0 * float(np.sqrt(covariance[0, 0])))
    assert slope == pytest.approx(1.0 / 4000.0, rel=0.1)


def test_a_drift_that_first_looked_like_steps_of_others_is_one_drift() -> None:
    seed, begin, k = 2016, 9223, 0  # four steps by other names come before it is a drift
    sizes = np.zeros((20_000, 12))
    own = information_of(np.random.default_rng(seed))[k, k] ** -0.5
    sizes[begin:, k] = 0.26 * own * np.arange(20_000 - begin) / 1000.0
    (change,) = watched(sizes, seed).changes
    assert (change.name, change.kind) == ("p0", "drift")
    assert abs(change.shift - begin) <= 200 and change.low <= begin <= change.high


@pytest.mark.parametrize("gap", [200, 1500])
def test_two_steps_are_not_made_one_drift(gap: int) -> None:
    sizes = np.zeros((12_000, 5))
    sizes[4000:, 2] = 1.0
    sizes[4000 + gap :, 2] = 2.0
    changes = watched(sizes, 4).changes
    assert [change.kind for change in changes] == ["step", "step"]
    assert [abs(c.shift - at) <= BLOCK for c, at in zip(changes, (4000, 4000 + gap), strict=True)]


def test_steady_trucks_have_no_change_and_bounded_memory() -> None:
    for seed in range(3):
        track = watched(np.zeros((20_000, 5)), seed)
        assert track.changes == []
        assert len(track.count) < CELLS
        assert int(track.count.sum()) == track.shifts == 20_000


@pytest.mark.parametrize("of_trip", [8, 60])
def test_trips_that_differ_are_no_change(of_trip: int) -> None:
    for seed in range(3):
        track = watched(np.zeros((4000, 5)), seed, of_trip, between=1.0)
        assert track.changes == []
        assert track.trips.sum() == pytest.approx(track.scatter.trips)
        # between trips at least as much as drawn: by one parameter, what the others do counts, too
        own = np.sqrt(track.scatter.between2 / track.scatter.of_shift2)
        assert np.all((own > 0.7) & (own < 4.0))


def test_trips_of_one_truck_are_not_held_to_differ_more_than_they_do() -> None:
    track = watched(np.zeros((12_000, 5)), 3, 60)
    assert np.all(track.scatter.between2 < 0.03 * track.scatter.of_shift2)


def test_a_change_larger_than_what_trips_differ_by_is_dated() -> None:
    sizes = np.zeros((4000, 5))
    own = np.diag(information_of(np.random.default_rng(6), 5)) ** -0.5
    sizes[2500:, 3] = 12.0 * own[3]
    (change,) = watched(sizes, 6, 60, between=1.0).changes
    assert "p3" in (change.name, *change.alike)
    assert abs(change.shift - 2500) <= 200 and change.low <= 2500 <= change.high


def test_a_first_trip_says_nothing_of_the_second() -> None:
    generator = np.random.default_rng(2)
    information = information_of(generator, 3)
    track = Track.of(("a", "b", "c"))
    for trip, size in enumerate((0.0, 3.0)):
        h, z = observed(generator, np.full((400, 3), size), information)
        track.take(h, z, 1e5 * trip + np.arange(400.0))
    assert track.changes == []


@pytest.mark.parametrize("anew", [False, True])
def test_another_point_of_linearisation_is_no_change(anew: bool) -> None:
    """After a change at 1000 another point moves what the shifts show; a change at 3000 counts."""
    generator = np.random.default_rng(3)
    information = information_of(generator, 3)
    track = Track.of(("a", "b", "c"))
    for begin in range(0, 4000, 100):
        sizes = np.full((100, 3), [3.0 * (begin >= 1000), 0.0, 3.0 * (begin >= 3000)])
        if track.is_far and anew:
            track.linearised_at(np.array([3.0, 0.0, 0.0]))
        if begin >= 1100:
            sizes[:, 1] += 3.0
        h, z = observed(generator, sizes, information)
        track.take(h, z, np.arange(begin, begin + 100.0))
    dates = [change.shift for change in track.changes]
    assert dates == ([1000, 3000] if anew else [1000, 1100, 3000])
    assert track.base == (3100 if anew else 0)
    assert all(change.low <= change.shift <= change.high for change in track.changes)


def test_wider_scatter_than_stated_is_learned() -> None:
    generator = np.random.default_rng(1)
    information = information_of(generator, 5)
    track = Track.of(("a", "b", "c", "d", "e"))
    for begin in range(0, 20_000, 500):
        h, z = observed(generator, np.zeros((500, 5)), information)
        track.take(h, 3.0 * z, np.arange(begin, begin + 500.0))
    assert track.changes == []
    assert np.all((track.scatter.within2 > 7.0) & (track.scatter.within2 < 11.0))


def test_a_stored_track_goes_on_as_if_it_had_never_stopped() -> None:
    generator = np.random.default_rng(4)
    information = information_of(generator, 3)
    sizes = np.zeros((5000, 3))
    sizes[2500:, 0] = 0.6
    h, z = observed(generator, sizes, information)
    at = np.arange(5000.0) + 1e4 * (np.arange(5000) // 130)
    whole, broken = Track.of(("a", "b", "c")), Track.of(("a", "b", "c"))
    whole.take(h, z, at)
    for begin in (0, 7, 2490, 2600):
        end = {0: 7, 7: 2490, 2490: 2600, 2600: 5000}[begin]
        broken.take(h[begin:end], z[begin:end], at[begin:end])
        broken = Track.from_bytes(broken.to_bytes())
    assert whole.changes == broken.changes != []
    assert np.allclose(whole.information, broken.information)
    assert whole.scatter.within2 == pytest.approx(broken.scatter.within2)
