"""The figures of a replay, of a truck's shifts beside ours, and of a summary of shifts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from can_dbc.messages import ShiftState
from sil.j1939.summary import J1939Summary
from sil.log_replay.excerpts import Excerpt, Row
from sil.log_replay.plant_side import Position
from sil.log_replay.truck_loop import OurShift
from sil.log_replay.truck_replay import ComparedShift, TruckReplay, side_figures, truck_verdict
from sil.log_replay.truck_shift import PHASES
from sil.report.figure import MM, Figure, Panel, Rule, Series, Span, Stack, spans_of
from sil.shifts.cutter import Shift


def scene_figure(
    scene: Excerpt,
    labels: tuple[str, str],
    base_ns: int,
    positions: Sequence[Position] = (),
    marks: Callable[[Panel], Panel] = lambda panel: panel,
) -> Figure:
    """Return estimates, coils and states of both sides over the ticks of a scene.

    marks: adds the faults to a panel.
    """
    times = [(row.time_ns + base_ns) / 1e6 for row in scene.rows]
    times.append(
        times[-1] + (times[-1] - times[-2] if len(times) > 1 else 10.0)
    )  # the last tick's end
    panels = [
        _estimates(scene.rows, times, labels, base_ns, positions),
        _coils(scene.rows, times, labels),
        _states(scene.rows, times, labels),
    ]
    title = "the commands differ" if scene.differs else "the commands are equal"
    limits = (times[0], times[-1])
    axis = "time of the log, ms"
    return Figure([Stack(axis, [marks(p) for p in panels], limits=limits, width=10.8)], title)


def _estimates(
    rows: Sequence[Row],
    times: list[float],
    labels: tuple[str, str],
    base_ns: int,
    positions: Sequence[Position],
) -> Panel:
    lines = []
    for side, role, width in ((0, "estimate", 2.6), (1, "alarm", 1.2)):
        estimates_m = [row.estimates_m[side] for row in [*rows, rows[-1]]]
        values = np.array([np.nan if x is None else MM * x for x in estimates_m])
        label = f"estimate, {labels[side]}"
        lines.append(Series(label, np.array(times), values, role, "stepped", width=width))
    near = [p for p in positions if rows[0].time_ns <= p.time_ns <= rows[-1].time_ns]
    near_ms = np.array([(p.time_ns + base_ns) / 1e6 for p in near])
    for label, position_m, dashed in (
        ("true position, recorded", [p.recorded_m for p in near], False),
        ("true position, plant replayed", [p.replayed_m for p in near], True),
    ):
        recorded = np.isfinite(position_m)
        if recorded.any():
            y = MM * np.array(position_m)[recorded]
            lines.append(Series(label, near_ms[recorded], y, "truth", dashed=dashed, width=1.2))
    return Panel("Position", "mm", lines, height=230)


def _coils(rows: Sequence[Row], times: list[float], labels: tuple[str, str]) -> Panel:
    """Coils energised: B on top, the replayed side (full) below the recorded one (pale)."""
    spans, ticks = [], []
    for lane, chamber in enumerate("FNB"):
        for side, low in ((1, lane + 0.08), (0, lane + 0.52)):
            ticks.append((low + 0.18, f"{chamber} {labels[side]}"))
            style = "solid" if side else "pale"
            on = [row.coils[side][2 - lane] for row in rows]
            spans += [
                Span(a, b, chamber, "", low, low + 0.36, style)  # type: ignore[arg-type]
                for a, b in spans_of(times[:-1], on, times[-1])
            ]
    rules = [Rule(float(lane), "", "grid", "y", "solid") for lane in range(3)]
    return Panel(
        "Coils energised", spans=spans, ticks=ticks, rules=rules, height=160, limits=(-0.02, 3.0)
    )


def _states(rows: Sequence[Row], times: list[float], labels: tuple[str, str]) -> Panel:
    spans = []
    for side, base in ((0, 1.0), (1, 0.0)):
        names = [row.states[side] for row in rows]
        for name in dict.fromkeys(names):
            role, text = name if name in ShiftState.__members__ else "grid", name.lower()
            spans += [
                Span(a, b, role, text, base + 0.06, base + 0.94)
                for a, b in spans_of(times[:-1], [n == name for n in names], times[-1])
            ]
    ticks = [(1.5, f"state {labels[0]}"), (0.5, f"state {labels[1]}")]
    return Panel("Firmware state", spans=spans, ticks=ticks, height=76, limits=(0.0, 2.0))


ROLES = ("truth", "after", "before")
"""Colours of the recorded side, of ours, and of ours as changed."""

PHASE_ROLES = dict(zip(PHASES, ("INIT", "N", "HOLD", "B", "CONFIRM"), strict=True))


def all_shifts_figure(replay: TruckReplay) -> Figure:
    """Return the time to the new gear of every shift, by column."""
    series = []
    for column, name in enumerate(replay.columns):
        times = {
            shift.number: side_figures(shift, column)["request to new gear"]
            for shift in replay.shifts
            if not shift.skipped
        }
        known = np.array([(n, t) for n, t in times.items() if t is not None], dtype=np.float64)
        if len(known):
            numbers, times_s = known.T
            series.append(Series(name, numbers, times_s, ROLES[column], "dots", width=4.0))
    spans = [Span(s.number - 0.4, s.number + 0.4, "grid") for s in replay.shifts if not s.counts]
    panel = Panel("Request to new gear", "s", series, spans=spans, height=260)
    ticks = [(shift.number, shift.title) for shift in replay.shifts]
    few = ticks if len(ticks) <= 24 else ()
    return Figure([Stack("shift", [panel], ticks=few, width=10.0)], "All shifts of the log")


def shift_figure(replay: TruckReplay, shift: ComparedShift) -> Figure:
    """Return speeds, torque, position and phases of a shift, recorded and ours."""
    recorded = shift.recorded
    names = replay.columns
    end_s = max([recorded.end_s, *(o.times_s["engaged"] or 0.0 for o in shift.ours)]) + 0.4
    cut = recorded.times_s["torque_cut"]
    instants = [(0.0, "request")] + ([] if cut is None else [(cut, "torque cut: our request")])
    if cut is not None and abs(cut) < 0.03:
        instants = [(0.0, "request, torque cut: our request")]
    rules = [Rule(at) for at, _ in instants]
    panels = []
    if (sync := recorded.synchronisation) is not None:
        speeds = [Series(names[0], sync.time_s, sync.difference_rad_s, ROLES[0], width=2.4)]
        for k, ours in enumerate(shift.ours, start=1):
            speeds.append(Series(names[k], ours.time_s, _referred(ours), ROLES[k]))
        named = [Rule(at, name) for at, name in instants]
        panels.append(Panel("Speed difference at the synchronizer", "rad/s", speeds, rules=named))
    torque = recorded.signals["engine_torque_share"]
    if torque is not None:
        line = Series("engine torque", torque.time_s, 100.0 * torque.values, ROLES[0], "stepped")
        panels.append(Panel("Engine torque, recorded", "%", [line], rules=rules, height=110))
    stays = [
        Series(names[k], ours.time_s, MM * ours.position_m, ROLES[k])
        for k, ours in enumerate(shift.ours, start=1)
    ]
    if stays:
        panels.append(Panel("Our stay", "mm", stays, rules=rules, height=130))
    sides = [recorded.times_s, *(ours.times_s for ours in shift.ours)]
    spans = [
        span for k, times in enumerate(sides) for span in _phase_spans(times, len(sides) - 1 - k)
    ]
    ticks = [(len(sides) - 0.5 - k, name) for k, name in enumerate(names[: len(sides)])]
    keys = [(f"to {PHASES[phase]}", PHASE_ROLES[phase]) for phase in PHASES]
    limits = (0.0, float(len(sides)))
    panels.append(
        Panel("Phases", spans=spans, ticks=ticks, keys=keys, height=40 * len(sides), limits=limits)
    )
    stack = Stack("time after the request, s", panels, limits=(-0.4, end_s), width=10.0)
    return Figure([stack], f"Shift {shift.title}", truck_verdict(shift)[0])


def _referred(ours: OurShift) -> np.ndarray:
    """Return our difference [n], in rad/s, NaN before the gear is left: it refers to the next gear."""
    left = ours.times_s["disengaged"]
    if left is None:
        return ours.difference_rad_s
    return np.where(ours.time_s > left + 0.01, ours.difference_rad_s, np.nan)


def _phase_spans(times_s: dict[str, float | None], lane: int) -> list[Span]:
    """Return a rectangle per phase that is known, from the instant before it that is known."""
    spans, begin = [], 0.0
    for phase in PHASES:
        at = times_s[phase]
        if at is not None and at >= begin:
            spans.append(Span(begin, at, PHASE_ROLES[phase], "", lane + 0.1, lane + 0.9))
            begin = at
    return spans


def _ms(summary: J1939Summary, time_ns: Any) -> Any:
    """Return times in ms from the log's first frame."""
    return (time_ns - (summary.first_ns or 0)) / 1e6


