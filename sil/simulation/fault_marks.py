"""Faults of a run and what the controller reported of them, for pictures and for `opc4 run`."""

from __future__ import annotations

from typing import Any, NamedTuple

from can_dbc.messages import ControllerStatus, Fault
from sil.coupling.clock import NS_PER_S
from sil.files.quantity import quantity
from sil.recording.run_record import RunRecord
from sil.simulation.safety import fault_start_s
from sil.simulation.scenario import FAULT_TABLES, Scenario


class FaultSpan(NamedTuple):
    """A fault of the scenario: its name, and from when to when it acts in s; None: for good."""

    name: str
    start_s: float
    end_s: float | None


def fault_spans(scenario: Scenario) -> list[FaultSpan]:
    """Return the faults of a scenario in order of their start."""
    spans = [
        FaultSpan(_name(table, fault), fault.start_s, fault.end_s)
        for table in FAULT_TABLES
        for fault in getattr(scenario, table)
    ]
    return sorted(spans, key=lambda span: span.start_s)


def _name(table: str, fault: Any) -> str:
    """Return e.g. "loss PositionPulse", "valve stuck open B"."""
    kind = str(fault.kind if hasattr(fault, "kind") else fault.__struct_config__.tag)
    where = [str(getattr(fault, key, "")) for key in ("message", "node", "valve")]
    device = "" if table == "fault" else table.removesuffix("_fault")
    return " ".join(filter(None, [device, kind.replace("_", " "), *where]))


def detections(record: RunRecord) -> list[tuple[float, str]]:
    """Return when the controller first reported each fault, in s, and its name."""
    reported, first = Fault.NONE, []
    for entry, message in record.of(ControllerStatus):
        for fault in Fault:
            if fault and fault in message.faults and fault not in reported:
                first.append((entry.arrival_ns / NS_PER_S, str(fault.name)))
        reported |= message.faults
    return first


def fault_lines(record: RunRecord, scenario: Scenario) -> list[str]:
    """Return a line for each fault of the scenario, and for each that the controller reported."""
    lines = []
    for span in fault_spans(scenario):
        end = "on" if span.end_s is None else f"to {quantity(span.end_s, 's')}"
        lines.append(f"fault: {span.name}, from {quantity(span.start_s, 's')} {end}")
    start_s = fault_start_s(scenario)
    reported = detections(record)
    for at_s, name in reported:
        line = f"controller reports {name} at {quantity(at_s, 's')}"
        if at_s >= start_s:
            line += f", {quantity(at_s - start_s, 's', 3)} after the first fault began"
        lines.append(line)
    return lines if reported or not lines else [*lines, "the controller reported no fault"]
