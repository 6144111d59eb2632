"""Each kind of expectation, met and not met."""

from __future__ import annotations

from typing import Any

import pytest

from can_dbc.messages import Gear
from controller.settings import ControlConfig
from sil.rules import Circumstances
from sil.simulation import metrics
from sil.simulation.expectations import Expectations, Limits, Timing
from sil.simulation.judgement import Observed, evaluate
from tests.support import made_run

GIVEN = Circumstances(ControlConfig(), driver_timeout_s=9.0, disturbed=True)


def judged(last_request: Any = None, **wanted: Any) -> dict[str, bool]:
    record = made_run.made()
    found = metrics.shifts(record, Gear.NEUTRAL)
    figures = metrics.summary(found, 0.0, 2, 200)
    checks = evaluate(Expectations(**wanted), Observed(GIVEN, record), found, figures, last_request)
    return {c.name: c.passed for c in checks}


def test_an_empty_table_still_refuses_an_empty_success() -> None:
    assert judged() == {
        "ShiftRequest frames on the bus": True,
        "ValveCommand frames on the bus": True,
        "ControllerStatus frames on the bus": True,
        "PlantMotion frames on the bus": True,
        "rules broken": True,
    }
    finished = judged("backward")
    assert finished["a valve opened"] and finished["request for backward"]
    assert not judged("forward")["request for forward"]
    assert "request for forward" not in judged("forward", unfinished=True)
    assert "request for forward" not in judged("forward", confirmed_gear="backward")
    assert not judged(min_frames=41)["ValveCommand frames on the bus"]


@pytest.mark.parametrize(
    ("wanted", "name", "met"),
    [
        ({"final_gear": "backward"}, "final gear", True),
        ({"final_gear": "neutral"}, "final gear", False),
        ({"confirmed_gear": "backward"}, "confirmed gear", True),
        ({"confirmed_gear": "forward"}, "confirmed gear", False),
        ({"states": ["PUSH", "BLOW"]}, "states visited", True),
        ({"states": ["PUSH", "VENT"]}, "states visited", False),
        ({"never_states": ["FAULT"]}, "states never entered", True),
        ({"never_states": ["BLOW"]}, "states never entered", False),
        ({"valves_opened": ["B"]}, "valves opened", True),
        ({"valves_opened": []}, "valves opened", False),
        ({"valves_opened": ["B", "N"]}, "valves opened", False),
        ({"faults": []}, "faults reported", True),
        ({"faults": ["REQUEST_LOST"]}, "faults reported", False),
        ({"valves_off_at_end": True}, "valves off at the end", True),
        ({"valves_off_at_end": False}, "valves off at the end", False),
        ({"metrics": {"shift_time_s": Limits(0.049, 0.051)}}, "shift_time_s", True),
        ({"metrics": {"shift_time_s": Limits(max=0.049)}}, "shift_time_s", False),
        ({"metrics": {"shift_time_s": Limits(min=0.051)}}, "shift_time_s", False),
        ({"timing": [Timing(to="arrived", max_s=0.051)]}, "shift 1: requested to arrived", True),
        ({"timing": [Timing(to="arrived", max_s=0.049)]}, "shift 1: requested to arrived", False),
        (
            {"timing": [Timing(to="valve_open", start="commanded", min_s=0.007)]},
            "shift 1: commanded to valve_open",
            True,
        ),
        ({"timing": [Timing(to="arrived", shift=2)]}, "shift 2: requested to arrived", False),
    ],
)
def test_expectation(wanted: dict[str, Any], name: str, met: bool) -> None:
    assert judged(**wanted)[name] is met


def test_a_metric_that_does_not_exist_is_not_within_limits() -> None:
    assert not Limits(min=0.0).holds(None)
    assert Limits().holds(0.0)