def shift_times_figure(summary: J1939Summary) -> Figure:
    """Return the time of each shift over the time of the log."""
    x = np.array([_ms(summary, shift.start_ns) / 1e3 for shift in summary.shifts])
    y = np.array([shift.duration_s for shift in summary.shifts])
    panel = Panel("Shift time", "s", [Series("shift time", x, y, "after", "dots")], height=150)
    return Figure([Stack("time of the log, s", [panel], width=10.8)])


def engine_figure(summary: J1939Summary, shift: Shift) -> Figure | None:
    """Return torque and speed of the engine from a second before a shift to one after it, None without any."""
    begin_ms, end_ms = _ms(summary, shift.start_ns), _ms(summary, shift.end_ns)
    if (engine := summary.engines.get(shift.channel)) is None:
        return None
    times = _ms(summary, np.array(engine.time_ns))
    near = slice(*np.searchsorted(times, (begin_ms - 1000.0, end_ms + 1000.0)))
    panels = []
    for title, unit, values, role in (
        ("Engine torque (actual)", "%", engine.torque_percent[near], "after"),
        ("Engine speed", "rpm", engine.speed_rpm[near], "truth"),
    ):
        line = Series(title.lower(), times[near], np.array(values, dtype=np.float64), role)
        panels.append(
            Panel(title, unit, [line], spans=[Span(begin_ms, end_ms, "band")], height=190)
        )
    figure = Figure([Stack("time of the log, ms", panels, width=10.8)], shift.gears)
    return figure if len(times[near]) else None
