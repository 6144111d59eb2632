"""Fits by Gauss and Newton: on any number of processes, and without asking the plant twice."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from plant.parameters import load
from sil.shift_diagnosis.fit import Fitter, fits_of
from sil.shift_diagnosis.linear import Noise
from sil.shift_diagnosis.model import PlantModel, catalogue
from sil.shift_diagnosis.shifts import shifts_of


@pytest.fixture
def fitter(nominal_log: Path) -> Fitter:
    shifts = list(shifts_of(str(nominal_log), load("nominal"), None, Counter()))
    return Fitter(PlantModel(load("nominal"), mounted=True), shifts[:2])


def test_fits_are_the_same_on_two_processes(fitter: Fitter) -> None:
    cause = next(c for c in catalogue() if c.effect.id == "valve_open_delay")
    zeros = np.zeros(len(fitter.names))
    items = [(None, zeros), (cause, np.append(zeros, 1.0)), (cause, np.append(zeros, 2.0))]
    work = partial(fitter.fit, rounds=2)
    alone, shared = (fits_of(work, items, workers) for workers in (1, 2))
    assert [fit.cause for fit in shared] == [None, cause, cause]
    assert shared[1].linear.causes == (cause,) and shared[0].linear.causes == ()
    for one, other in zip(alone, shared, strict=True):
        assert np.array_equal(one.point, other.point) and one.cost == other.cost


def test_a_point_is_linearised_once(fitter: Fitter, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    predict = fitter.model.predict

    def counted(shifts: list, points: list) -> tuple[np.ndarray, ...]:
        asked.append(len(points))
        return predict(shifts, points)

    monkeypatch.setattr(fitter.model, "predict", counted)
    zeros = np.zeros(len(fitter.names))
    first = fitter.at(None, zeros)
    assert fitter.at(None, zeros) is first and len(asked) == 1
    # not with other noise, at another step, or elsewhere
    fitter.at(None, zeros, Noise(scatter=0.5))
    fitter.at(None, zeros, difference=0.5)
    fitter.at(None, zeros + 0.1)
    assert len(asked) == 4
