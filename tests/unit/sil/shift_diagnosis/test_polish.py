"""Fits continued by samples: closed forms, kinks that stop slopes, and fits of shifts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plant.parameters import load
from sil.shift_diagnosis.fit import FARTHEST, Fitter
from sil.shift_diagnosis.model import PlantModel
from sil.shift_diagnosis.polish import HOPELESS, continued, evolved
from sil.shift_diagnosis.verdict import Judged
from tests.bench.truck_logs import truck_log
from tests.unit.sil.shift_diagnosis.fits import cut, in_turn, only


def test_the_least_of_a_narrow_ellipsoid_is_found_whatever_its_direction() -> None:
    rng = np.random.default_rng(3)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    form = axes @ np.diag(np.logspace(0.0, 4.0, 6)) @ axes.T
    least = rng.normal(size=6)

    def costs(points: list[np.ndarray]) -> np.ndarray:
        return np.array([(p - least) @ form @ (p - least) for p in points])

    found = evolved(costs, np.zeros(6), np.eye(6), 400)
    assert found == pytest.approx(least, abs=1e-3)
    assert np.array_equal(found, evolved(costs, np.zeros(6), np.eye(6), 400))


def test_small_kinks_do_not_hide_the_valley() -> None:
    """Slopes see the kinks alone: there are forty of them between the start and the least."""

    def costs(points: list[np.ndarray]) -> np.ndarray:
        return np.array([np.sum(p**2 + 2.0 * np.abs(np.sin(10.0 * p))) for p in points])

    start = np.full(4, 3.0)
    found = evolved(costs, start, np.eye(4), 200)
    assert costs([found])[0] < 0.1 * costs([start])[0]


def test_nothing_better_is_the_start_itself() -> None:
    def costs(points: list[np.ndarray]) -> np.ndarray:
        return np.array([float(np.abs(p).sum() > 0.0) for p in points])

    assert np.array_equal(evolved(costs, np.zeros(3), np.eye(3), 20), np.zeros(3))


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
