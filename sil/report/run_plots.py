"""The interactive plots of a run: position, speed, valves, pressures, shaft speeds over time.

Checked by: tests/unit/sil/report/test_interactive.py, tests/browser/
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sil.recording.run_record import CHAMBERS, RunRecord
from sil.report.interactive import Group, Panel, Series, Window, plots
from sil.simulation.metrics import Shift

Floats = NDArray[np.float64]
AFTER_S = 0.25


def run_plots(record: RunRecord, shifts: Sequence[Shift]) -> Group:
    """The plots of a finished run, with a button for each shift."""
    truth = record.truth
    time = truth["time_s"]
    believed = held(*record.believed, time)
    position = Panel(
        "Position of the stay",
        "mm",
        [
            Series("true", 1e3 * truth["position_m"], "truth"),
            Series("as the controller believes", 1e3 * believed, "believed", stepped=True),
        ],
        height=230,
    )
    speed = Panel("Speed of the stay", "m/s", [Series("true", truth["velocity_m_s"], "truth")], 130)
    valves = Panel(
        "Valves: duty of the coil (dashed) and plunger",
        "open",
        [
            Series(f"{c} {what}", 1.25 * row + truth[f"{column}_{c}"], c, True, column == "cmd")
            for row, c in enumerate(reversed(CHAMBERS))
            for what, column in (("coil", "cmd"), ("open", "valve"))
        ],
        height=150,
        marks=[(1.25 * row + 0.5, c) for row, c in enumerate(reversed(CHAMBERS))],
    )
    pressures = Panel(
        "Pressures, absolute",
        "bar",
        [Series(c, 1e-5 * truth[f"pressure_{c}_pa"], c) for c in CHAMBERS],
    )
    shafts = Panel(
        "Shaft speeds, referred to the synchronizer",
        "rad/s",
        [
            Series("input", truth["input_rad_s"], "believed", stepped=True),
            Series("output", truth["output_rad_s"], "faint", stepped=True),
        ],
        height=130,
    )
    windows = [
        Window(
            f"{shift.from_gear} to {shift.to_gear}",
            shift.requested_s - 0.02,
            (shift.arrived_s or shift.requested_s) + AFTER_S,
        )
        for shift in shifts
    ]
    panels = [position, speed, valves, pressures, shafts]
    return plots("time, s", time, panels, windows, twin=True)


def held(times: Floats, values: Floats, at: Floats) -> Floats:
    """Values that hold from their instants on, at other instants; nan before the first."""
    if not len(times):
        return np.full(len(at), np.nan)
    index = np.searchsorted(times, at, side="right") - 1
    return np.where(index >= 0, values[np.maximum(index, 0)], np.nan)
