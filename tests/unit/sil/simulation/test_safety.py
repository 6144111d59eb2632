"""The safety figures against runs whose outcome is known."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from can_dbc.codec import can_id_of
from can_dbc.messages import ControllerStatus, Fault, Gear, ShiftState, ValveCommand
from sil.recording.run_record import RunRecord
from sil.rules import Circumstances, violations
from sil.rules.reports import sent
from sil.rules.shipped import RULES
from sil.simulation import safety
from sil.simulation.circumstances import circumstances
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import from_table
from sil.simulation.scenario import Scenario
from tests.faults.drawn import base


def ran(table: dict[str, Any]) -> tuple[RunRecord, Scenario]:
    loaded = from_table(table, "test")
    return run_in_memory(loaded).record, loaded.scenario


def figures(**faults: Any) -> dict[str, float]:
    return safety.figures(*ran(base("N-B") | faults))


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
    record, _ = ran(base("N-B") | {"fault": [dead]})
    strict = from_table(base("N-B") | {"fault": [dead], "valve_driver": {"timeout_s": 0.02}}, "t")
    assert safety.figures(record, strict.scenario)["orphan_energised_s"] == pytest.approx(
        0.029, abs=0.002
    )


def test_a_report_of_a_gear_the_stay_is_not_in_is_found() -> None:
    record, scenario = ran(base("N-B"))
    moved = dict(record.truth) | {"position_m": np.zeros_like(record.truth["position_m"])}
    fooled = dataclasses.replace(record, truth=moved)
    assert safety.figures(record, scenario)["false_gear_s"] == 0.0
    assert safety.figures(fooled, scenario)["false_gear_s"] > 0.3


def test_a_coil_on_while_no_command_arrives_is_an_orphan() -> None:
    record, scenario = ran(base("N-B"))
    assert safety.figures(record, scenario)["orphan_energised_s"] == 0.0
    commands = can_id_of(ValveCommand)
    unheard = [f for f in record.frames if f.frame.can_id != commands or f.arrival_ns < 130_000_000]
    silent = dataclasses.replace(record, frames=unheard)
    on = (np.stack([record.truth[f"cmd_{c}"] for c in "BNF"]) > 0.5).any(axis=0)
    late = record.truth["time_s"] > 0.1307 + scenario.valve_driver.timeout_s + 0.001
    expected_s = 0.001 * np.count_nonzero(on & late)
    assert expected_s > 0.1
    assert safety.figures(silent, scenario)["orphan_energised_s"] == pytest.approx(
        expected_s, abs=0.02
    )


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


def test_what_the_rules_may_know_of_faults() -> None:
    def given(**tables: Any) -> Circumstances:
        return circumstances(from_table(base("N-B") | tables, "test").scenario)

    plain = given()
    assert not plain.forced and plain.deaf_s == plain.down_s == () and plain.sight_s < 0.1
    assert given(valve_fault=[{"valve": "F", "kind": "wrong", "start_s": 0.13}]).forced
    rate = {"kind": "bit_rate", "start_s": 0.02, "end_s": 0.1}
    assert given(fault=[rate | {"node": "controller"}]).deaf_s == ((0.02, 0.1),)
    assert given(fault=[rate | {"node": "controller"}]).down_s == ((0.02, 0.1),)
    assert given(fault=[rate | {"node": "driver"}]).deaf_s == ()
    loaded = {"extra_load": 0.9, "extra_priority": 3, "send_buffer": 32}
    assert math.isinf(given(bus=loaded).sight_s)


def test_what_a_controller_on_another_bit_rate_missed_is_not_counted() -> None:
    faults = [
        {"kind": "bit_rate", "end_s": 0.1, "node": "controller"},
        {"kind": "bus_off", "start_s": 0.03, "end_s": 0.3, "node": "driver"},
    ]
    table = {"name": "late", "duration_s": 0.4, "initial_gear": "neutral", "fault": faults}
    record, scenario = ran(table | {"request": [{"at_s": 0.0, "gear": "forward"}]})
    pushes = [m.state for _, m in record.of(ControllerStatus) if m.state is ShiftState.PUSH]
    assert pushes  # it was heard after both faults
    given = circumstances(scenario)
    assert violations(record, given, RULES) == []
    as_if_heard = violations(record, dataclasses.replace(given, deaf_s=()), RULES)
    assert [broken.rule for broken in as_if_heard] == ["unrequested_push", "missed_loss"]


def test_an_estimate_whose_past_a_forger_hides_is_judged_by_all_its_past() -> None:
    table = {
        "name": "forged",
        "duration_s": 0.5,
        "initial_gear": "neutral",
        "request": [{"at_s": 0.12, "gear": "forward"}, {"at_s": 0.204, "gear": "neutral"}],
        "plant": {"pull_force_n": 688.0},
        "fault": [
            {
                "kind": "spoofed",
                "message": "ControllerStatus",
                "start_s": 0.0,
                "end_s": 0.38,
                "period_s": 0.001,
            }
        ],
    }
    record, scenario = ran(table)
    overshoots_m = [status.estimate_m for _, status in sent(record, ControllerStatus)]
    assert max(overshoots_m) > 0.0016  # of its low-pass filter, after the step from the gear
    assert violations(record, circumstances(scenario), RULES) == []


def test_a_jump_within_a_window_may_overshoot_its_edge() -> None:
    table = {
        "name": "jump",
        "duration_s": 0.9,
        "initial_gear": "neutral",
        "controller": {"shift": {"wait_for_sync": True}, "blow": {"duration_s": 0.0}},
        "request": [
            {"at_s": 0.0, "gear": "forward"},
            {"at_s": 0.2, "gear": "backward"},
            {"at_s": 0.4, "gear": "neutral"},
        ],
        "sensor_fault": [{"kind": "wrong", "start_s": 0.8}],
    }
    record, scenario = ran(table)
    assert Gear.UNKNOWN in [m.confirmed for t, m in sent(record, ControllerStatus) if t > 0.8]
    assert violations(record, circumstances(scenario), RULES) == []


def test_a_controller_that_is_cut_off_does_not_answer_for_its_last_report() -> None:
    table = {
        "name": "cut off",
        "duration_s": 0.7,
        "initial_gear": "backward",
        "request": [],
        "plant": {"mounted": True, "pull_force_n": 528.0, "supply_pressure_pa": 505000.0},
        "fault": [{"kind": "bus_off", "start_s": 0.65, "node": "controller"}],
        "valve_fault": [{"kind": "wrong", "start_s": 0.59, "valve": "F"}],
    }
    record, scenario = ran(table)
    given = circumstances(scenario)
    assert safety.figures(record, scenario)["false_gear_s"] > given.sight_s
    assert violations(record, given, RULES) == []
