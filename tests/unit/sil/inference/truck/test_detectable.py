"""What shifts would show: sizes tested by a fit, and what looks the same."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from sil.inference.truck import detectable
from sil.inference.truck.detectable import detectable_of, distances, gain_of
from sil.inference.truck.fit import Fit, Fitter
from tests.unit.sil.inference.truck.test_causes import only


def test_causes_that_do_the_same_are_no_distance_apart() -> None:
    causes = [only(n) for n in ("valve_open_delay", "sensor_delay", "detent")]
    slopes = np.array([[3.0, 0.0, 1.0], [1.5, 0.0, 0.5], [0.0, 2.0, 0.0]])
    apart = distances(slopes @ slopes.T, causes, 0, 2.0)
    assert apart[:2] == pytest.approx([0.0, 0.0])
    # the other one explains nothing of it, and is best absent
    assert apart[2] == pytest.approx(4.0 * 10.0)


def test_a_rival_of_the_wrong_sign_is_no_rival() -> None:
    causes = [only(n) for n in ("valve_open_delay", "sensor_delay")]
    slopes = np.array([[1.0, 1.0], [-1.0, -1.0]])
    assert distances(slopes @ slopes.T, causes, 0, 1.0)[1] == pytest.approx(2.0)


@pytest.fixture(scope="module")
def truck(fitter: Fitter, usual: Fit) -> Fit:
    return usual


def test_a_size_that_is_noticed_is_left_by_a_healthy_truck(fitter: Fitter, truck: Fit) -> None:
    cause = only("sensor_gain")
    (item,) = detectable_of(fitter, truck, [cause])
    assert item.size is not None and item.alike == ()
    assert 0.0 < abs(item.value) < 0.5
    quiet = gain_of(fitter, truck, cause, 0.1 * item.size)
    assert quiet < gain_of(fitter, truck, cause, item.size) - 5.0


def test_what_shows_at_no_size_has_none(fitter: Fitter, truck: Fit) -> None:
    # valves close long after these shifts have ended
    (item,) = detectable_of(fitter, truck, [only("valve_slow_close")])
    assert (item.size, item.value, item.alike) == (None, None, ())


def test_a_supply_that_no_log_states_may_be_low_in_a_healthy_truck(
    fitter: Fitter, truck: Fit
) -> None:
    fitter = copy(fitter)
    fitter.reference = fitter.slopes(truck)
    # at once, the fit of a healthy truck is stuck on its way there: at a cost of 50
    assert gain_of(fitter, truck, only("supply_low"), 4.0) < 5.0


def test_a_clogged_inlet_may_be_a_healthy_truck_begun_anew(
    monkeypatch: pytest.MonkeyPatch, fitter: Fitter, truck: Fit
) -> None:
    fitter = copy(fitter)
    fitter.reference = fitter.slopes(truck)
    anew = gain_of(fitter, truck, only("inlet_clog"), -4.0)
    monkeypatch.setattr(detectable, "TESTED", replace(detectable.TESTED, supplies=()))
    assert anew < gain_of(fitter, truck, only("inlet_clog"), -4.0) - 3.0


def test_of_many_shifts_some_are_tested_for_their_share(
    monkeypatch: pytest.MonkeyPatch, fitter: Fitter, truck: Fit
) -> None:
    (whole,) = detectable_of(fitter, truck, [only("sensor_gain")])
    monkeypatch.setattr(detectable, "TESTED", replace(detectable.TESTED, shifts=4))
    (part,) = detectable_of(fitter, truck, [only("sensor_gain")])
    assert part.size is not None and whole.size is not None
    assert part.size != whole.size and 0.5 < part.size / whole.size < 2.0
