"""A cause is named only if no other start finds a better one and its own restarts agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plant.parameters import load
from sil.shift_diagnosis import challenge
from sil.shift_diagnosis.challenge import challenged, more_starts, to_be_named
from sil.shift_diagnosis.fit import Fitter
from sil.shift_diagnosis.model import PlantModel
from sil.shift_diagnosis.verdict import CERTAIN, Judged, weighed
from tests.bench.truck_logs import truck_log
from tests.unit.sil.shift_diagnosis.fits import cut, in_turn, judged, only

NAMES = ("valve_open_delay", "exhaust_clog", "sensor_temperature")


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Fitter:
    """Four shifts of a nominal truck whose valves open 7 ms late."""
    path = tmp_path_factory.mktemp("truck") / "late.log"
    truck_log(path, 2, 4, {"effect.valve_open_delay.delay_s": 0.007}, nominal=True)
    whole = Fitter(PlantModel(load("nominal"), True), cut(path))
    zeros = np.zeros(len(whole.names))
    whole.noise = replace(whole.noise, weights=whole.at(None, zeros).linear.weights)
    return whole


def first(whole: Fitter, name: str, size: float) -> list[Judged]:
    """A healthy truck, and a cause that the search claims without having fitted another."""
    zeros = np.zeros(len(whole.names))
    claimed = judged(whole, only(name), np.append(zeros, size))
    return weighed([judged(whole, None, zeros), claimed], 3)


def test_a_wrong_cause_gives_way_to_one_that_was_not_fitted(late: Fitter) -> None:
    found = first(late, "exhaust_clog", 1.0)
    found = [replace(item, probability=float(item.fit.cause is not None)) for item in found]
    assert to_be_named(found) == "exhaust_clog"
    after, _apart = challenged(late, found, [only(name) for name in NAMES], 3, in_turn)
    assert after[0].id == "valve_open_delay" and after[0].probability > 0.5
    assert {item.id for item in after} >= {"healthy", "exhaust_clog", "valve_open_delay"}


def test_the_right_cause_stands_and_its_restarts_agree(late: Fitter) -> None:
    found = first(late, "valve_open_delay", 2.0)
    assert to_be_named(found) == "valve_open_delay"
    causes = [only("valve_open_delay"), only("stop_wear")]  # in so few shifts, others look alike
    after, apart = challenged(late, found, causes, 3, in_turn)
    assert to_be_named(after) == "valve_open_delay"
    assert 0.0 <= apart < 1.0
    before = {item.fit.cause: item.cost for item in found}
    assert all(item.cost <= before.get(item.fit.cause, np.inf) for item in after)


def test_fits_that_end_apart_are_said_to(late: Fitter, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fits that stay where they begin end as far apart as they began."""
    found = first(late, "valve_open_delay", 2.0)
    monkeypatch.setattr(challenge, "final_fit", lambda whole, cause, at: whole.at(cause, at))
    causes = [only(name) for name in NAMES]
    after, apart = more_starts(late, found, causes, "valve_open_delay", in_turn)
    assert apart > 5.0
    assert min(after, key=lambda item: item.cost).id == "valve_open_delay"


def test_what_would_not_be_named_is_not_challenged(late: Fitter) -> None:
    found = [replace(item, probability=0.5) for item in first(late, "valve_open_delay", 2.0)]
    assert CERTAIN > 0.5 and to_be_named(found) == ""
    assert challenged(late, found, [only(name) for name in NAMES], 3, in_turn) == (found, 0.0)


def test_forms_of_one_effect_are_named_together(late: Fitter) -> None:
    healthy, claimed = sorted(first(late, "valve_open_delay", 2.0), key=lambda item: item.id)
    halves = [replace(claimed, probability=0.45), replace(claimed, probability=0.4)]
    assert to_be_named([replace(healthy, probability=0.15), *halves]) == "valve_open_delay"
