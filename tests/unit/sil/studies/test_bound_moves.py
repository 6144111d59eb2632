"""Moves on whole policies: a known answer, what is followed, and what a late arrival costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sil.studies.bound_moves import LATE_M_S, PRICE_M_S_PER_S, MovingSearch, chosen
from sil.studies.minimax import merits
from sil.studies.segments import ABSENT, Member
from tests.unit.sil.studies.test_bound_search import LEAST_M_S, Bowls


def moving(seed: int = 1, branch: int = 1) -> MovingSearch:
    return MovingSearch(Bowls(), "N", 1, branch, seed, 0.5)


@pytest.mark.parametrize("seed", [1, 2])
def test_moves_find_the_lowest_point_of_a_known_function(seed: int) -> None:
    search = moving(seed)
    history = search.run(80_000, 2)
    assert 75_000 < search.model.runs < 90_000 and len(history) == 5
    assert history == sorted(history, reverse=True) and history[-1] == search.best.cost_m_s
    assert search.best.cost_m_s == pytest.approx(LEAST_M_S, abs=0.01)
    assert search.best.stem[0, 0] == pytest.approx(3.0, abs=0.1)


def test_the_smallest_budget_still_finds_a_policy() -> None:
    search = MovingSearch(Bowls(), "N", 1, 1, 3, 1.0)
    assert search.run(1, 2)[-1] == search.best.cost_m_s < 2.0


def test_a_late_arrival_costs_more_than_any_load_has() -> None:
    """The hardest load hides another that is late by a microsecond, but not in a strict search."""
    plain = Bowls().plain
    impacts = np.array([[[0.8, 0.5]]])
    late = replace(plain, late_s=np.array([[[-0.01, 1e-6]]]), parts_m_s=impacts[..., None])
    assert merits(late).max() == 0.8
    assert merits(late, PRICE_M_S_PER_S, LATE_M_S)[0, 0] == pytest.approx([0.8, 1.503])


def test_the_best_of_each_group_is_followed_unless_it_is_as_before() -> None:
    before = np.full((8, 3), 0.5)
    cost_m_s = np.repeat(before[:, None] + 0.2, 2, axis=1)
    cost_m_s[0], cost_m_s[2] = 0.5, 0.6  # as before; softer than the others of its group
    cost_m_s[5] = 0.4, 0.4, 1.0  # the hardest, and the softest by the mean
    assert list(chosen(cost_m_s, before)) == [2, 5]


def test_policies_that_are_about_as_hard_as_a_better_one_are_dropped() -> None:
    nothing = np.zeros(0)
    hardest = [0.5, 0.3, 0.301, 0.304, 0.306, 0.9]
    members = [Member(nothing, nothing, np.array([0.1, each])) for each in hardest]
    found = moving().distinct(members)
    assert [member.cost_m_s[1] for member in found] == [0.3, 0.304, 0.5, 0.9]


def test_a_move_changes_one_segment_or_the_rest_of_the_policy() -> None:
    search = moving(5)
    segments, branches = search.random_segments(2), search.random_branches(2, 3)
    elites = search.members(segments, branches)
    kinds = set()
    for _ in range(200):
        own, answers = segments[0].copy(), branches[0].copy()
        search.move(elites, 1, own, answers)
        moved = (own != segments[0]).any(axis=(1, 2))
        replied = (answers != branches[0]).any(axis=(1, 2))
        kinds.add((int(moved.sum()), int(replied.sum())))
        assert (own[..., 1::2] >= ABSENT).all() or moved.any()
    assert {(1, 0), (0, 1), (0, 0), (3, 3)} <= kinds
