"""The figure of a run: position, valves, pressures, firmware states and bus over simulated time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from can_dbc.instants import NS_PER_S
from can_dbc.messages import Chamber, ControllerStatus, Eec1, Etc2, SafetyBlow, Tsc1
from sil.recording.run_record import CHAMBERS, Floats, RunRecord
from sil.report.figure import (
    BAR,
    MM,
    MS,
    Figure,
    Note,
    Panel,
    Rule,
    Series,
    Span,
    Stack,
    Zoom,
    spans_of,
)
from sil.simulation.metrics import Shift
from sil.simulation.safety import FaultSpan, detections

SILENT = "SILENT"
STATES = "Firmware state"

Interval = tuple[float, float]


def run_figure(
    record: RunRecord,
    shifts: Sequence[Shift],
    title: str = "",
    subtitle: str = "",
    faults: Sequence[FaultSpan] = (),
) -> Figure:
    """Return the figure of a run, a zoom for each shift; faults and first reports are marked in every panel."""
    zooms = shift_zooms(record, shifts)
    truth, stroke = record.truth, record.stroke_m * MM
    time = truth["time_s"] * MS
    shafts = [
        Series(name, time, truth[f"{name}_rad_s"], role, "stepped")
        for name, role in (("input", "estimate"), ("output", "faint"))
    ]
    panels = [
        *motion_panels(record, zooms, shifts),
        bus_panel(record, zooms),
        Panel(
            "Shaft speeds, referred to the synchronizer",
            "rad/s",
            shafts,
            height=130,
            page_only=True,
        ),
    ]
    whole = [Series("", time, truth["position_m"] * MM, "truth", width=1.2)]
    ticks = [(-stroke, "forward"), (0.0, "neutral"), (stroke, "backward")]
    limits = (-1.25 * stroke, 1.25 * stroke)
    overview = Panel("Position", series=whole, height=52, ticks=ticks, limits=limits)
    reported, end_s = detections(record), float(truth["time_s"][-1])
    marked = [with_faults(panel, faults, reported, end_s) for panel in panels]
    stack = Stack("simulated time, ms", marked, zooms=zooms, overview=overview)
    return Figure([stack], title, subtitle)


def motion_panels(record: RunRecord, zooms: Sequence[Zoom], shifts: Sequence[Shift]) -> list[Panel]:
    """Return the panels of truck, position, speed, valves, coils, pressures and firmware states."""
    truth, time = record.truth, record.truth["time_s"] * MS
    speed = Series("true", time, truth["velocity_m_s"], "truth")
    currents = [
        Series(c, time, truth[f"current_{c}_a"], c) for c in CHAMBERS if f"current_{c}_a" in truth
    ]
    return [
        *vehicle_panels(record),
        _position(record, zooms, shifts),
        Panel("Speed of the stay", "m/s", [speed], height=130, page_only=True),
        _valves(record, zooms),
        *([Panel("Current of the coils", "A", currents, height=110)] if currents else []),
        _pressures(record, zooms),
        states_panel(record),
    ]


def with_faults(
    panel: Panel,
    faults: Sequence[FaultSpan],
    reported: Sequence[tuple[float, str]],
    end_s: float,
    begin_s: float = 0.0,
) -> Panel:
    """Return a panel with a band where each fault acts, and a line where one is reported first.

    reported: (instant in s, name); end_s: of the run; begin_s: of the run, on the axis.
    """
    is_named = panel.title.startswith("Position")
    windows_s = [
        (begin_s + start_s, end_s if until_s is None else begin_s + until_s)
        for _, start_s, until_s in faults
    ]
    spans = [Span(start_s * MS, until_s * MS, "fault") for start_s, until_s in windows_s]
    rules = [
        Rule(at_s * MS, f"{name} reported" if is_named else "", "alarm", "x", "dashed")
        for at_s, name in reported
    ]
    names = ", ".join(fault.name for fault in faults)
    keys = [(f"fault: {names}", "fault")] if is_named and faults else panel.keys
    return replace(panel, spans=[*spans, *panel.spans], rules=[*panel.rules, *rules], keys=keys)


def shift_zooms(record: RunRecord, shifts: Sequence[Shift]) -> list[Zoom]:
    """Return the parts of the axis, in ms, from before each request until it has settled, or the whole run."""
    end = float(record.truth["time_s"][-1])
    starts_s = [*(shift.requested_s for shift in shifts[1:]), end]
    zooms = []
    for shift, until in zip(shifts, starts_s, strict=False):
        first = shift.requested_s
        settled = [shift.arrived_s, shift.confirmed_s, first + 0.1]
        closed = [e.time_s for e in record.events if e.name.endswith("_close")]
        reported = [at_s for at_s, _ in detections(record)]
        settled += [time_s for time_s in (*closed, *reported) if first <= time_s <= until]
        for begin, back in without_torque(record):
            if begin <= first <= back:
                first = begin
                settled.append(back)
        last = max(instant for instant in settled if instant is not None)
        low, high = max(first - 0.02, 0.0), min(last + 0.025, until)
        zooms.append(Zoom(f"{shift.from_gear} to {shift.to_gear}", low * MS, high * MS))
    return zooms or [Zoom("whole run", 0.0, end * MS)]


# --- position -----------------------------------------------------------------------------------
def _position(record: RunRecord, zooms: Sequence[Zoom], shifts: Sequence[Shift]) -> Panel:
    time, position = record.truth["time_s"] * MS, record.truth["position_m"] * MM
    estimate_s, estimate_m = record.estimate
    x, y = estimate_s * MS, estimate_m * MM
    lines = [
        Series("true position of the stay", time, position, "truth", width=2.2),
        Series("controller's estimate", x, y, "estimate", "sampled", width=1.8),
    ]
    pistons: list[Series] = []
    stroke = record.stroke_m * MM
    rules = [Rule(at, "", "grid", "y", "solid") for at in (-stroke, 0.0, stroke)]
    notes = list(_synchronizer_notes(record, zooms))
    spans = []
    for zoom, shift in zip(zooms, shifts, strict=False):  # a run without a shift has one zoom
        rules.append(Rule(shift.requested_s * MS, f"{shift.to_gear} requested"))
        if shift.confirmed_s is not None:
            rules.append(Rule(shift.confirmed_s * MS, f"{shift.to_gear} confirmed"))
        inside = (time >= zoom.low) & (time <= zoom.high)
        if (piston := _piston(record, shift)) is not None and inside.any():
            name, values = piston
            reach, values = position[inside], values[inside]  # of this shift, with some room
            near = (values >= reach.min() - 1.5) & (values <= reach.max() + 1.5)
            shown = np.where(near, values, np.nan)
            label = "" if pistons else "moving piston, where it touches the stay"
            pistons.append(Series(label, time[inside], shown, "faint", dashed=True, width=1.0))
            notes += _note_on_line(time[inside], shown, name, reach)
        for at, lag, level in _lags(record, shift):
            spans.append(Span(at, at + lag, "alarm", "", level - 0.04, level + 0.04))
            text = f"{lag:.0f} ms late"
            note = Note(at + 0.5 * lag, level, text, "alarm", up=-4.0, bold=True)
            if lag < _width(text, at, zooms):  # on its left the curve leaves room
                note = replace(note, x=at - _width(" ", at, zooms), align="right", up=0.0)
            notes.append(note)
        notes += _impact_notes(record, shift, _width(" ", zoom.low, zooms))
    series = [*pistons, *lines]
    return Panel("Position", "mm", series, spans=spans, rules=rules, notes=notes, height=230)


def _width(text: str, at: float, zooms: Sequence[Zoom]) -> float:
    """Return about how long a text is in the picture, in ms, at an instant."""
    zoom = next((z for z in zooms if z.low <= at <= z.high), zooms[0])
    # a character's width as a share of the width of all zooms side by side
    return 0.0065 * len(text) * len(zooms) * (zoom.high - zoom.low)


def _piston(record: RunRecord, shift: Shift) -> tuple[str, Floats] | None:
    """Return the piston that carries this shift, in mm, where its driving contact meets the stay.

    Out of neutral it pushes on the collar, so its free travel is taken off; towards neutral it
    pulls on the nut. Piston 2 is the mirror image.
    """
    away = shift.to_gear != "neutral"
    side = shift.to_gear if away else shift.from_gear
    free = record.free_travel_m if away else 0.0
    if side == "backward":
        return "piston 1", (record.truth["piston_1_m"] - free) * MM
    if side == "forward":
        return "piston 2", (free - record.truth["piston_2_m"]) * MM
    return None


def _note_on_line(time: Floats, values: Floats, text: str, other: Floats) -> list[Note]:
    """Return a text at the first point of a line where it moves, away from the begin of another line."""
    if len(values) < 2:
        return []
    moving = np.flatnonzero(np.abs(np.gradient(values)) > 1e-3)
    return [
        Note(
            float(time[i]), float(values[i]), text, "faint", "right",
            up=math.copysign(7.0, values[i] - other[0]),
        )
        for i in moving[:1]
    ]  # fmt: skip


def _synchronizer_notes(record: RunRecord, zooms: Sequence[Zoom]) -> Iterator[Note]:
    """Yield how long the synchronizer holds the stay, each time that it does."""
    begun: float | None = None
    for event in record.events:
        if event.name == "sync_block":
            begun = event.time_s
        elif event.name in ("sync_unblock", "breakaway") and begun is not None:
            text = f"synchronizer holds {(event.time_s - begun) * MS:.0f} ms"
            position = float(event.values["position_m"]) * MM
            note = Note(0.5 * (begun + event.time_s) * MS, position, text, up=-4.0)
            if (event.time_s - begun) * MS < _width(text, note.x, zooms) and position < 0.0:
                # the curve falls on its right
                note = replace(note, x=event.time_s * MS, align="right")
            yield note
            begun = None


def _lags(record: RunRecord, shift: Shift) -> Iterator[tuple[float, float, float]]:
    """Yield (true instant in ms, lag of the metrics in ms, position in mm) at 10 % and 90 % of the travel."""
    if shift.arrived_s is None:
        return
    time, position = record.truth["time_s"], record.truth["position_m"]
    start, goal = np.interp([shift.requested_s, shift.arrived_s], time, position)
    within = (time >= shift.requested_s) & (time <= shift.arrived_s + 1e-3)
    for share, lag in ((0.1, shift.position_lag_10_s), (0.9, shift.position_lag_90_s)):
        level = start + share * (goal - start)
        beyond = within & ((position >= level) if goal > start else (position <= level))
        if lag is not None and beyond.any():
            yield float(time[int(np.argmax(beyond))]) * MS, lag * MS, level * MM


def _impact_notes(record: RunRecord, shift: Shift, gap: float) -> list[Note]:
    """Return the stop, and the hardest other impact unless far softer; gap: of a text left of the curve, ms."""
    others = [impact for impact in shift.impacts if impact.name != "stay_stop"]
    worst = max(others, key=lambda impact: impact.energy_j, default=None)
    notes = []
    if worst is not None and worst.energy_j > 0.1 * (shift.impact_energy_j or 0.0):
        text = f"{worst.name.replace('_', ' ')}: {worst.energy_j:.2f} J"
        notes = [Note(worst.time_s * MS, worst.position_m * MM, text, "alarm", up=-9.0)]
    if shift.arrived_s is None or shift.impact_speed_m_s is None or shift.impact_energy_j is None:
        return notes
    time, position = record.truth["time_s"], record.truth["position_m"]
    start, goal = np.interp([shift.requested_s, shift.arrived_s], time, position)
    beyond = 7.0 if goal > start else -7.0
    if worst is not None and abs(worst.position_m - start) < abs(worst.position_m - goal):
        # at the start the other side has the name of the piston
        notes = [replace(note, align="right", up=beyond) for note in notes]
    elif worst is not None and worst.time_s < shift.arrived_s:  # on its left the curve leaves room
        notes = [replace(note, x=note.x - gap, align="right", up=0.0) for note in notes]
    else:
        notes = [replace(note, x=note.x + gap, align="left") for note in notes]
    text = f"stop: {shift.impact_speed_m_s:.2f} m/s, {shift.impact_energy_j:.1f} J"
    return [*notes, Note(shift.arrived_s * MS, goal * MM, text, up=beyond)]


# --- valves -------------------------------------------------------------------------------------
def _valves(record: RunRecord, zooms: Sequence[Zoom]) -> Panel:
    """Return commands above reactions, with the delays between them where there is room."""
    spans, notes, ticks, rules = [], [], [], []
    for lane, chamber in enumerate(reversed(CHAMBERS)):
        spans_s = valve_spans(record, chamber)
        coil, blowing, is_open = ([(a * MS, b * MS) for a, b in times] for times in spans_s)
        open_lane, coil_lane = (lane + 0.08, lane + 0.44), (lane + 0.54, lane + 0.90)
        for times, text, between, style in (
            (is_open, "", open_lane, "solid"),
            (coil, "", coil_lane, "pale"),
            (blowing, "safety blow", coil_lane, "hatched"),
        ):
            spans += [Span(a, b, chamber, text, *between, style) for a, b in times]  # type: ignore[arg-type]
        ticks += [(lane + 0.26, f"{chamber} valve"), (lane + 0.72, f"{chamber} command")]
        rules.append(Rule(float(lane), "", "grid", "y", "solid"))
        edges = [-math.inf, *(edge for pair in is_open for edge in pair), math.inf]
        for k, (opened, closed) in enumerate(is_open):
            needed = _width("88 ms 88 ms", opened, zooms)
            inside = closed - opened >= needed
            room = inside or min(opened - edges[2 * k], edges[2 * k + 3] - closed) >= needed
            before = [a for a, b in coil if a <= opened <= b]
            after = [b for _, b in coil if opened < b <= closed]
            sides = ("left", "right") if inside else ("right", "left")
            for causes, reacted, side in zip((before, after), (opened, closed), sides, strict=True):
                if causes:
                    text = f"{reacted - causes[-1]:.0f} ms"
                    if room:
                        notes.append(Note(reacted, lane + 0.26, text, "ink", side))  # type: ignore[arg-type]
                    first, last = sorted((causes[-1], reacted))
                    spans.append(Span(first, last, "ink", "", lane + 0.485, lane + 0.495))
    return Panel("Valves: command and reaction", "", spans=spans, notes=notes, ticks=ticks, rules=rules,
                 height=130, limits=(-0.02, 3.0))  # fmt: skip


def valve_spans(
    record: RunRecord, chamber: str
) -> tuple[list[Interval], list[Interval], list[Interval]]:
    """Return (start, end) in s of a coil energised, timeouts included, a safety blow under way, a valve open."""
    end = float(record.truth["time_s"][-1])
    times, active = record.series(SafetyBlow, "active")
    _, chambers = record.series(SafetyBlow, "chamber")
    blowing = [a and c == Chamber[chamber] for a, c in zip(active, chambers, strict=True)]
    coil = _event_spans(record, f"coil_{chamber}_", ("on", "off"), False)
    is_open = bool(record.truth[f"valve_{chamber}"][0] > 0.5)
    valve = _event_spans(record, f"valve_{chamber}_", ("open", "close"), is_open)
    blown = [  # the coil energised by a blow
        (max(a, c), min(b, d))
        for a, b in spans_of(times, blowing, end)
        for c, d in coil
        if a < d and c < b
    ]
    return coil, blown, valve


def _event_spans(
    record: RunRecord, prefix: str, names: tuple[str, str], at_start: bool
) -> list[Interval]:
    """Return the spans between a pair of plant events that switch something on and off."""
    moves = [(e.time_s, e.name) for e in record.events if e.name.startswith(prefix)]
    on = [at_start, *(name == prefix + names[0] for _, name in moves)]
    return spans_of([0.0, *(t for t, _ in moves)], on, float(record.truth["time_s"][-1]))


# --- pressures, states, bus ---------------------------------------------------------------------
def _pressures(record: RunRecord, zooms: Sequence[Zoom]) -> Panel:
    time = record.truth["time_s"] * MS
    supply = record.supply_pressure_pa * BAR
    lines = {c: record.truth[f"pressure_{c}_pa"] * BAR for c in CHAMBERS}
    series = [Series(c, time, values, c, width=1.8) for c, values in lines.items()]
    rules = [Rule(supply, "supply", "faint", "y", "dashed")]
    notes = [note for zoom in zooms for note in _letters(zoom, time, lines, supply)]
    return Panel("Pressure, absolute", "bar", series, rules=rules, notes=notes,
                 height=155, limits=(0.0, 1.12 * supply), legend=False)  # fmt: skip


def _letters(zoom: Zoom, time: Floats, lines: dict[str, Floats], scale: float) -> Iterator[Note]:
    """Yield the name of each line where it is furthest from the others."""
    margin = 0.04 * (zoom.high - zoom.low)
    inside = np.flatnonzero((time > zoom.low + margin) & (time < zoom.high - margin))
    if not len(inside):
        return
    t = time[inside]
    for order, (name, line) in enumerate(lines.items()):
        gaps = [np.abs(line - other)[inside] for key, other in lines.items() if key != name]
        # lines on top of one another have their letters side by side
        ripple = np.cos((t - t[0]) / (t[-1] - t[0] + 1e-9) * 6.0 + 2.0 * order)
        i = int(np.argmax(np.minimum(np.minimum(*gaps), 0.25 * scale) + 1e-3 * scale * ripple))
        yield Note(float(t[i]), float(line[inside][i]), name, name, bold=True)


def states_panel(record: RunRecord) -> Panel:
    """Return the states that the controller reported, and where it reported nothing."""
    times, states = record.series(ControllerStatus, "state")
    names = [state.name for state in states]
    spans = []
    for a, b, name in state_spans(times, names, float(record.truth["time_s"][-1])):
        role, style = ("faint", "hatched") if name == SILENT else (name, "solid")
        spans.append(Span(a * MS, b * MS, role, name.lower(), 0.0, 1.0, style))  # type: ignore[arg-type]
    ticks = [(0.5, "firmware state")]
    return Panel(STATES, "", spans=spans, ticks=ticks, height=46, limits=(0.0, 1.0))


def state_spans(times: Floats, names: Sequence[str], end: float) -> list[tuple[float, float, str]]:
    """Return (start, end, state) in s of reports [n] at times [n], SILENT where three are missing."""
    if len(times) == 0:
        return [(0.0, end, SILENT)]
    step = float(np.median(np.diff(times))) if len(times) > 1 else end
    spans: list[tuple[float, float, str]] = []
    for since, until, name in zip(times.tolist(), [*times[1:].tolist(), end], names, strict=True):
        heard = until if until - since < 3.5 * step else since + step
        continues = bool(spans) and spans[-1][1:] == (since, name)
        spans.append((spans.pop()[0] if continues else since, heard, name))
        if heard < until:
            spans.append((heard, until, SILENT))
    return spans


def bus_panel(record: RunRecord, zooms: Sequence[Zoom]) -> Panel:
    """One lane per message, lowest identifier (highest priority) on top: released to arrived."""
    lanes = sorted(record.messages.items(), key=lambda lane: -lane[1][0][0].frame.can_id)
    spans, roles = [], {"driver": "B", "controller": "estimate", "plant": "truth"}
    for lane, (_, entries) in enumerate(lanes):
        role = roles.get(entries[0][0].sender, "B")
        for entry, _ in entries:
            start, end = entry.released_ns / NS_PER_S * MS, entry.arrival_ns / NS_PER_S * MS
            if any(zoom.low <= end and start <= zoom.high for zoom in zooms):
                spans.append(Span(start, max(end, start + 0.1), role, "", lane - 0.32, lane + 0.32))
    ticks = [(float(lane), kind.__name__) for lane, (kind, _) in enumerate(lanes)]
    keys, limits = list(roles.items()), (-0.7, len(lanes) - 0.3)
    title = "Frames on the bus, from release to arrival"
    return Panel(title, spans=spans, ticks=ticks, keys=keys, height=160, limits=limits)


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
    lines = []
    for label, field, role, width in (
        ("asked for by the driver", "driver_torque", "faint", 1.0),
        ("engine", "torque", "truth", 2.0),
    ):
        times, values = record.series(Eec1, field)
        percent = np.array(values) * 100.0
        lines.append(Series(label, times * MS, percent, role, "stepped", width=width))
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
        lines.append(Series(label, times * MS, speed * (30.0 / np.pi), role, "stepped"))
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
