"""Judgements: the plain push is the reference; the damper is softer; late is worth nothing."""

from __future__ import annotations

import numpy as np
import pytest

from plant.parameters import load
from sil.studies.bounds.judge import LATER_S, NOMINAL, PLAIN, Judge, drawn
from sil.studies.bounds.policy import NO_PULSE, STEM_SIZE, SwitchingDelays

PARAMETERS = load("nominal")
PAUSE = np.full((1, STEM_SIZE), NO_PULSE)
PAUSE[0, [0, 3]] = 10.5, 0.5
"""B closes once for 18 ms, while the synchronizer holds."""


@pytest.fixture(scope="module")
def judge() -> Judge:
    impulses_n_s = np.linspace(18.0, 250.0, 30)
    return Judge(PARAMETERS, SwitchingDelays(0.008, 0.035), impulses_n_s, (500.0, 1300.0), NOMINAL)


def test_the_plain_push_is_in_time_and_harder_under_less_mesh_force(judge: Judge) -> None:
    plain = judge.judge(PLAIN, (), 1.0)
    np.testing.assert_allclose(plain.late_s, 0.0, atol=1e-6)
    light, heavy = plain.impact_m_s[0, 0].max(axis=-1)
    assert light > heavy == pytest.approx(1.365, abs=1e-3)


def test_some_loads_are_judged_as_among_all(judge: Judge) -> None:
    judgement = judge.judge(PAUSE, (), 0.02)
    some = judge.judge(PAUSE, (), 0.02, slice(1, None, 4))
    np.testing.assert_array_equal(some.impact_m_s, judgement.impact_m_s[..., 1::4])


def test_the_damper_is_softer_than_the_plain_push() -> None:
    judge = Judge(
        PARAMETERS, SwitchingDelays(0.002, 0.002), np.array([250.0]), (1300.0,), NOMINAL, "damper"
    )
    assert judge.plain.impact_m_s.max() == pytest.approx(0.602, abs=1e-3)


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
