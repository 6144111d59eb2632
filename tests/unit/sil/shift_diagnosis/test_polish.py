"""Fits of shifts continued by samples."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plant.parameters import load
from sil.shift_diagnosis.fit import FARTHEST, Fitter
from sil.shift_diagnosis.model import PlantModel
from sil.shift_diagnosis.polish import HOPELESS, continued
from sil.shift_diagnosis.verdict import Judged
from tests.support.truck_logs import truck_log
from tests.unit.sil.shift_diagnosis.fits import cut, in_turn, only


def test_fits_of_shifts_are_continued_and_none_gets_worse(tmp_path: Path) -> None:
    path = tmp_path / "late.log"
    truck_log(path, 2, 4, {"effect.valve_open_delay.delay_s": 0.007}, nominal=True)
    whole = Fitter(PlantModel(load("nominal"), True), cut(path))
    zeros = np.zeros(len(whole.names))
    whole.noise = replace(whole.noise, weights=whole.at(None, zeros).linear.weights)
    stopped = whole.at(only("valve_open_delay"), np.append(zeros, 1.0))  # short of 7 ms
    hopeless = Judged.of(whole.at(only("sensor_delay"), np.append(zeros, 4.0)))
    judged = [Judged.of(whole.at(None, zeros)), Judged.of(stopped), hopeless]
    assert hopeless.cost > min(item.cost for item in judged) + HOPELESS
    found = {item.id: item for item in continued(whole, judged, in_turn)}
    before = {item.id: item.cost for item in judged}
    assert set(found) == set(before)
    assert all(item.cost <= before[name] for name, item in found.items())
    late = found["valve_open_delay"]
    assert late.cost < before["valve_open_delay"] - 5.0
    assert late.fit.cause.value(late.fit.size) == pytest.approx(0.007, abs=0.001)
    assert np.abs(late.fit.values).max() <= FARTHEST
    assert found["sensor_delay"] is hopeless
