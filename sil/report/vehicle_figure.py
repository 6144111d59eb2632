"""Panels of the truck around the actuator: torque, speed and gear on one time axis."""

from __future__ import annotations

import numpy as np

from can_dbc.messages import Eec1, Etc2, Tsc1
from sil.recording.run_record import RunRecord
from sil.report.figure import MS, Note, Panel, Series, Span, spans_of

RPM = 30.0 / np.pi


def without_torque(record: RunRecord) -> list[tuple[float, float]]:
    """Return from when to when [s] the engine gave less torque than the driver asked for."""
    times, torques = record.series(Eec1, "torque")
    _, asked = record.series(Eec1, "driver_torque")
    if not asked:
        return []
    # lower than asked for by more than the resolution
    missing = [a - t > 0.01 for a, t in zip(asked, torques, strict=True)]
    return spans_of(times, missing, float(record.truth["time_s"][-1]))


def vehicle_panels(record: RunRecord) -> list[Panel]:
    """Return torque, speed and gear as the truck's messages have them; none without a truck."""
    if not record.of(Eec1):
        return []
    return [_torque(record), _speed(record), _gear(record)]


def _torque(record: RunRecord) -> Panel:
    lines = [
        Series(label, times * MS, np.array(values) * 100.0, role, "stepped", width=width)
        for label, field, role, width in (
            ("asked for by the driver", "driver_torque", "faint", 1.0),
            ("engine", "torque", "truth", 2.0),
        )
        for times, values in (record.series(Eec1, field),)
    ]
    notes = [
        Note(0.5 * (begin + end) * MS, 0.0, f"torque to torque {(end - begin) * MS:.0f} ms", up=8.0)
        for begin, end in without_torque(record)
    ]
    return Panel("Engine torque", "%", lines, notes=notes, height=110)


def _speed(record: RunRecord) -> Panel:
    lines = []
    for label, kind, role in (("engine", Eec1, "truth"), ("requested (TSC1)", Tsc1, "alarm")):
        times, values = record.series(kind, "speed_rad_s")
        speed = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
        lines.append(Series(label, times * MS, speed * RPM, role, "stepped"))
    return Panel("Engine speed", "1/min", lines, height=120)


def _gear(record: RunRecord) -> Panel:
    """Return the current gear of ETC2; where none is confirmed, nothing."""
    times, gears = record.series(Etc2, "current_gear")
    end = float(record.truth["time_s"][-1])
    spans = []
    for gear in dict.fromkeys(gear for gear in gears if gear is not None):
        role, text = ("estimate", f"{gear}") if gear else ("N", "neutral")
        for begin, until in spans_of(times, [other == gear for other in gears], end):
            spans.append(Span(begin * MS, until * MS, role, text, 0.0, 1.0))
    ticks = [(0.5, "gear (ETC2)")]
    return Panel("Gear (ETC2)", spans=spans, ticks=ticks, height=46, limits=(0.0, 1.0))
