"""The safety figures against runs whose outcome is known."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from can_dbc.codec import can_id_of
from can_dbc.messages import Fault, Gear, ValveCommand
from sil.simulation import safety
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import from_table
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
    fooled = dataclasses.replace(record, truth=moved)
    assert safety.false_gear_s(record, loaded.scenario) == 0.0
    assert safety.false_gear_s(fooled, loaded.scenario) > 0.3


def test_a_coil_on_while_no_command_arrives_is_an_orphan() -> None:
    loaded = from_table(base("N-B"), "test")
    record = run_in_memory(loaded).record
    assert safety.orphan_energised_s(record, loaded.scenario) == 0.0
    commands = can_id_of(ValveCommand)
    unheard = [f for f in record.frames if f.frame.can_id != commands or f.arrival_ns < 130_000_000]
    silent = dataclasses.replace(record, frames=unheard)
    on = (np.stack([record.truth[f"cmd_{c}"] for c in "BNF"]) > 0.5).any(axis=0)
    late = record.truth["time_s"] > 0.1307 + loaded.scenario.valve_driver.timeout_s + 0.001
    expected_s = 0.001 * np.count_nonzero(on & late)
    assert expected_s > 0.1
    assert safety.orphan_energised_s(silent, loaded.scenario) == pytest.approx(expected_s, abs=0.02)


def test_what_a_receiver_may_not_believe_is_no_report() -> None:
    replayed = {"kind": "replayed", "message": "ControllerStatus", "delay_s": 0.1}
    assert math.isnan(figures(fault=[replayed])["reported_gear"])
    dead = {"kind": "dead", "node": "controller", "start_s": 0.13}
    assert math.isnan(figures(fault=[dead])["reported_gear"])


def test_a_loaded_bus_and_a_drifting_clock_are_there_from_the_start() -> None:
    for fault in (
        {"clock": {"driver_ppm": 50.0}},
        {"clock": {"controller_ppm": -50.0}},
        {"bus": {"extra_load": 0.1}},
    ):
        assert safety.fault_start_s(from_table(base("N-B") | fault, "test").scenario) == 0.0
    assert safety.fault_start_s(from_table(base("N-B"), "test").scenario) == math.inf
