"""The figure of the live bench: a run over the one before a change."""

from __future__ import annotations

from typing import Any

import numpy as np

from sil.recording.run_record import CHAMBERS
from sil.report.figure import BAR, MM, MS, Figure, Panel, Rule, Series, Span, Stack, Zoom
from sil.report.run_figure import shift_zooms, valve_spans
from sil.simulation.in_memory import Run

MOST_POINTS = 900
"""Points of a line: as many as a screen has, so that a change is drawn at once."""


def comparison_figure(before: Run, after: Run) -> Figure:
    """Return the figure of two runs: the first dashed, the second in full colours."""
    zooms = [zoom for run in (before, after) for zoom in shift_zooms(run.record, run.shifts)]
    low, high = min(zoom.low for zoom in zooms), max(zoom.high for zoom in zooms)
    old, new = _lines(before, low, high, before=True), _lines(after, low, high, before=False)
    positions, speeds, pressures = ([*one, *other] for one, other in zip(old, new, strict=True))
    stroke = after.record.stroke_m * MM
    rules = [Rule(at, "", "grid", "y", "solid") for at in (-stroke, 0.0, stroke)]
    rules += [
        Rule(shift.requested_s * MS, f"{shift.to_gear} requested")
        for shift in after.shifts
        if low <= shift.requested_s * MS <= high
    ]
    panels = [
        Panel("Position", "mm", positions, rules=rules, height=240),
        Panel("Speed of the stay", "m/s", speeds, height=120),
        _valves(before, after),
        Panel("Chamber pressures", "bar", pressures, height=170),
    ]
    visible = [
        Zoom(zoom.name, max(zoom.low, low), min(zoom.high, high))
        for zoom in shift_zooms(after.record, after.shifts)
    ]
    stack = Stack("simulated time, ms", panels, zooms=visible, limits=(low, high))
    return Figure([stack])


def _lines(
    run: Run, low: float, high: float, *, before: bool
) -> tuple[list[Series], list[Series], list[Series]]:
    """Return positions, speed and pressures of a run between two instants in ms."""
    truth, (at_s, estimate_m) = run.record.truth, run.record.estimate
    rows = np.flatnonzero((truth["time_s"] * MS >= low) & (truth["time_s"] * MS <= high))
    rows = rows[:: max(1, len(rows) // MOST_POINTS)]
    x, role = truth["time_s"][rows] * MS, "faint" if before else "truth"
    look: dict[str, Any] = {"dashed": before, "width": 1.2 if before else 2.0}

    def line(label: str, column: str, factor: float, role: str) -> Series:
        name = f"{label}, before" if before else label
        return Series(name, x, truth[column][rows] * factor, role, **look)

    if before:
        estimate = Series(
            "estimate, before", at_s * MS, estimate_m * MM, "faint", "stepped", True, 1.0
        )
    else:
        name = "controller's estimate"
        estimate = Series(name, at_s * MS, estimate_m * MM, "estimate", "sampled", width=1.8)
    return (
        [line("true position", "position_m", MM, role), estimate],
        [line("true speed", "velocity_m_s", 1.0, role)],
        [line(chamber, f"pressure_{chamber}_pa", BAR, chamber) for chamber in CHAMBERS],
    )


def _valves(before: Run, after: Run) -> Panel:
    spans, ticks = [], []
    for lane, chamber in enumerate(reversed(CHAMBERS)):
        for run, low, high, style in (
            (after, lane + 0.40, lane + 0.85, "solid"),
            (before, lane + 0.10, lane + 0.30, "pale"),
        ):
            opened = valve_spans(run.record, chamber)[2]
            spans += [Span(a * MS, b * MS, chamber, "", low, high, style) for a, b in opened]  # type: ignore[arg-type]
        ticks += [(lane + 0.62, f"{chamber} open"), (lane + 0.20, "before")]
    return Panel("Valves", "", spans=spans, ticks=ticks, height=120, limits=(-0.02, 3.0))
