"""Loads of single shifts: those put into a shift are found from its pulses."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from plant.parameters import load
from sil.shift_diagnosis.loads import BARRIERS, CONE, own_loads, vary, with_speeds
from sil.shift_diagnosis.model import PlantModel, Point
from sil.shift_diagnosis.shifts import RecordedShift, shifts_of


@pytest.fixture(scope="module")
def shifts(nominal_log: Path) -> list[RecordedShift]:
    return list(shifts_of(str(nominal_log), load("nominal"), None, Counter()))


def loaded(
    model: PlantModel, shift: RecordedShift, speed_rad_s: float, load_n: float
) -> RecordedShift:
    """Return a shift with these loads, its positions those of the model."""
    longer = np.append(shift.time_s, shift.time_s[-1] + 0.01 * np.arange(1, 11))
    own = replace(shift, difference_rad_s=speed_rad_s, load_n=load_n, time_s=longer)
    x, _v, done = model.predict([replace(own, position_m=np.zeros(len(longer)))], [Point()])
    assert done.all()
    return replace(own, position_m=x[0, 0])


def test_loads_are_found(shifts: list[RecordedShift]) -> None:
    model = PlantModel(load("nominal"), True)
    into = next(s for s in shifts if s.end in "BF")
    out = next(s for s in shifts if s.end == "N")
    true = [loaded(model, into, speed, 200.0) for speed in (5.0, 12.0, 25.0)]
    true += [loaded(model, out, 0.0, n) for n in (-250.0, 300.0, 600.0)]
    unknown = [replace(s, load_n=0.0, difference_rad_s=float("nan")) for s in true]
    found = own_loads(model, unknown, np.zeros(17), BARRIERS + CONE)
    for own, right in zip(found, true, strict=True):
        if right.end in "BF":
            assert own.difference_rad_s == pytest.approx(right.difference_rad_s, abs=0.8)
        else:
            assert own.load_n == pytest.approx(right.load_n, abs=60.0)
    # the slower the speeds meet, the more of the barrier shows
    assert found[0].load_n == pytest.approx(200.0, abs=60.0)
    assert vary(found, true)


def test_what_is_not_free_stays(shifts: list[RecordedShift]) -> None:
    model = PlantModel(load("nominal"), True)
    found = own_loads(model, shifts, np.zeros(17), CONE)
    assert all(s.load_n == 0.0 for s in found)
    found = own_loads(model, shifts, np.zeros(17), BARRIERS)
    assert [s.difference_rad_s for s in found] == [s.difference_rad_s for s in shifts]
    assert not vary(own_loads(model, shifts, np.zeros(17), BARRIERS + CONE), shifts)


def test_a_shift_that_cannot_be_simulated_stays_as_it_is(shifts: list[RecordedShift]) -> None:
    model = PlantModel(load("nominal"), True)
    into = next(s for s in shifts if s.end in "BF")

    def unable(variants: list[RecordedShift], _points: list[Point]) -> tuple[np.ndarray, ...]:
        nothing = np.full((len(variants), 1, len(into.time_s)), np.nan)
        return nothing, nothing, np.zeros((len(variants), 1), dtype=bool)

    broken = SimpleNamespace(predict=unable, unit=model.unit, mounted=True)
    assert own_loads(broken, [into], np.zeros(17), BARRIERS + CONE) == [into]


@pytest.mark.parametrize(("lacking", "left_out"), [(0, 0), (1, 1), (4, 4), (5, 0), (10, 0)])
def test_few_shifts_without_speeds_are_left_out(
    shifts: list[RecordedShift], lacking: int, left_out: int
) -> None:
    into = next(s for s in shifts if s.end in "BF")
    out = next(s for s in shifts if s.end == "N")
    silent = replace(into, difference_rad_s=float("nan"))
    log = [silent] * lacking + [into] * (10 - lacking) + [out] * 5
    skipped = Counter[str]()
    assert with_speeds(log, skipped) == log[left_out:]
    assert skipped.total() == left_out
