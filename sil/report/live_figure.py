"""The figures of the live bench: a run over the one before a change, and its bus."""

from __future__ import annotations

from dataclasses import replace

from sil.recording.run_record import CHAMBERS
from sil.report.figure import MS, Panel, Stack, Zoom
from sil.report.run_figure import (
    STATES,
    bus_panel,
    motion_panels,
    shift_zooms,
    states_panel,
    with_faults,
)
from sil.simulation.in_memory import Run
from sil.simulation.safety import detections, fault_spans


def comparison_stack(before: Run, after: Run) -> Stack:
    """Return the plots of a run; those of the run before are dashed, and thin bars below its own."""
    panels = _panels(after)
    if before is not after:
        by_title = {panel.title: panel for panel in _panels(before)}
        panels = [_over(panel, by_title.get(panel.title, panel)) for panel in panels]
    return _stack(after, panels)


def bus_stack(run: Run) -> Stack:
    """Return the firmware's states and the frames on the bus over the same axis."""
    whole = [Zoom("", 0.0, _end(run))]
    return _stack(run, [states_panel(run.record), bus_panel(run.record, whole)])


def _stack(run: Run, panels: list[Panel]) -> Stack:
    zooms = shift_zooms(run.record, run.shifts)
    faults, reported = fault_spans(run.scenario), detections(run.record)
    marked = [with_faults(panel, faults, reported, _end(run) / MS) for panel in panels]
    return Stack("simulated time, ms", marked, zooms=zooms, limits=(0.0, _end(run)))


def _end(run: Run) -> float:
    return float(run.record.truth["time_s"][-1]) * MS


def _panels(run: Run) -> list[Panel]:
    """Return the panels of a run's figure but that of the bus, with names short enough to be read beside."""
    short = {
        "moving piston, where it touches the stay": "piston, at the stay",
        "true position of the stay": "true position",
    }
    return [
        replace(panel, series=[replace(s, label=short.get(s.label, s.label)) for s in panel.series])
        for panel in motion_panels(run.record, shift_zooms(run.record, run.shifts), run.shifts)
    ]


def _over(panel: Panel, before: Panel) -> Panel:
    lines = []
    for line in (line for line in before.series if not line.dashed):
        role, label = line.role if line.role in CHAMBERS else "faint", f"{line.label}, before"
        lines.append(replace(line, label=label, role=role, dashed=True, width=1.2))
    if panel.title == STATES:  # a lane of its own, with the names
        lane = [replace(span, low=-1.0, high=-0.1, style="pale") for span in before.spans]
        ticks = [*panel.ticks, (-0.55, "before")]
        spans = [*panel.spans, *lane]
        return replace(panel, spans=spans, ticks=ticks, limits=(-1.0, 1.0), height=60)
    bars = [
        replace(span, low=span.low - 0.08, high=span.low, label="", style="pale")
        for span in before.spans
        if span.style == "solid" and span.role in CHAMBERS
    ]
    return replace(panel, series=[*lines, *panel.series], spans=[*panel.spans, *bars])
