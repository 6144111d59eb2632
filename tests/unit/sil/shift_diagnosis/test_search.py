"""The search for causes: rivals of the best one, second attempts, and which hypothesis leads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from plant.parameters import load
from sil.inference.candidate import candidates
from sil.shift_diagnosis.fit import Fitter
from sil.shift_diagnosis.linear import TAIL, projected
from sil.shift_diagnosis.model import (
    PlantModel,
    Point,
    catalogue,
    unit_priors,
)
from sil.shift_diagnosis.search import (
    HOPELESS,
    LEADING,
    close_ones,
    healthy_again,
    is_settled,
    linear_at,
    on_all,
    second_attempt,
    with_rivals,
)
from sil.shift_diagnosis.verdict import ALARM, DOUBTED, SEPARABLE, Judged, weighed
from tests.reference.truck import write_log
from tests.support.bus_groups import PHASE_S
from tests.support.bus_information import quiet_truck
from tests.support.truck_logs import truck_log
from tests.unit.sil.shift_diagnosis.fits import cut, in_turn, judged, only


def test_what_looks_like_the_best_cause_is_fitted_too(tmp_path: Path) -> None:
    path = tmp_path / "late.log"
    truck_log(path, 2, 4, {"effect.valve_open_delay.delay_s": 0.007}, nominal=True)
    whole = Fitter(PlantModel(load("nominal"), True), cut(path))
    late, alike, other = only("valve_open_delay"), only("sensor_delay"), only("stop_wear")
    found = [
        judged(whole, None, np.zeros(len(whole.names))),
        judged(whole, late, np.append(np.zeros(len(whole.names)), 2.0)),
    ]
    assert found[1].cost < found[0].cost
    rivals = with_rivals(whole, weighed(found, 3), [late, alike, other], in_turn)
    costs = {item.id: item.cost for item in rivals}
    # a late pulse is a late valve; an end stop elsewhere is not
    assert set(costs) == {"healthy", "valve_open_delay", "sensor_delay"}
    assert costs["sensor_delay"] < costs["valve_open_delay"] + 0.5 * SEPARABLE
    (rival,) = [item for item in rivals if item.id == "sensor_delay"]
    assert rival.fit.cause.value(rival.size[0]) == pytest.approx(0.007, abs=0.002)


def test_the_second_attempt_finds_what_the_first_search_left_out(tmp_path: Path) -> None:
    path = tmp_path / "late.log"
    truck_log(path, 2, 4, {"effect.valve_open_delay.delay_s": 0.007}, nominal=True)
    whole = Fitter(PlantModel(load("nominal"), True), cut(path))
    late, hollow, warm = only("valve_open_delay"), only("exhaust_clog"), only("sensor_temperature")
    zeros = np.zeros(len(whole.names))
    first = [judged(whole, None, zeros), judged(whole, warm, np.append(zeros, 0.5))]
    found = second_attempt(whole, whole, weighed(first, 3), [late, hollow, warm], in_turn)
    costs = {item.id: item.cost for item in found}
    assert set(costs) == {"healthy", "valve_open_delay", "exhaust_clog", "sensor_temperature"}
    assert min(costs, key=costs.__getitem__) == "valve_open_delay"
    assert costs["valve_open_delay"] < costs["healthy"] - 5.0
    # what was found before is lost by no worse fit
    assert costs["sensor_temperature"] <= first[1].cost


def test_what_explains_less_than_it_leaves_is_no_rival_by_its_information(tmp_path: Path) -> None:
    """Next to a cause of a tiny size everything is, also what does nothing at all."""
    path = tmp_path / "usual.log"
    truck_log(path, 2, 4, nominal=True)
    whole = Fitter(PlantModel(load("nominal"), True), cut(path))
    late, alike, other = only("valve_open_delay"), only("sensor_delay"), only("stop_wear")
    zeros = np.zeros(len(whole.names))
    best = Judged.of(whole.at(late, np.append(zeros, 0.05)))
    found = [replace(best, cost=best.cost - 20.0), Judged.of(whole.at(None, zeros))]
    rivals = with_rivals(whole, weighed(found, 3), [late, alike, other], in_turn)
    costs = {item.id: item.cost for item in rivals}
    assert costs["sensor_delay"] < found[0].cost + 0.5 * SEPARABLE
    assert costs["stop_wear"] > found[0].cost + 0.5 * SEPARABLE


def test_a_healthy_truck_has_no_rivals(nominal_log: Path) -> None:
    whole = Fitter(PlantModel(load("nominal"), True), cut(nominal_log)[:2])
    found = weighed([judged(whole, None, np.zeros(len(whole.names)))], 1)
    assert with_rivals(whole, found, [only("sensor_delay")], in_turn) == found


@pytest.mark.parametrize(("delay_s", "is_worth_it"), [(0.0, False), (0.007, True)])
def test_a_healthy_truck_that_was_fitted_badly_is_no_worse_than_the_information_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, delay_s: float, is_worth_it: bool
) -> None:
    path = tmp_path / "truck.log"
    cause = {"effect.valve_open_delay.delay_s": delay_s} if delay_s else {}
    truck_log(path, 2, 4, cause, nominal=True)
    whole = Fitter(PlantModel(load("nominal"), True), cut(path))
    zeros = np.zeros(len(whole.names))
    whole.noise = replace(whole.noise, weights=whole.at(None, zeros).linear.weights)
    late = judged(whole, only("valve_open_delay"), np.append(zeros, 2.0))
    stuck = replace(judged(whole, None, zeros), cost=1e6, chi2=1e3)
    monkeypatch.setattr("sil.shift_diagnosis.search.Judged.of", lambda _fit: stuck)
    found = weighed(healthy_again(whole, weighed([stuck, late], 1)), 1)
    healthy = next(item for item in found if item.fit.cause is None)
    assert healthy.cost < stuck.cost
    assert late.chi2 <= healthy.chi2 < stuck.chi2
    assert (healthy.probability < ALARM) == is_worth_it


def test_more_friction_of_the_linkage_in_one_direction_is_a_force(tmp_path: Path) -> None:
    """In a truck's log; the two cannot be distinguished. Sizes are physical ones."""
    path = tmp_path / "truck.log"
    truck_log(path, 2, 3, nominal=True)
    model = PlantModel(load("nominal"), True)
    force = only("external_force")
    skewed = next(cause for cause in catalogue() if cause.variant.fixed == {"linkage": 1.0})
    assert skewed.effect.id == "friction_asymmetry"
    linkage_n = load("nominal").value("truck.F_gearbox")
    force_n = -0.5 * linkage_n
    points = [
        Point({}, ((force, force_n / force.parameter.typical),)),
        Point({}, ((skewed, 0.5 / skewed.parameter.typical),)),
        Point(),
    ]
    x, _v, _done = model.predict(cut(path), points)
    assert np.nanmax(np.abs(x[:, 0] - x[:, 1])) < 1e-9
    assert np.nanmax(np.abs(x[:, 0] - x[:, 2])) > 1e-4
    assert skewed.effect.id not in {  # on a rig without a gearbox it is not offered
        item.effect.id for item in candidates(()) if item.fixed == {"linkage": 1.0}
    }


