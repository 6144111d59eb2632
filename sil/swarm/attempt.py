"""One run of a drawn scenario: which rules it broke, and what of the firmware it reached."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from can_dbc.errors import InputError, RunError
from can_dbc.messages import ControllerStatus, Fault, ShiftState
from sil.coupling.clock import NS_PER_S
from sil.recording.run_record import RunRecord
from sil.rules import Rule, Violation, violations
from sil.simulation.circumstances import circumstances
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import from_table
from sil.simulation.scenario import FAULT_TABLES, Scenario


class Attempt(msgspec.Struct, frozen=True, kw_only=True):
    """What came of a scenario.

    refused: why it is no valid scenario. transitions: how often each change of state was reported.
    reached: pairs of a change of state, or of reported faults, with the faults that acted then.
    """

    refused: str = ""
    violations: list[Violation] = []
    transitions: dict[str, int] = {}
    reached: list[str] = []


def attempt(table: Mapping[str, Any], rules: Sequence[Rule]) -> Attempt:
    """Run a scenario table and hold it to the rules."""
    try:
        loaded = from_table(table, "swarm")
        record = run_in_memory(loaded).record
    except InputError as error:
        return Attempt(refused=str(error))
    except RunError as error:
        return Attempt(violations=[Violation("runs_to_the_end", 0.0, str(error))])
    transitions, new = reached(record, loaded.scenario)
    broken = violations(record, circumstances(loaded.scenario), rules)
    return Attempt(violations=broken, transitions=transitions, reached=sorted(new))


def reached(record: RunRecord, scenario: Scenario) -> tuple[dict[str, int], set[str]]:
    """Return how often each change of state was reported, and what was reached, as in an Attempt."""
    windows = [
        (f"{name}.{getattr(fault, 'kind', None) or fault.__struct_config__.tag}", fault)
        for name in FAULT_TABLES
        for fault in getattr(scenario, name)
    ]
    transitions: dict[str, int] = {}
    pairs: set[str] = set()
    before, faults_before = ShiftState.INIT, Fault.NONE
    for entry, status in record.each(ControllerStatus):
        if entry.sender != "controller":
            continue
        at_s = entry.released_ns / NS_PER_S
        acting = [n for n, f in windows if f.start_s <= at_s < (f.end_s or at_s + 1.0)] or ["-"]
        events = []
        if status.state is not before:
            name = f"{before.name} -> {status.state.name}"
            transitions[name] = transitions.get(name, 0) + 1
            events.append(name)
        events += [f.name or "" for f in Fault if f and f in status.faults & ~faults_before]
        pairs.update(f"{event} | {fault}" for event in events for fault in acting)
        before, faults_before = status.state, status.faults
    return transitions, pairs
