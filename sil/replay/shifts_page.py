"""The shifts of a truck's log as a page with its pictures: engine and gear around each of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Final

import numpy as np

from sil.files.quantity import counted, noun
from sil.j1939.summary import J1939Summary
from sil.report.figure import Figure, Floats, Panel, Series, Span, Stack, Zoom
from sil.report.picture import save
from sil.report.plots import plots
from sil.report.shell import Head, Picture, render
from sil.shifts.cutter import Shift, gear_name
from sil.shifts.engine import EngineTrace

MOST_PICTURES = 12
_AROUND_MS = 1000.0
_BREAK_MS = 500.0
_ENGINE: Final = (
    ("Engine torque (actual)", "%", "torque_percent", "after"),
    ("Engine speed", "rpm", "speed_rpm", "truth"),
)


def shifts_page(found: J1939Summary, log: str, command: str, folder: Path) -> str:
    """Return the page, pictures of the first shifts written into the folder.

    `command` is the call that made it.
    """
    pictures = []
    caption = "Shift time of each shift over the time of the log."
    pictures.append(Picture(save(_overview(found), folder, "shifts"), "Shift times", caption))
    for number, shift in enumerate(found.shifts[:MOST_PICTURES], start=1):
        figure = _around(found, [shift])
        if any(panel.series for panel in figure.stacks[0].panels):
            caption = f"Shift {number}: {shift}"
            image = save(figure, folder, f"shift_{number}")
            pictures.append(Picture(image, "Engine around the shift", caption))
    groups = plots(_overview(found)) + plots(_around(found, found.shifts))
    times_s = [shift.duration_s for shift in found.shifts]
    head = Head(
        command="replay",
        name=log,
        verdict=counted(len(found.shifts), "shift"),
        tiles=[
            (f"{found.frames}", noun(found.frames, "frame")),
            (f"{len(found.shifts)}", noun(len(found.shifts), "shift")),
            (f"{median(times_s):.3f} s" if times_s else "none", "median shift time"),
        ],
        again=command,
    )
    return render("shifts.html", head, groups, lines=found.lines()[1:], pictures=pictures)


def _ms(found: J1939Summary, time_ns: int) -> float:
    """Return a time in ms from the log's first frame."""
    return (time_ns - (found.first_ns or 0)) / 1e6


def _name(shift: Shift) -> str:
    return f"{gear_name(shift.from_gear)} to {gear_name(shift.to_gear)}"


def _overview(found: J1939Summary) -> Figure:
    x = np.array([_ms(found, shift.start_ns) / 1e3 for shift in found.shifts])
    y = np.array([shift.duration_s for shift in found.shifts])
    panel = Panel("Shift time", "s", [Series("shift time", x, y, "after", "dots")], height=150)
    return Figure([Stack("time of the log, s", [panel], width=10.8)])


def _around(found: J1939Summary, shifts: Sequence[Shift]) -> Figure:
    """Return torque and speed of the engine, the shifts as spans, with a zoom for each."""
    views = [
        (_ms(found, s.start_ns) - _AROUND_MS, _ms(found, s.end_ns) + _AROUND_MS) for s in shifts
    ]
    spans = [Span(_ms(found, s.start_ns), _ms(found, s.end_ns), "band") for s in shifts]
    zooms = [
        Zoom(f"{n}. {_name(s)}", *view)
        for n, (s, view) in enumerate(zip(shifts, views, strict=True), 1)
    ]
    channels = sorted({shift.channel for shift in shifts} & found.engines.keys())
    panels = []
    for title, unit, column, role in _ENGINE:
        lines = [_line(found, found.engines[channel], column, views) for channel in channels]
        series = [Series(title.lower(), *line, role) for line in lines if len(line[0])]
        panels.append(Panel(title, unit, series, spans=spans, height=190))
    title = _name(shifts[0]) if len(shifts) == 1 else ""
    return Figure([Stack("time of the log, ms", panels, zooms=zooms, width=10.8)], title)


def _line(
    found: J1939Summary, engine: EngineTrace, column: str, views: Sequence[tuple[float, float]]
) -> tuple[Floats, Floats]:
    """Return times in ms and values [n] within any view, NaN where samples are missing."""
    x = (np.array(engine.time_ns) - (found.first_ns or 0)) / 1e6
    y = np.array(getattr(engine, column), dtype=np.float64)
    near = np.zeros(len(x), dtype=bool)
    for begin, end in np.searchsorted(x, views).tolist():
        near[begin:end] = True
    x, y = x[near], y[near]
    breaks = np.flatnonzero(np.diff(x) > _BREAK_MS) + 1
    return np.insert(x, breaks, x[breaks - 1] + 1e-3), np.insert(y, breaks, np.nan)