def test_of_the_leading_hypotheses_the_best_on_all_shifts_is_taken() -> None:
    costs = [5.0, 4.0, 3.0, 2.0, 1.0]
    fits = [SimpleNamespace(cause=k, point=k) for k in range(len(costs))]
    asked: list[int] = []

    def fit(cause: int, _point: int, rounds: int) -> SimpleNamespace:
        asked.append(cause)
        return SimpleNamespace(cause=cause, cost=costs[cause])

    finals = on_all(SimpleNamespace(fit=fit), fits, lambda work, items: [work(*i) for i in items])
    assert [final.cause for final in finals] == list(range(LEADING))[::-1]
    assert asked == list(range(LEADING))


@pytest.mark.parametrize(
    ("healthy", "best", "expected"), [(0.9, 0.05, True), (0.3, 0.3, False), (0.9, 0.6, False)]
)
def test_rivals_are_fitted_only_where_they_could_raise_an_alarm(
    healthy: float, best: float, expected: bool
) -> None:
    ids = 10
    found = [
        SimpleNamespace(probability=healthy, fit=SimpleNamespace(cause=None)),
        SimpleNamespace(probability=best, fit=SimpleNamespace(cause="other")),
    ]
    assert is_settled(found, ids) is expected
    # even if all causes turned out to be as probable as the best one
    assert (healthy / (healthy + ids * best) > DOUBTED) is expected


def test_only_hopeless_causes_are_not_fitted_to_all_shifts() -> None:
    costs = {"near": HOPELESS - 1.0, "best": 0.0, "hopeless": HOPELESS + 1.0, None: 1e3}
    fits = [SimpleNamespace(cause=cause, cost=cost) for cause, cost in costs.items()]
    assert [fit.cause for fit in close_ones(fits)] == ["best", "near", None]


def test_what_trucks_differ_in_hides_the_same_as_a_cause(tmp_path: Path) -> None:
    path, truck = tmp_path / "quiet.log", quiet_truck(phase_s=PHASE_S)
    write_log(path, truck, 8, np.random.default_rng(5))
    fitter = Fitter(PlantModel(load("nominal"), True), cut(path))
    healthy = fitter.at(None, np.zeros(len(fitter.names)))
    low = only("supply_low")
    information, _score = projected(
        linear_at(fitter, fitter.shifts, healthy, [low]).without_cliffs()
    )
    # a share of the supply, known within 3 %: no log can show more of it than this prior leaves
    most = (
        (low.parameter.typical / unit_priors(load("nominal"))["supply"]) ** 2 * (TAIL + 1.0) / TAIL
    )
    assert 0.0 < information[0, 0] < 1.1 * most
