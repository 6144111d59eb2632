"""A cause is named only if more starts find no other and theory knows none that looks alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plant.parameters import load
from sil.shift_diagnosis.challenge import (
    alike_by_theory,
    challenged,
    to_be_named,
)
from sil.shift_diagnosis.fit import Fitter
from sil.shift_diagnosis.model import PlantModel
from sil.shift_diagnosis.verdict import CERTAIN, Detectable, Judged, weighed
from tests.support.truck_logs import truck_log
from tests.unit.sil.shift_diagnosis.fits import cut, in_turn, judged, only

NAMES = ("valve_open_delay", "exhaust_clog", "sensor_temperature")


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Fitter:
    """Four shifts of a nominal truck whose valves open 12 ms late."""
    path = tmp_path_factory.mktemp("truck") / "late.log"
    truck_log(path, 2, 4, {"effect.valve_open_delay.delay_s": 0.012}, nominal=True)
    whole = Fitter(PlantModel(load("nominal"), True), cut(path))
    zeros = np.zeros(len(whole.names))
    whole.noise = replace(whole.noise, weights=whole.at(None, zeros).linear.weights)
    return whole


@pytest.fixture(autouse=True)
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sil.shift_diagnosis.polish.GENERATIONS", 5)


def first(whole: Fitter, name: str, size: float) -> list[Judged]:
    """A healthy truck, and a cause that the search claims without having fitted another."""
    zeros = np.zeros(len(whole.names))
    claimed = judged(whole, only(name), np.append(zeros, size))
    return weighed([judged(whole, None, zeros), claimed], 3)


def test_a_wrong_cause_gives_way_to_one_that_was_not_fitted(late: Fitter) -> None:
    found = first(late, "exhaust_clog", 1.0)
    found = [replace(item, probability=float(item.fit.cause is not None)) for item in found]
    assert to_be_named(found) == "exhaust_clog"
    after = challenged(late, found, [only(name) for name in NAMES], 3, in_turn)
    assert after[0].id == "valve_open_delay" and after[0].probability > 0.5
    assert {item.id for item in after} >= {"healthy", "exhaust_clog", "valve_open_delay"}


def test_the_right_cause_stands(late: Fitter) -> None:
    found = first(late, "valve_open_delay", 4.0)
    assert to_be_named(found) == "valve_open_delay"
    causes = [only("valve_open_delay"), only("stop_wear")]  # in so few shifts, others look alike
    after = challenged(late, found, causes, 3, in_turn)
    assert to_be_named(after) == "valve_open_delay"
    before = {item.fit.cause: item.cost for item in found}
    assert all(item.cost <= before.get(item.fit.cause, np.inf) for item in after)


def test_a_cause_is_not_named_where_theory_says_that_another_looks_alike(late: Fitter) -> None:
    """However far behind a fit that explains the shifts ends."""
    found = first(late, "valve_open_delay", 4.0)
    zeros = np.zeros(len(late.names))
    rival = judged(late, only("sensor_delay"), np.append(zeros, 4.0))
    found = weighed([*found, replace(rival, cost=found[0].cost + 80.0)], 3)
    assert to_be_named(found) == "valve_open_delay"
    alike = Detectable(only("sensor_delay"), 1.0, ("valve_open_delay",))
    known = Detectable(only("valve_open_delay"), 1.0, ())
    assert alike_by_theory(found, [known]) == {}
    for detectable in ([known, alike], [replace(known, alike=("sensor_delay",))]):
        unsure = alike_by_theory(found, detectable)
        assert unsure == {"sensor_delay": pytest.approx(80.0)}
        assert to_be_named(weighed(found, 3, unsure)) == ""
    unfit = [replace(item, chi2=2.0) if item.id == "sensor_delay" else item for item in found]
    assert alike_by_theory(unfit, [alike]) == {}


def test_what_would_not_be_named_is_not_challenged(late: Fitter) -> None:
    found = [replace(item, probability=0.5) for item in first(late, "valve_open_delay", 4.0)]
    assert CERTAIN > 0.5 and to_be_named(found) == ""
    assert challenged(late, found, [only(name) for name in NAMES], 3, in_turn) == found


def test_forms_of_one_effect_are_named_together(late: Fitter) -> None:
    healthy, claimed = sorted(first(late, "valve_open_delay", 4.0), key=lambda item: item.id)
    halves = [replace(claimed, probability=0.45), replace(claimed, probability=0.4)]
    assert to_be_named([replace(healthy, probability=0.15), *halves]) == "valve_open_delay"
