"""The search: which shifts it looks at first, what it tries, and what it finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from plant.parameters import load
from sil.inference.fit import no_progress
from sil.inference.truck.causes import catalogue
from sil.inference.truck.diagnosis import rest_noise_m
from sil.inference.truck.fit import MIDDLE_M, Fit
from sil.inference.truck.search import EFFORT, Search, _best_of, _capped, _unlike, spread
from sil.log_replay.recorded_shifts import RecordedShift
from tests.unit.sil.inference.truck.test_causes import only


def shift(start: str, end: str, failed: bool = False) -> SimpleNamespace:
    return SimpleNamespace(start=start, end=end, failed=failed)


def test_of_many_shifts_every_kind_has_its_share() -> None:
    every = [shift("N", "B"), shift("B", "N")] * 20 + [shift("N", "F", failed=True)] * 10
    few = spread(every, 10)
    assert len(few) == 10
    kinds = {(own.start, own.end, own.failed) for own in few}
    assert kinds == {("N", "B", False), ("B", "N", False), ("N", "F", True)}
    assert spread(few, 12) == few


def coarse(name: str, cost: float) -> Fit:
    return Fit(only(name), 1.0, np.zeros(1), np.zeros((1, 1)), np.ones(1), cost=cost)


def test_of_each_effect_the_best_goes_on_unless_it_is_hopeless() -> None:
    fits = [coarse("detent", 5.0), coarse("detent", 3.0), coarse("supply_low", 90.0)]
    fits += [coarse("piston_leak", 4.0)]
    assert [fit.cost for fit in _best_of(fits, 5)] == [3.0, 4.0]
    assert [fit.cost for fit in _best_of(fits, 1)] == [3.0]


def test_a_shift_that_is_stuck_does_not_make_a_coarse_fit_hopeless(usual: Fit) -> None:
    stuck = replace(usual, cost=300.0, per_shift=np.array([5.0, 3.0, 270.0]))
    poor = replace(usual, cost=70.0, per_shift=np.array([19.0, 20.0, 19.0]))
    assert _capped(stuck) == 50.0 and _capped(poor) == 70.0


def test_of_a_cause_at_nearly_one_size_the_best_fit_is_kept() -> None:
    fits = [
        replace(coarse("detent", cost), size=size) for cost, size in ((1, 1.0), (2, 1.1), (3, 2))
    ]
    assert [fit.cost for fit in _unlike(fits)] == [1, 3]
    assert len(_unlike([fits[0], replace(fits[1], mounted=False)])) == 2


JUDGE: Any = SimpleNamespace(
    whole_cost=lambda fit: fit.cost,
    chi2=lambda fit: fit.noise_factor - 1.0,
    misfit_cost=lambda _fit: 50.0,
)


def test_others_may_gain_what_the_best_leaves() -> None:
    search = Search({True: JUDGE}, {}, [], [])
    fits = [coarse("detent", cost) for cost in (5.0, 40.0, 56.0)]
    assert search._catching_up(fits, 10.0) == fits[:1]
    fits[0] = replace(fits[0], noise_factor=1.5)
    assert search._catching_up(fits, 10.0) == fits


def test_the_last_stage_is_for_those_that_can_catch_up(monkeypatch: pytest.MonkeyPatch) -> None:
    search = Search({True: JUDGE}, {}, [], [])
    monkeypatch.setattr(search, "_ended", lambda fit: fit)
    fits = [coarse("detent", cost) for cost in (5.0, 8.0, 6.0 + EFFORT.behind)]
    fits.append(replace(fits[0], cause=None, cost=90.0))
    assert {fit.cost for fit in search._completed(fits, no_progress)} == {5.0, 8.0, 90.0}
    assert search._completed([], no_progress) == []
    most = EFFORT.completed
    many = [coarse("detent", 0.1 * k) for k in range(most + 5)]
    assert len(search._completed(many, no_progress)) == most


def test_the_very_last_stage_is_for_the_nearest_and_the_best_of_a_cause_slide(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    search = Search({True: JUDGE}, {}, [], [])
    slid: list[float] = []

    def again(job: tuple[Fit, bool]) -> Fit:
        fit, slides = job
        slid.extend([fit.cost] * slides)
        return replace(fit, cost=fit.cost - 0.5)

    monkeypatch.setattr(search, "_ended", lambda fit: replace(fit, cost=fit.cost - 0.5))
    monkeypatch.setattr(search, "_ended_again", again)
    costs = (5.0, 4.0 + EFFORT.sliding, 6.0 + EFFORT.sliding, 6.0 + EFFORT.far_behind)
    fits = [coarse("detent", cost) for cost in costs] + [coarse("supply_low", costs[2])]
    fits = [replace(fit, evidence=-fit.cost) for fit in fits]
    ended = search._completed(fits, no_progress)
    assert [fit.cost for fit in ended] == [
        4.0,
        *(c - 1.0 for c in costs[1:3]),
        costs[2] - 1.0,
        costs[3] - 0.5,
    ]
    assert sorted(slid) == [cost - 0.5 for cost in costs[:3]]
    assert sorted(fit.id for fit in ended if fit.cost == costs[2] - 1.0) == ["detent", "supply_low"]


def searched(
    monkeypatch: pytest.MonkeyPatch, explained: bool, wide: list[Fit], contest: list[list[Fit]]
) -> tuple[list[str], list[Fit]]:
    """Return the stages of a search whose fits are given, and what it returns."""
    search, stages = Search({True: JUDGE}, {}, [], []), list[str]()
    healthy = replace(coarse("detent", 50.0), cause=None, evidence=-50.0)
    near = replace(coarse("free_play", 40.0), evidence=-45.0, noise_factor=1.5)

    def stage(name: str, answer: Callable[[], Any]) -> Callable[..., Any]:
        return lambda *_arguments: (stages.append(name), answer())[1]

    monkeypatch.setattr("sil.inference.truck.search.gains_of", lambda *_: [])
    monkeypatch.setattr(search, "healthy_fits", lambda _stages: [healthy])
    monkeypatch.setattr(search, "is_explained", lambda _fit: explained)
    monkeypatch.setattr(search, "_near", lambda *_: [near])
    monkeypatch.setattr(search, "_wide", stage("wide", lambda: [wide.pop(0)]))
    monkeypatch.setattr(
        search, "_challengers", stage("contest", lambda: [(fit, 8) for fit in contest.pop(0)])
    )
    monkeypatch.setattr(search, "_in_full", lambda jobs, *_: [fit for fit, _seed in jobs])
    monkeypatch.setattr(search, "_at_size", lambda job: job[0])
    monkeypatch.setattr(search, "_completed", lambda *_: [])
    monkeypatch.setattr(search, "_without", lambda fit: healthy)
    return stages, search.run()


def better(name: str, evidence: float, noise_factor: float = 1.0) -> Fit:
    return replace(coarse(name, -evidence), evidence=evidence, noise_factor=noise_factor)


def test_first_looks_go_on_while_the_best_leaves_more_than_noise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wide = [better("supply_low", -30.0, 1.5), better("piston_leak", -10.0), better("detent", 0.0)]
    stages, fits = searched(monkeypatch, False, wide, [[]])
    assert stages == ["wide", "wide", "contest"]
    assert max(fits, key=lambda fit: fit.evidence).id == "piston_leak"
    left = [better("supply_low", -30.0, 1.5) for _ in range(EFFORT.turns)]
    assert searched(monkeypatch, False, left, [[]])[0] == ["wide"] * EFFORT.turns + ["contest"]


def test_a_leader_that_lost_is_contested_again(monkeypatch: pytest.MonkeyPatch) -> None:
    contest = [[better("end_cushion", -5.0)], [better("detent", -3.0)], []]
    stages, fits = searched(monkeypatch, False, [better("piston_leak", -10.0)], contest)
    assert stages == ["wide", *["contest"] * EFFORT.contests]
    assert {"end_cushion", "detent"} < {fit.id for fit in fits}


def test_all_get_a_first_look_before_one_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    stages, fits = searched(monkeypatch, True, [better("piston_leak", -10.0)], [[], []])
    assert stages == ["contest", "wide", "contest"]
    assert "piston_leak" in {fit.id for fit in fits}
    healthy = [replace(better("detent", -44.0), cause=None)]
    assert searched(monkeypatch, True, [], [healthy])[0] == ["contest"]


@pytest.fixture(scope="module")
def search(shifts: list[RecordedShift]) -> Search:
    return Search.of(shifts, load("nominal"), rest_noise_m(shifts), catalogue())


def test_a_first_look_has_a_bump_in_every_place_and_few_variants(search: Search) -> None:
    names = [cause.id for cause in search._first_look()]
    bumps = [cause for cause in search.causes if cause.id == "friction_bump"]
    assert names.count("friction_bump") == len(bumps) > 2
    assert names.count("alpha_speed") == 3
    assert set(names) == {cause.id for cause in search.causes}


def test_a_first_look_leaves_out_what_moves_nothing_and_what_moves_alike(search: Search) -> None:
    usual = search.fitters[True].start()
    leaks = [cause for cause in search.causes if cause.id == "leak_to_atmosphere"]
    bump = next(c for c in search.causes if c.name == "friction_bump:0.0065, 0.0012")
    gain = only("sensor_gain")
    jobs = [(usual, cause, size, 0) for size in (3.0, 0.0) for cause in (*leaks, bump, gain)]
    kept = [(cause.name, size) for _truck, cause, size, _seed in search._telling(jobs)]
    assert kept == [(cause.name, 3.0) for cause in (leaks[0], leaks[2], bump, gain)]


def test_the_best_first_looks_at_an_effect_go_on(search: Search) -> None:
    usual = search.fitters[True].start(only("piston_leak"))
    sized = [search._of_first(replace(usual, size=size)) for size in (9.0, 1.5, 3.0, 6.0)]
    begun = [search._of_all(search.coarse[True].evaluated(fit, MIDDLE_M), usual) for fit in sized]
    after = search._gone_on(begun, no_progress)
    best_first = sorted(zip(begun, after, strict=True), key=lambda pair: _capped(pair[0]))
    assert all(fit.cost < was.cost for was, fit in best_first[: EFFORT.going_on])
    assert all(fit is was for was, fit in best_first[EFFORT.going_on :])


def test_a_healthy_truck_is_explained(search: Search) -> None:
    fit = search._healthy((True, 0.0))
    assert search.is_explained(fit)
    # one that is off by 1 mm in one shift is not
    far = fit.position_m.copy()
    far[0, 5] += 1e-3
    assert not search.is_explained(replace(fit, position_m=far))
    assert not search.is_explained(replace(fit, unit=fit.unit + 5.0))
    # what no position by itself shows, all of them do
    off = replace(fit, position_m=fit.position_m + 2e-5)
    assert not search.fitters[True].deviating(off) and not search.is_explained(off)


def test_a_fit_slides_to_the_supply_that_explains_more(search: Search) -> None:
    fit = search._healthy((True, 0.0))
    fitter = search.fitters[True]
    far = replace(fit, unit=fitter.layout.in_proportion(fit.unit, 0.75))
    far = fitter.improved(fitter.rescanned(far, MIDDLE_M, np.random.default_rng(1)), MIDDLE_M, 10)
    stuck = search._ended(far)
    assert stuck.evidence < fit.evidence - 3.0
    slid = search._ended_again((far, True))
    assert slid.evidence > stuck.evidence + 2.0
    supply = fitter.layout.at["supply"]
    assert slid.unit[supply] > stuck.unit[supply] + 0.5


def test_a_healthy_truck_is_found_from_where_a_cause_ended(search: Search) -> None:
    fit = search._healthy((True, 0.0))
    ended = replace(fit, cause=only("supply_low"), size=0.02, evidence=fit.evidence + 50.0)
    without = search._without(ended)
    assert without.cause is None and without.size == 0.0
    fitter = search.fitters[True]
    assert fitter.whole_cost(without) < fitter.whole_cost(fit) + 1.0
