"""The safe states hold whatever one or two things fail, drawn at random."""

from __future__ import annotations

import math
import random
from typing import Any

import msgspec
import pytest

from sil.recording.end_to_end import EndToEnd
from sil.recording.run_record import RunRecord
from sil.rules import violations
from sil.rules.shipped import RULES
from sil.simulation import safety
from sil.simulation.circumstances import circumstances, sight_s
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import from_table
from sil.simulation.scenario import FAULT_TABLES, Scenario
from sil.studies.load_study import load_study
from sil.swarm.draw import state, vocabulary
from tests.faults.drawn import base, draw, faults_of


def repeated_taken(record: RunRecord, message: str = "ControllerStatus") -> int:
    """How many repeated frames passed for new, because their counter had come round."""
    checked = EndToEnd()
    checked.add(record)
    return checked.counts()[message]["intruder's taken"]


def check(first: int, count: int) -> None:
    shifted = reported = judged = 0
    for number in range(first, first + count):
        loaded = draw(number)
        run = run_in_memory(loaded)
        given = circumstances(loaded.scenario)
        assert violations(run.record, given, RULES) == [], number
        judged += math.isfinite(given.sight_s) and not given.repeated_s
        shifted += bool(run.shifts) and run.shifts[-1].arrived_s is not None
        reported += safety.figures(run.record, loaded.scenario)["fault_bits"] > 0
    # not vacuous: many shifts were done all the same, many faults were seen, few runs left aside
    assert shifted > 0.4 * count
    assert reported > 0.2 * count
    assert judged > 0.7 * count


def test_safe_states_hold() -> None:
    check(0, 24)


@pytest.mark.slow
def test_safe_states_hold_in_a_thousand_runs() -> None:
    check(24, 1000)


def test_everything_that_a_scenario_lets_fail_is_drawn() -> None:
    every = [fault for group in vocabulary().values() for fault in group]
    assert len(set(every)) == len(every) > 100
    assert {faults_of(number)[0] for number in range(len(every))} == set(every)
    # what the fault table states can be drawn, and what a scenario states as a list of faults
    stated = {
        (where, entry["kind"], entry.get("message") or entry.get("node") or entry.get("valve", ""))
        for variant in load_study("faults").file.variant
        for where, entries in variant.set.items()
        if isinstance(entries, list)
        for entry in entries
    }
    assert stated and stated <= {fault[:3] for fault in every}
    lists = {f.name for f in msgspec.structs.fields(Scenario) if f.name.endswith("fault")}
    assert lists == set(FAULT_TABLES) == {fault.where for fault in every} - {"bus", "clock"}


def test_every_parameter_of_every_fault_is_drawn() -> None:
    rng = random.Random("parameters")
    for fault in (fault for group in vocabulary().values() for fault in group):
        if fault.where in ("bus", "clock"):
            continue
        table: dict[str, Any] = {"request": []}
        for _ in range(16):
            state(table, fault, rng)
        drawn = {name for entry in table[fault.where] for name in entry}
        names = {f.name for f in msgspec.structs.fields(fault.type)} | {"kind"}
        assert drawn == names - ({"end_s"} if fault.kind in ("dead", "sent") else set()), fault


def test_repeated_reports_pass_for_new_after_a_round_of_the_counter() -> None:
    """The limit that the claim states: protection by counter and checksum knows no time."""
    found = {}
    for delay_s in (0.1, 0.155):
        fault = {"kind": "replayed", "message": "ControllerStatus", "delay_s": delay_s}
        loaded = from_table(base("N-B") | {"fault": [fault]}, "test")
        record = run_in_memory(loaded).record
        found[delay_s] = repeated_taken(record)
        figures = safety.figures(record, loaded.scenario)
        assert figures["false_gear_s"] <= sight_s(loaded.scenario) + delay_s
        assert (figures["false_gear_s"] > sight_s(loaded.scenario)) == (delay_s == 0.155)
    assert found[0.1] == 0 and found[0.155] > 90


@pytest.mark.parametrize("delay_s", [0.03, 0.155, 0.3])
def test_repeated_commands_of_a_dead_controller_hold_no_valve(delay_s: float) -> None:
    """One repeated message is not enough: the driver wants commands and blows to be good."""
    dead = {"kind": "dead", "node": "controller", "start_s": 0.13}
    for message in ("ValveCommand", "SafetyBlow"):
        fault = {"kind": "replayed", "message": message, "delay_s": delay_s}
        loaded = from_table(base("N-B") | {"fault": [dead, fault]}, "test")
        record = run_in_memory(loaded).record
        assert repeated_taken(record, message) > 0 and (record.truth["cmd_B"] > 0.5).any()
        assert safety.orphan_energised_s(record, loaded.scenario) == 0.0
