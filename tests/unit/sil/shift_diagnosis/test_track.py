"""A truck over months: what changes is found and dated, a steady truck is left in peace."""

from __future__ import annotations

import numpy as np
import pytest

from sil.shift_diagnosis.track import BLOCK, CELLS, Track
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


def test_steady_trucks_have_no_change_and_bounded_memory() -> None:
    for seed in range(3):
        track = watched(np.zeros((20_000, 5)), seed)
        assert track.changes == []
        assert len(track.count) < CELLS
        assert int(track.count.sum()) == track.shifts == 20_000


def test_wider_scatter_than_stated_is_learned() -> None:
    generator = np.random.default_rng(1)
    information = information_of(generator, 5)
    track = Track.of(("a", "b", "c", "d", "e"))
    for begin in range(0, 20_000, 500):
        h, z = observed(generator, np.zeros((500, 5)), information)
        track.take(h, 3.0 * z, np.arange(begin, begin + 500.0))
    assert track.changes == []
    assert np.all((track.scatter2 > 7.0) & (track.scatter2 < 11.0))


def test_a_stored_track_goes_on_as_if_it_had_never_stopped() -> None:
    generator = np.random.default_rng(4)
    information = information_of(generator, 3)
    sizes = np.zeros((5000, 3))
    sizes[2500:, 0] = 0.6
    h, z = observed(generator, sizes, information)
    at = np.arange(5000.0)
    whole, broken = Track.of(("a", "b", "c")), Track.of(("a", "b", "c"))
    whole.take(h, z, at)
    for begin in (0, 7, 2490, 2600):
        end = {0: 7, 7: 2490, 2490: 2600, 2600: 5000}[begin]
        broken.take(h[begin:end], z[begin:end], at[begin:end])
        broken = Track.from_bytes(broken.to_bytes())
    assert whole.changes == broken.changes != []
    assert np.allclose(whole.information, broken.information)
    assert whole.scatter2 == pytest.approx(broken.scatter2)
