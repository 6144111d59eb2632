"""The bounds: their search on known answers, and no random policy below those that are shipped."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from plant.parameters import load as load_parameters
from sil.studies.bound_search import Policy, Search, arrivals_of, softest, stem_switches
from sil.studies.kinds.bounds import SHIPPED, envelope
from sil.studies.policies import FAMILIES, GEARBOX, Arrivals, FamilyModel, Floats, Layout

PARAMETERS = load_parameters("nominal")
LEAST_M_S = 0.3


class Bowls(FamilyModel):
    """A model whose best policy is known: a stem at 120 ms, and a branch of its own for each load."""

    def __init__(self) -> None:
        self.loads, self.delay_s, self.runs = 3, 0.0, 0
        self.valve_s = 0.008, 0.035
        self.limit_s = np.full(3, 0.2)

    def fly(self, stems: Floats, branches: Floats | None, layout: Layout) -> Arrivals:
        assert branches is not None
        tries, loads = branches.shape[1:3]
        stem = np.abs(stems[:, 0, 0] - 12.0)[:, None, None]
        own = np.abs(branches[..., 0, 1] - 0.5 * np.arange(loads))
        cost = LEAST_M_S + 0.1 * (stem + own)
        return Arrivals(*[np.broadcast_to(cost, (len(stems), tries, loads))] * 5)


def test_the_search_finds_the_lowest_point_of_a_known_function() -> None:
    for seed in (1, 2):
        best = softest(Bowls(), Layout("N", 1, 1), 60, seed)
        assert best.cost_m_s == pytest.approx(LEAST_M_S, abs=0.01)
        assert best.stem[0, 0] == pytest.approx(12.0, abs=0.1)
        assert best.branches[:, 0, 1] == pytest.approx([0.0, 0.5, 1.0], abs=0.1)


def test_searches_by_other_seeds_find_the_same() -> None:
    """At 48 ms nothing is known in time: the policy of three switches, found again and again."""
    model = FamilyModel(PARAMETERS, GEARBOX, 0.048, 0.03)
    found = [softest(model, Layout("BNF", 2, 0), 25, seed).cost_m_s for seed in (1, 2)]
    assert found == pytest.approx([0.926, 0.926], abs=0.02)


def test_a_policy_comes_out_again_as_it_was_found() -> None:
    model = FamilyModel(PARAMETERS, GEARBOX, 0.005, 0.03)
    best = softest(model, Layout("BN", 1, 1), 3, 5)
    again = arrivals_of(model, best)
    assert again.cost_m_s.max() == best.cost_m_s
    assert (again.arrival_s <= model.limit_s).all() or best.cost_m_s > 2.0


def test_switches_of_a_stem_are_counted_once() -> None:
    stem = np.array([[1.0, 1.0, 1.5, 1.0], [3.0, -1.0, 4.0, 0.5]])
    assert stem_switches(Policy(0.0, stem, np.zeros(0), Layout("BN", 2, 0))) == 4


def test_late_information_holds_for_earlier_information() -> None:
    delay_s = np.array([0.01, -0.01, 0.0, 0.02])
    assert list(envelope(delay_s, np.array([0.5, 0.3, 0.9, 0.7]))) == [0.5, 0.3, 0.5, 0.7]


with open(SHIPPED, encoding="utf-8", newline="") as file:
    POINTS = list(csv.DictReader(file))


@pytest.mark.parametrize("point", POINTS, ids=[f"row {point['row']}" for point in POINTS])
def test_no_random_policy_is_below_the_bound(point: dict[str, str]) -> None:
    valves = ("valve.D_rise", "valve.D_fall")
    parameters = PARAMETERS.override({path: float(point[path]) for path in valves})
    model = FamilyModel(parameters, FAMILIES[point["load"]], float(point["bound.delay_s"]), 0.03)
    search = Search(model, Layout("BNF", 2, 1), 11)
    stems = search.drawn(40)
    cost_m_s = model.fly(stems, search.branches(40), search.layout).cost_m_s.max(axis=2)
    assert np.isfinite(cost_m_s).all() and (cost_m_s < 2.0).sum() >= 1
    assert float(point["bound_m_s"]) <= cost_m_s.min() + 1e-6
