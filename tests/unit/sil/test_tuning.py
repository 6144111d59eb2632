"""The tuning procedure: same budget for all, reproducible, its best no worse than the defaults."""

from __future__ import annotations

import math

import pytest

from controller import strategies
from sil.whatif import tuning
from sil.whatif.tuning import Case, Outcome

LAB = Case("lab")
QUICK = (
    "sensor.period_s=0.0025",
    "controller.period_s=0.0025",
    "controller.filter=false",
    "valve.D_fall=0.005",
)


def test_cost_is_the_impact_plus_the_time_lost_beyond_what_is_free() -> None:
    reference = Outcome(0.9, 0.05)
    assert tuning.cost_m_s(Outcome(0.3, 0.08), reference, 0.034, 10.0) == 0.3
    assert tuning.cost_m_s(Outcome(0.3, 0.104), reference, 0.034, 10.0) == pytest.approx(0.5)
    failed = Outcome(math.inf, math.inf)
    assert tuning.cost_m_s(failed, reference, 0.034, 10.0) == tuning.FAILED_M_S


@pytest.mark.parametrize("strategy", list(tuning.SPACES))
def test_every_candidate_is_a_setting_that_the_strategy_takes(strategy: str) -> None:
    found = tuning.candidates(strategy, 9, 3)
    assert len(found) == 9
    assert found[0] == {}
    assert found == tuning.candidates(strategy, 9, 3)
    assert found[1:] != tuning.candidates(strategy, 9, 4)[1:]
    for parameters in found:
        made = strategies.parameters(strategy, parameters)
        for name, value in parameters.items():
            low, high = tuning.SPACES[strategy][name]
            assert low <= value <= high
            assert getattr(made, name) == value


def test_the_best_is_no_worse_than_the_defaults_and_runs_again_the_same() -> None:
    found = tuning.tune("lab_n_b", "air_cushion", QUICK, [LAB], budget=5, seed=1)
    assert len(found) == 5
    assert [c.cost_m_s for c in found] == sorted(c.cost_m_s for c in found)
    defaults = next(c for c in found if not c.parameters)
    assert found[0].cost_m_s <= defaults.cost_m_s
    case = Case("lab", QUICK)
    again = tuning.run_case("lab_n_b", "air_cushion", found[0].parameters, case)
    assert again == found[0].outcomes[0]
