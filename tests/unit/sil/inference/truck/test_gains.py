"""Gains by secants: information with all else free."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from sil.inference.truck.fit import FINE_M, Fit, Fitter
from sil.inference.truck.gains import Beside, gains_of, likeness, secants
from tests.unit.sil.inference.truck.test_causes import only


def test_what_the_truck_itself_does_carries_no_information(fitter: Fitter, usual: Fit) -> None:
    beside = Beside.of(fitter, usual)
    slopes = fitter.derivatives(usual, 0.3, (1.0, -1.0))
    # what the truck does itself is known no better than by the prior, 7/6 in the middle of Student's t
    offset = slopes[None, :, :, fitter.layout.at["offset"]]
    fresh = np.random.default_rng(1).normal(size=offset.shape) * 1e-4
    information, _ = beside.information(np.concatenate([offset, fresh]))
    assert 0.0 <= information[0, 0] <= 7.0 / 6.0
    assert information[1, 1] > 100.0
    assert information == pytest.approx(information.T)


def test_a_secant_is_the_motion_by_one_typical_size(fitter: Fitter, usual: Fit) -> None:
    small, large = secants(fitter, usual, only("sensor_gain"), [0.4, 3.0])
    assert small == pytest.approx(large, abs=1e-7)
    x = np.where(fitter.model.recorded, small, 0.0)
    assert np.max(np.abs(x)) == pytest.approx(0.05 * np.max(np.abs(usual.position_m)), rel=0.01)


def test_gains_have_physical_sizes(fitter: Fitter, usual: Fit) -> None:
    causes = [only(name) for name in ("valve_open_delay", "dynamic_friction", "external_force")]
    for cause, (gain, size) in zip(causes, gains_of(fitter, usual, causes), strict=True):
        assert gain >= 0.0 and (gain > 0.0) == (size != 0.0)
        assert size * cause.sign >= 0.0


def test_what_is_like_a_narrow_hose(fitter: Fitter, usual: Fit) -> None:
    hose, others = only("hose_droop"), ("leak_to_atmosphere", "piston_leak", "back_pressure")
    truck = fitter.evaluated(replace(usual, cause=hose, size=12.0), FINE_M)
    assert truck.position_m is not None
    seen = copy.copy(fitter)
    seen.position_m = truck.position_m
    truck = seen.evaluated(truck, FINE_M)
    sizes = (1.5, 3.0, 6.0, 12.0)
    (itself, size), *rest = likeness(seen, truck, [hose, *map(only, others)], sizes)
    assert itself == pytest.approx(0.0, abs=1e-6) and size == pytest.approx(12.0)
    behind = [value for value, _ in rest]
    assert 0.0 < behind[0] < 0.2 * min(behind[1:])
    # between two sizes, with all else free
    ((near, size),) = likeness(seen, truck, [hose], (8.0, 15.0))
    assert 0.0 <= near < 1.0 and 9.0 < size < 15.0
    # a piston so free of the stay cannot be simulated
    assert likeness(seen, truck, [only("free_play")], (24.0,))[0][0] == np.inf
    # no size so small is tried
    assert likeness(seen, truck, [hose], (0.1,)) == [(np.inf, 0.0)]
