"""Judgements: the plain push is the reference; quick strokes end as whole ones do."""

from __future__ import annotations

import numpy as np
import pytest

from plant.parameters import load
from sil.studies.bounds.judge import LATER_S, NOMINAL, PLAIN, Judge, drawn
from sil.studies.bounds.policy import NO_PULSE, STEM_SIZE, Timing

PARAMETERS = load("nominal")
PAUSE = np.full((1, STEM_SIZE), NO_PULSE)
PAUSE[0, [0, 3]] = 10.5, 0.5
"""B closes once for 18 ms, while the synchronizer holds."""


@pytest.fixture(scope="module")
def judge() -> Judge:
    impulses_n_s = np.linspace(18.0, 250.0, 30)
    return Judge(PARAMETERS, Timing(0.008, 0.035), impulses_n_s, (500.0, 1300.0), NOMINAL)


def test_the_plain_push_is_in_time_and_harder_under_less_mesh_force(judge: Judge) -> None:
    plain = judge.judge(PLAIN, (), 1.0)
    np.testing.assert_allclose(plain.late_s, 0.0, atol=1e-6)
    light, heavy = plain.impact_m_s[0, 0].max(axis=-1)
    assert light > heavy == pytest.approx(1.365, abs=1e-3)


def test_quick_strokes_end_as_whole_ones_do(judge: Judge) -> None:
    whole, quick = judge.judge(PAUSE, (), 0.02), judge.judge(PAUSE, (), 0.02, releases=60)
    assert np.isfinite(whole.impact_m_s).all() and np.isfinite(quick.impact_m_s).all()
    for one, other in zip(whole.impact_m_s[0, 0], quick.impact_m_s[0, 0], strict=True):
        assert other.max() == pytest.approx(one.max(), abs=0.01)
        assert other.min() == pytest.approx(one.min(), abs=0.02)


def test_a_policy_that_is_too_late_is_worth_nothing(judge: Judge) -> None:
    longer = PAUSE.copy()
    longer[0, 3] = 3.0
    judgement = judge.judge(longer, (), 0.02)
    assert judgement.late_s.max() > LATER_S
    assert judgement.worst_m_s == np.inf


def test_draws_are_fixed_and_within_the_supply_that_is_stated() -> None:
    draws = drawn(PARAMETERS)
    assert draws == drawn(PARAMETERS) and len(draws) == 32
    supply = np.exp([each.factors["supply"] for each in draws])
    assert 0.98 <= supply.min() < 0.985 and 1.015 < supply.max() <= 1.02
