"""The bounds: their search on known answers, and no random policy below those that are shipped."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from plant.parameters import load as load_parameters
from sil.studies.bound_figures import SHIPPED, envelope
from sil.studies.bound_search import Partial, Policy, Search, arrivals_of, stem_switches
from sil.studies.policies import (
    FAMILIES,
    GEARBOX,
    NOT_ARRIVED,
    Arrivals,
    Bools,
    FamilyModel,
    Floats,
    Layout,
)
from sil.studies.segments import Member

PARAMETERS = load_parameters("nominal")
LEAST_M_S = 0.3


class Bowls(FamilyModel):
    """A model whose best policy is known: a stem at 30 ms, and a branch of its own for each load."""

    def __init__(self) -> None:
        self.loads, self.delay_s, self.runs = 3, 0.0, 0
        self.valve_s = 0.008, 0.035
        self.limit_s, self.order = np.full(3, 0.2), np.arange(3)
        self.plain = Arrivals(*[np.array([[[0.05, 0.1, 0.15]]])] * 7)

    def reveals_s(self, stems: Floats, layout: Layout, load: int) -> Floats:
        return np.full(len(stems), 0.05 * (load + 1))

    def branched(
        self,
        stems: Floats,
        branches: Floats,
        layout: Layout,
        revealed_s: Floats,
        which: Bools | None = None,
    ) -> Arrivals:
        self.runs += branches[..., 0, 0].size
        stem = np.abs(stems[:, 0, 0] - 3.0)[:, None, None]
        own = np.abs(branches[..., 0, 1] - 0.5 * np.arange(self.loads))
        cost = LEAST_M_S + 0.1 * (stem + own)
        return Arrivals(*[cost] * 5, -0.01 * np.ones_like(cost), cost[..., None])

    def fly(self, stems: Floats, branches: Floats | None, layout: Layout) -> Arrivals:
        assert branches is not None
        return self.branched(stems, branches, layout, np.zeros(0))


def random_policies(search: Search, n: int) -> list[Member]:
    """Return random policies of a search, with a random branch for each load."""
    branches = np.stack([search.random_branches(n, 1)[:, 0] for _ in search.order], axis=1)
    return search.members(search.random_segments(n), branches)


@pytest.mark.parametrize("hunts", [2, 7])
def test_the_search_finds_the_lowest_point_of_a_known_function(hunts: int) -> None:
    for seed in (1, 2):
        search = Search(Bowls(), "N", 1, 1, seed)
        history = search.run(30_000, hunts)
        best = search.best
        assert 25_000 < search.model.runs < 32_000 and len(history) == 5
        assert history == sorted(history, reverse=True) and history[-1] == best.cost_m_s
        assert best.cost_m_s == pytest.approx(LEAST_M_S, abs=0.01)
        assert best.stem[0, 0] == pytest.approx(3.0, abs=0.1)
        assert best.branches[:, 0, 1] == pytest.approx([0.0, 0.5, 1.0], abs=0.1)


@pytest.mark.slow
def test_searches_by_other_seeds_find_the_same() -> None:
    """At 48 ms nothing is known in time: the policy of three switches, found again and again."""
    found = []
    for seed in (1, 2):
        search = Search(FamilyModel(PARAMETERS, GEARBOX, 0.048, 0.03), "BNF", 4, 0, seed)
        search.run(30_000)
        found.append(search.best.cost_m_s)
    assert found == pytest.approx([0.926, 0.926], abs=0.02)


def test_a_level_judges_a_load_as_the_whole_policy_does() -> None:
    """Later segments and branches change neither the release of a load nor its impact."""
    search = Search(FamilyModel(PARAMETERS, GEARBOX, 0.005, 0.03), "BNF", 1, 1, 5)
    pool = search.levels([], 100)
    arrived = np.flatnonzero(pool.cost_m_s < NOT_ARRIVED)
    assert arrived.size > 2
    whole = search.members(pool.segments[arrived], pool.branches[arrived])
    found = [member.cost_m_s.max() for member in whole]
    assert found == pytest.approx(pool.cost_m_s[arrived], abs=1e-6)
    assert (search.stems(pool.segments)[1] == pool.revealed_s).all()


def test_a_level_retains_the_earliest_below_each_limit_and_few_of_a_topology() -> None:
    search = Search(Bowls(), "N", 1, 1, 1)
    n = 40
    segments = np.full((n, 3, 1, 2), -0.2)
    segments[30:, 0, 0, 1] = 2.0  # another topology
    cost_m_s, last_s = np.linspace(0.1, 0.9, n), np.linspace(0.25, 0.2, n)
    zero = np.zeros((n, 3, 1, 3))
    pool = Partial(segments, zero, zero[..., 0, 0], cost_m_s, last_s, np.arange(n))
    assert list(search.retained(pool, np.array([0.5])).parent) == [19, 20, 21, 30, 31, 32]


@pytest.mark.parametrize(("delay_s", "last"), [(-0.03, 4.5), (0.0, 1.5), (0.01, 1.5)])
def test_branches_that_begin_ahead_of_the_release_reach_beyond_it(
    delay_s: float, last: float
) -> None:
    model = Bowls()
    model.delay_s = delay_s
    search = Search(model, "BN", 1, 1, 7)
    leaves = search.random_branches(500, 4)[..., 0] + search.lead  # in 10 ms
    assert leaves.min() == 0.0 and 0.95 * last < leaves.max() < last


def test_a_refined_policy_is_softer_and_in_time() -> None:
    search = Search(FamilyModel(PARAMETERS, GEARBOX, 0.048, 0.03), "BNF", 4, 0, 3)
    before = min(random_policies(search, 32), key=lambda member: member.merit_m_s)
    after = search.refine(before, 3)
    assert after.merit_m_s < before.merit_m_s - 0.01
    search.note(after)
    again = arrivals_of(search.model, search.best)
    assert again.cost_m_s.max() == search.best.cost_m_s
    assert again.cost_m_s[0, 0] == pytest.approx(after.cost_m_s)
    assert (again.arrival_s <= search.model.limit_s).all() or search.best.cost_m_s > 2.0


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
    random = random_policies(Search(model, "BNF", 1, 1, 11), 384)
    random += random_policies(Search(model, "BNF", 4, 0, 11), 32)  # allowed at any delay
    least_m_s = min(member.cost_m_s.max() for member in random)
    assert float(point["bound_m_s"]) <= least_m_s < 2.0
