"""Faults of a run: when they act, what the controller reported, and the safety figures.

The rules that these measure, and their limits: `sil.rules.shipped`.
Checked by: tests/unit/sil/simulation/test_safety.py, tests/faults/
"""

from __future__ import annotations

import math
from functools import reduce
from operator import or_
from typing import Any, NamedTuple

import numpy as np

from can_dbc.instants import NS_PER_S
from can_dbc.messages import ControllerStatus, Fault, Gear
from sil.files.quantity import quantity
from sil.recording.run_record import CHAMBERS, OPEN_ABOVE, RunRecord
from sil.recording.runs import longest_run
from sil.rules.reports import REPORT_HOLDS_S, accepted, falsely_reported
from sil.rules.shipped import orphaned
from sil.simulation.circumstances import circumstances
from sil.simulation.metrics import gear_at
from sil.simulation.scenario import FAULT_TABLES, Scenario

COLUMNS = (
    *("detected_after_s", "fault_bits", "coils_off_after_s", "end_position_m", "end_gear"),
    *("reported_gear", "energised_at_end", "worst_impact_m_s", "both_filled_s", "half_engaged"),
    *("orphan_energised_s", "false_gear_s"),
)
"""Gears as the contract numbers them: 0 neutral, 1 backward, 2 forward, 3 unknown."""


def fault_start_s(scenario: Scenario) -> float:
    """Return when the first fault begins in s, 0 for load or drift, infinity without one."""
    clock = scenario.clock
    if scenario.bus.extra_load or clock.controller_ppm or clock.driver_ppm:
        return 0.0
    return min((span.start_s for span in fault_spans(scenario)), default=math.inf)


def figures(record: RunRecord, scenario: Scenario) -> dict[str, float]:
    """Return the safety figures of a finished run, by `COLUMNS`; NaN where there is none.

    detected_after_s: from the first fault's start to the first report of a new one. coils_off_after_s: to the
    last coil's switching off. reported_gear: valid at the end. both_filled_s: how long B and F were both
    filled. half_engaged: 1 if the stay ended between its gears. orphan_energised_s: how long a coil was
    energised without a living controller. false_gear_s: the longest time for which a gear was reported
    that the stay was not in.
    """
    start = fault_start_s(scenario)
    truth = record.truth
    time_s, position = truth["time_s"], truth["position_m"]
    windows = scenario.controller.windows
    status = accepted(record, ControllerStatus)
    faults = [(e.arrival_ns / NS_PER_S, m.faults) for e, m in status if m is not None]
    before = reduce(or_, (bits for at, bits in faults if at < start), Fault.NONE)
    later = [(at, bits) for at, bits in faults if at >= start]
    energised = np.any([truth[f"cmd_{c}"] > OPEN_ABOVE for c in CHAMBERS], axis=0)
    off = math.nan
    if not energised[-1] and (late := np.flatnonzero(energised & (time_s >= start))).size:
        off = float(time_s[late[-1] + 1]) - start
    reported_gear = math.nan
    if status and (message := status[-1][1]) is not None:
        age_s = float(time_s[-1]) - status[-1][0].arrival_ns / NS_PER_S
        reported_gear = math.nan if age_s > REPORT_HOLDS_S else float(message.confirmed)
    end = float(position[-1])
    end_gear = gear_at(end, record.stroke_m, windows.gear_tolerance_m, windows.neutral_tolerance_m)
    impacts = [abs(float(e.values["speed_m_s"])) for e in record.events if e.name == "stay_stop"]
    step_s = float(np.median(np.diff(time_s)))
    orphaned_rows = orphaned(record, circumstances(scenario))
    # absolute pressure that moves the stay against its friction
    both = (truth["pressure_B_pa"] > 3e5) & (truth["pressure_F_pa"] > 3e5)
    return {
        "detected_after_s": next((at - start for at, bits in later if bits & ~before), math.nan),
        "fault_bits": float(reduce(or_, (bits for _, bits in later), Fault.NONE)),
        "coils_off_after_s": off,
        "end_position_m": end,
        "end_gear": float(end_gear),
        "reported_gear": reported_gear,
        "energised_at_end": float(energised[-1]),
        "worst_impact_m_s": max(impacts, default=math.nan),
        "both_filled_s": float(np.count_nonzero(both)) * step_s,
        "half_engaged": float(end_gear == Gear.UNKNOWN),
        "orphan_energised_s": float(np.count_nonzero(orphaned_rows)) * step_s,
        "false_gear_s": longest_run(falsely_reported(record, windows)) * step_s,
    }


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
