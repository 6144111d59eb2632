"""The shifts of a truck's log as a page with its pictures: engine and gear around each of them."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from sil.files.atomic import write_atomically
from sil.files.output_folder import close_folders, prepare_folder
from sil.j1939.engine import EngineSample
from sil.j1939.shifts import Shift, gear_name
from sil.j1939.summary import J1939Summary
from sil.report.figure import Figure, Panel, Series, Span, Stack, Zoom
from sil.report.picture import save
from sil.report.plots import plots
from sil.report.shell import Head, Picture, render

MOST_PICTURES = 12
_AROUND_MS = 1000.0
_BREAK_MS = 500.0


def write_shifts(
    found: J1939Summary, values: dict[str, Any], log: str, out: Path, force: bool
) -> Path:
    """Write report.html, summary.json and pictures of the first shifts; return the folder.

    `values` is what summary.json holds. Raises InputError if the folder cannot be used.
    """
    folder = prepare_folder(out, "summary", force)
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
        verdict=f"{len(found.shifts)} shifts",
        tiles=[
            (f"{found.frames}", "frames"),
            (f"{len(found.shifts)}", "shifts"),
            (f"{median(times_s):.3f} s" if times_s else "none", "median shift time"),
        ],
        again=shlex.join(["opc4", *sys.argv[1:]]),
    )
    page = render("shifts.html", head, groups, lines=found.lines()[1:], pictures=pictures)
    write_atomically(folder / "report.html", page)
    write_atomically(folder / "summary.json", json.dumps(values, indent=1) + "\n")
    close_folders(None)
    return folder


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
    channels = {shift.channel for shift in shifts}
    samples = sorted(s for c in channels for s in found.engine_samples.get(c, ()))
    views = [
        (_ms(found, s.start_ns) - _AROUND_MS, _ms(found, s.end_ns) + _AROUND_MS) for s in shifts
    ]
    near = [s for s in samples if any(a <= _ms(found, s.time_ns) <= b for a, b in views)]
    spans = [Span(_ms(found, s.start_ns), _ms(found, s.end_ns), "band") for s in shifts]
    zooms = [
        Zoom(f"{n}. {_name(s)}", *view)
        for n, (s, view) in enumerate(zip(shifts, views, strict=True), 1)
    ]
    panels = []
    for title, unit, index in (("Engine torque (actual)", "%", 1), ("Engine speed", "rpm", 2)):
        series = [_line(found, near, index, title.lower())] if near else []
        panels.append(Panel(title, unit, series, spans=spans, height=190))
    title = _name(shifts[0]) if len(shifts) == 1 else ""
    return Figure([Stack("time of the log, ms", panels, zooms=zooms, width=10.8)], title)


def _line(found: J1939Summary, samples: Sequence[EngineSample], index: int, label: str) -> Series:
    """Return a line that is interrupted where samples are missing."""
    x, y = [_ms(found, samples[0].time_ns)], [float(samples[0][index])]
    for sample in samples[1:]:
        at_ms = _ms(found, sample.time_ns)
        if at_ms - x[-1] > _BREAK_MS:
            x.append(x[-1] + 1e-3)
            y.append(np.nan)
        x.append(at_ms)
        y.append(float(sample[index]))
    return Series(label, np.array(x), np.array(y), "after" if index == 1 else "truth")
