"""Runs over each other, aligned at the request: the figure and the page of `opc4 compare`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sil.files.atomic import write_atomically
from sil.files.quantity import quantity
from sil.recording.run_record import CHAMBERS
from sil.report.figure import BAR, MM, MS, Figure, Panel, Rule, Series, Span, Stack, spans_of
from sil.report.picture import MOST_ZOOMS, save
from sil.report.plots import plots
from sil.report.shell import Head, Picture, render
from sil.report.theme import SERIES
from sil.simulation.compared import MetricRow, signed
from sil.simulation.kept_run import EventRow, KeptRun


def compare_figure(runs: Sequence[KeptRun], title: str = "") -> Figure:
    """Return position, speed, pressures and valves of all runs, a stack for each shift."""
    count = min(max(1, *(len(run.shifts) for run in runs)), MOST_ZOOMS)
    return Figure([_stack(runs, shift) for shift in range(count)], title, same_scale=True)


def _stack(runs: Sequence[KeptRun], shift: int) -> Stack:
    present = [(k, run) for k, run in enumerate(runs) if shift < max(1, len(run.shifts))]
    # from just before the request to just after the last arrival or confirmation
    low, high = -0.02, max(_settled_s(run, shift) for _, run in present) + 0.04
    lines: dict[str, list[Series]] = {}
    rules, spans, ticks = [Rule(0.0, "request")], [], []
    for order, (k, run) in enumerate(present):
        begin, _ = run.span(shift)
        role, time_s = f"series{k % SERIES}", run.trace["time_s"]
        rows = (time_s >= begin + low) & (time_s <= begin + high)
        x = (time_s[rows] - begin) * MS
        for name, factor in (
            ("position_m", MM),
            ("velocity_m_s", 1.0),
            *((f"pressure_{chamber}_pa", BAR) for chamber in CHAMBERS),
        ):
            y = run.trace[name][rows] * factor
            line = Series(run.name, x, y, role, width=max(3.2 - 0.9 * order, 1.2))
            lines.setdefault(name, []).append(line)
        estimate = run.trace["position_internal_m"][rows] * MM
        lines["position_m"].append(Series("", x, estimate, role, "stepped", True, 1.0))
        marks = [(at_s, name) for at_s, name in run.events if name.endswith(" reported")]
        marks += [(fault.start_s, f"{fault.name} begins") for fault in run.faults]
        rules += [Rule((at_s - begin) * MS, name, role, "x", "dashed") for at_s, name in marks]
        spans += list(_valve_spans(run, x, rows, role, order, len(present)))
    ticks = [(lane + 0.5, f"{chamber} open") for lane, chamber in enumerate(CHAMBERS)]
    position = "Position; dashed: the controller's estimate"
    panels = [
        Panel(position, "mm", lines["position_m"], rules=rules, height=230),
        Panel("Speed", "m/s", lines["velocity_m_s"], height=120, legend=False),
        *(
            Panel(f"Pressure in {chamber}, absolute", "bar", lines[f"pressure_{chamber}_pa"], height=120, legend=False)
            for chamber in CHAMBERS
        ),
        Panel("Valves", "", spans=spans, ticks=ticks, height=120, limits=(-0.02, 3.0), legend=False),
    ]  # fmt: skip
    unnamed = [replace(rule, text="") for rule in rules]
    panels[1:] = [replace(panel, rules=unnamed) for panel in panels[1:]]
    first = present[0][1].shifts
    title = f"{first[shift].from_gear} to {first[shift].to_gear}" if first else "whole run"
    axis = "time after the request, ms" if first else "simulated time, ms"
    return Stack(axis, panels, title, limits=(low * MS, high * MS), width=8.0)


def _settled_s(run: KeptRun, shift: int) -> float:
    """Return when a shift has settled, in s after its request."""
    begin, end = run.span(shift)
    if not run.shifts:
        return end
    figures = run.shifts[shift]
    settled = [t - begin for t in (figures.arrived_s, figures.confirmed_s) if t is not None]
    return min(max(settled), end - begin) if settled else end - begin


def _valve_spans(
    run: KeptRun, x: np.ndarray, rows: np.ndarray, role: str, order: int, count: int
) -> Iterator[Span]:
    """Yield where each valve is open; the runs lie below each other in the lane of a chamber."""
    for lane, chamber in enumerate(CHAMBERS):
        top = lane + 0.92 - 0.84 * order / count
        opened = run.trace[f"valve_{chamber}"][rows] > 0.5
        for begin, end in spans_of(x, opened, float(x[-1])) if len(x) else ():
            yield Span(begin, end, role, "", top - 0.76 / count, top)


def event_cells(row: EventRow) -> list[str]:
    """Return shift and name, the times after the request, and their differences to the first run."""
    first = row.after_request_s[0]
    return [
        f"{row.shift}: {row.name}",
        *("none" if t is None else f"{MS * t:.3f} ms" for t in row.after_request_s),
        *(
            "" if t is None or first is None else signed(t - first, "s")
            for t in row.after_request_s[1:]
        ),
    ]


def head_of(names: Sequence[str]) -> list[str]:
    """Return the heads of a table of runs: their names, and those of the differences."""
    first, *others = names
    return ["", first, *others, *(f"{name} - {first}" for name in others)]


def write_page(
    runs: Sequence[KeptRun],
    metrics: Sequence[MetricRow],
    events: Sequence[EventRow],
    equal: bool,
    folder: Path,
    again: str,
) -> None:
    """Write compare.png, compare.svg and report.html; `again`: the command that makes them."""
    names = [run.name for run in runs]
    figure = compare_figure(runs, ", ".join(names))
    picture = save(figure, folder, "compare", dots_per_inch=140)
    arrivals = [run.metrics.get("shift_time_s") for run in runs]
    head = Head(
        command="compare",
        name=", ".join(names),
        verdict="traces equal to the bit" if equal else f"events that differ: {len(events)}",
        tiles=[
            ("never" if time_s is None else quantity(time_s, "s", 3), f"{name}, request to stop")
            for name, time_s in zip(names, arrivals, strict=True)
        ],
        again=again,
    )
    text = "Position, speed, pressures and valves over the time after the request, the runs over each other."
    page = render(
        "compare.html",
        head,
        plots(figure),
        picture=Picture(picture, text, text),
        heads=head_of(names),
        metrics=[row.cells() for row in metrics],
        events=[event_cells(row) for row in events],
    )
    write_atomically(folder / "report.html", page)
