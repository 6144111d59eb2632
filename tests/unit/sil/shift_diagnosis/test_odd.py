"""Odd shifts: those that their own scatter explains, and the others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from plant.parameters import load
from sil.shift_diagnosis import odd
from sil.shift_diagnosis.fit import Fitter
from sil.shift_diagnosis.linear import Noise
from sil.shift_diagnosis.model import PlantModel, Point
from sil.shift_diagnosis.odd import is_scatter, is_usual, own_impulses, with_odd, without_odd
from tests.support.truck_logs import truck_log
from tests.unit.sil.shift_diagnosis.fits import cut

LIMIT = 3.0
"""Chi squared per number."""


def test_few_odd_shifts_count_less(monkeypatch: pytest.MonkeyPatch) -> None:
    weights = tuple(np.eye(10) for _ in range(20))

    def fit(count_odd: int, unable: int = 0) -> SimpleNamespace:
        misfit = np.where(np.arange(20) < count_odd, 300.0, 10.0)
        count = np.where(np.arange(20) < 20 - unable, 10, 0)
        return SimpleNamespace(linear=SimpleNamespace(misfit=misfit, count=count, weights=weights))

    explained = set[int]()
    monkeypatch.setattr(odd, "is_scatter", lambda _fitter, _fit, k, _limit: k in explained)
    scaled, unexplained = without_odd(fit(2), None)
    assert unexplained == [0, 1]
    assert scaled[0][0, 0] == pytest.approx(0.1) and scaled[5] == pytest.approx(np.eye(10))
    # what cannot be simulated leaves no residual, and is not explained either
    assert without_odd(fit(0, unable=1), None)[1] == [19]
    assert without_odd(fit(5, unable=1), None)[1] == [19]
    # many are no oddity
    assert without_odd(fit(5), None) == (weights, [])
    # what a shift's own quantities explain counts less, but is not reported, nor one of many
    explained |= {0, 1}
    scaled, unexplained = without_odd(fit(3), None)
    assert unexplained == [2] and scaled[0][0, 0] == pytest.approx(0.1)
    scaled, unexplained = without_odd(fit(5), None)
    assert unexplained == [2, 3, 4] and scaled[0][0, 0] == pytest.approx(0.1)


def test_with_odd_shifts_a_truck_is_not_consistent() -> None:
    shifts = [SimpleNamespace(begin_s=10.0 * k, source="logs/a.log") for k in range(20)]
    verdict, findings = with_odd("consistent", ["other"], shifts, [3, 7])
    assert verdict == "cannot_tell"
    assert findings[0].startswith("2 of 20 shifts fit far worse than the others")
    assert findings[0].endswith("they begin at 30.00 s of a.log, 70.00 s of a.log")
    assert findings[1:] == ["other"]
    assert with_odd("named", [], shifts, [3])[0] == "named"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Fitter:
    """A nominal truck of sixteen shifts, of which pulses come just before the synchronizer lets go."""
    path: Path = tmp_path_factory.mktemp("odd") / "truck.log"
    truck_log(path, 5, 16, nominal=True)
    return Fitter(PlantModel(load("nominal"), True), cut(path), Noise(scatter=0.5))


def into_gear(fitter: Fitter) -> int:
    """Return the shift into gear that the synchronizer holds longest."""
    found = [k for k, shift in enumerate(fitter.shifts) if shift.end in "BF"]
    return max(found, key=lambda k: abs(fitter.shifts[k].difference_rad_s))


def with_shift(fitter: Fitter, k: int, **changes: object) -> Fitter:
    shifts = list(fitter.shifts)
    shifts[k] = replace(shifts[k], **changes)
    return Fitter(fitter.model, shifts, fitter.noise)


def test_an_unusual_impulse_is_found_and_nothing_else_is_touched(whole: Fitter) -> None:
    zeros = np.zeros(len(whole.names))
    usual = own_impulses(whole, whole.at(None, zeros), whole.shifts)
    assert all(a is b for a, b in zip(usual, whole.shifts, strict=True))
    k = into_gear(whole)
    true = whole.shifts[k].difference_rad_s
    unusual = with_shift(whole, k, difference_rad_s=true * np.exp(0.04 * 3.0))
    healthy = unusual.at(None, zeros)
    assert healthy.linear.misfit[k] > LIMIT * healthy.linear.count[k]
    found = own_impulses(unusual, healthy, unusual.shifts)
    assert [j for j, now in enumerate(found) if now is not unusual.shifts[j]] == [k]
    assert true < found[k].difference_rad_s < 0.97 * unusual.shifts[k].difference_rad_s
    explained = Fitter(whole.model, found, whole.noise).at(None, zeros).linear
    assert explained.misfit[k] < LIMIT * explained.count[k]


def test_as_many_deviations_as_large_as_chance_makes_are_usual() -> None:
    assert is_usual([], 5) and is_usual([-3.0], 6) and is_usual([1.75, -3.0], 6)
    assert not is_usual([3.5, -3.5], 5)
    assert is_usual([3.5], 60) and not is_usual([3.0] * 5, 60)
    rng = np.random.default_rng(1)
    drawn = np.abs(rng.normal(size=(2000, 30)))
    unusual = sum(not is_usual(own[own > 2.0], 30) for own in drawn)
    assert 1 <= unusual <= 10  # 1e-3 for each of the largest


def test_many_odd_shifts_are_no_scatter(whole: Fitter) -> None:
    fitter = whole
    for k, shift in enumerate(whole.shifts):
        if shift.end in "BF":
            fitter = with_shift(fitter, k, difference_rad_s=shift.difference_rad_s * np.exp(0.12))
    found = own_impulses(fitter, fitter.at(None, np.zeros(len(fitter.names))), fitter.shifts)
    assert all(a is b for a, b in zip(found, fitter.shifts, strict=True))


def moved(fitter: Fitter, k: int, amounts: dict[str, float]) -> Fitter:
    """Return shifts of which one was recorded with quantities of its own."""
    x, _v, done = fitter.model.predict([fitter.shifts[k]], [Point(amounts)])
    assert done.all()
    return with_shift(fitter, k, position_m=x[0, 0])


@pytest.mark.parametrize(
    ("name", "deviations", "is_usual"),
    [("cone", 3.0, True), ("cone", 8.0, False), ("rise", 4.0, True), ("rise", 20.0, False)],
)
def test_what_own_quantities_explain_is_scatter(
    whole: Fitter, name: str, deviations: float, is_usual: bool
) -> None:
    zeros, k = np.zeros(len(whole.names)), into_gear(whole)
    name = f"cone_{whole.shifts[k].end}" if name == "cone" else name
    fitter = moved(whole, k, {name: deviations * whole.model.each[name]})
    assert is_scatter(fitter, fitter.at(None, zeros), k, LIMIT) == is_usual


def test_loads_are_scatter_where_they_differ_from_shift_to_shift(whole: Fitter) -> None:
    zeros, k = np.zeros(len(whole.names)), into_gear(whole)
    fitter = moved(whole, k, {"mesh": 600.0})
    assert not is_scatter(fitter, fitter.at(None, zeros), k, LIMIT)
    fitter.noise = replace(fitter.noise, loads=("mesh", "pull"))
    assert is_scatter(fitter, fitter.at(None, zeros), k, LIMIT)


def test_a_sensor_that_sticks_is_no_scatter(whole: Fitter) -> None:
    zeros, k = np.zeros(len(whole.names)), into_gear(whole)
    at = int(np.argmax(np.abs(whole.shifts[k].position_m) > 1e-3))
    stuck = whole.shifts[k].position_m.copy()
    stuck[at] = stuck[at - 1]
    fitter = with_shift(whole, k, position_m=stuck)
    healthy = fitter.at(None, zeros)
    assert healthy.linear.misfit[k] > LIMIT * healthy.linear.count[k]
    assert not is_scatter(fitter, healthy, k, LIMIT)
