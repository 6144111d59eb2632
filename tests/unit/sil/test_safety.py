"""The safety figures against runs whose outcome is known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from can_dbc.messages import Fault, Gear
from sil import safety
from sil.memory import run_in_memory
from sil.scenario import from_table
from tests.faults.drawn import base


def figures(shift: str = "N-B", **faults: Any) -> dict[str, float]:
    loaded = from_table(base(shift) | faults, "test")
    return safety.figures(run_in_memory(loaded).record, loaded.scenario)


def test_a_healthy_run_has_nothing_to_tell() -> None:
    found = figures()
    assert math.isnan(found["detected_after_s"]) and found["fault_bits"] == 0
    assert (found["end_gear"], found["reported_gear"]) == (Gear.BACKWARD, Gear.BACKWARD)
    assert found["orphan_energised_s"] == found["false_gear_s"] == found["both_filled_s"] == 0.0


def test_a_lost_sensor_is_reported_after_its_timeout() -> None:
    found = figures(sensor_fault=[{"kind": "off", "start_s": 0.13}])
    assert Fault(int(found["fault_bits"])) & Fault.POSITION_LOST
    assert 0.03 < found["detected_after_s"] < 0.07
    assert found["reported_gear"] == Gear.UNKNOWN


def test_a_valve_on_by_itself_fills_both_chambers() -> None:
    found = figures(valve_fault=[{"valve": "F", "kind": "wrong", "start_s": 0.13}])
    assert found["both_filled_s"] > 0.1


def test_corrupted_reports_are_not_believed() -> None:
    corrupt = {"kind": "corruption", "message": "ControllerStatus", "bits": 5}
    assert figures(fault=[corrupt])["false_gear_s"] <= 0.036


def test_an_orphan_is_found_where_the_driver_never_gives_up() -> None:
    dead = {"kind": "dead", "node": "controller", "start_s": 0.13}
    assert figures(fault=[dead])["orphan_energised_s"] == 0.0
    # the figure itself is not blind: count from an earlier end of patience than the driver's own
    loaded = from_table(base("N-B") | {"fault": [dead]}, "test")
    record = run_in_memory(loaded).record
    strict = from_table(base("N-B") | {"fault": [dead], "valve_driver": {"timeout_s": 0.02}}, "t")
    assert safety.orphan_energised_s(record, strict.scenario) == pytest.approx(0.029, abs=0.002)


def test_a_report_of_a_gear_the_stay_is_not_in_is_found() -> None:
    loaded = from_table(base("N-B"), "test")
    record = run_in_memory(loaded).record
    moved = dict(record.truth) | {"position_m": np.zeros_like(record.truth["position_m"])}
    fooled = type(record)(
        moved, record.events, record.frames, record.stroke_m, record.free_travel_m,
        record.supply_pressure_pa,
    )  # fmt: skip
    assert safety.false_gear_s(record, loaded.scenario) == 0.0
    assert safety.false_gear_s(fooled, loaded.scenario) > 0.3


def test_longest_run() -> None:
    assert safety.longest_run(np.array([False, True, True, False, True])) == 2
    assert safety.longest_run(np.array([True, True, True])) == 3
    assert safety.longest_run(np.zeros(4, dtype=bool)) == 0
