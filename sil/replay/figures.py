"""The figures of a replay: both sides over the time of the log, and the plant's position."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from can_dbc.messages import ShiftState
from sil.replay.excerpts import Excerpt, Row
from sil.replay.plant_side import Position
from sil.report.figure import MM, Figure, Floats, Panel, Rule, Series, Span, Stack, Zoom, spans_of

CHAMBERS = "BNF"
NS_PER_MS = 1e6
SIDES = ((0, "estimate", 2.6), (1, "alarm", 1.2))
"""Index, colour and line width of the recorded and of the replayed side."""

STATES = set(ShiftState.__members__)
GAP_MS = 1e-3
"""From the end of a piece to the point that interrupts its lines."""


def excerpts_figure(
    scenes: Sequence[Excerpt],
    labels: tuple[str, str],
    base_ns: int,
    positions: Sequence[Position] = (),
) -> Figure:
    """Return estimates, coils and states of both sides on one time axis, with a zoom per scene."""
    parts = without_repetition(scenes)
    pieces = [([(row.time_ns + base_ns) / NS_PER_MS for row in rows], rows) for rows in parts]
    pieces = [(times, rows) for times, rows in pieces if rows]
    estimates = _estimates(pieces, labels, base_ns, positions)
    panels = [estimates, _coils(pieces, labels), _states(pieces, labels)]
    zooms = []
    for scene in scenes:
        times = [(row.time_ns + base_ns) / NS_PER_MS for row in scene.rows]
        if len(times) > 1:
            name = f"{times[0] / 1e3:.3f} s{', differs' if scene.differs else ''}"
            zooms.append(Zoom(name, times[0], _end(times)))
    title = "the commands differ" if any(s.differs for s in scenes) else "the commands are equal"
    return Figure([Stack("time of the log, ms", panels, zooms=zooms, width=10.8)], title)


Piece = tuple[list[float], list[Row]]
"""Times in ms, and the rows at them, one after the other without a gap."""


def without_repetition(scenes: Sequence[Excerpt]) -> list[list[Row]]:
    """Return the rows of the scenes in ascending time, each row once, one list per scene."""
    found: list[list[Row]] = []
    last_ns: int | None = None
    for scene in sorted(scenes, key=lambda scene: scene.rows[0].time_ns):
        found.append([row for row in scene.rows if last_ns is None or row.time_ns > last_ns])
        last_ns = max(scene.rows[-1].time_ns, last_ns or 0)
    return found


def _end(times: Sequence[float]) -> float:
    """Return when the last tick of a piece ends, in ms."""
    return times[-1] + (times[1] - times[0] if len(times) > 1 else 10.0)


def _over(pieces: Sequence[Piece], value: Callable[[Row], float | None]) -> tuple[Floats, Floats]:
    """Return times in ms and values [n] each, held to the end of each piece, NaN between pieces."""
    times: list[float] = []
    values: list[float] = []
    for piece_times, rows in pieces:
        if times and piece_times[0] > times[-1] + GAP_MS:
            times.append(times[-1] + GAP_MS)
            values.append(np.nan)
        elif times:  # the piece follows without a gap
            del times[-1], values[-1]
        known = [np.nan if (v := value(row)) is None else v for row in rows]
        times += [*piece_times, _end(piece_times)]
        values += [*known, known[-1]]
    return np.array(times), np.array(values)


def _estimates(
    pieces: Sequence[Piece],
    labels: tuple[str, str],
    base_ns: int,
    positions: Sequence[Position],
) -> Panel:
    lines = []
    for side, role, width in SIDES:
        times, values = _over(pieces, lambda row, side=side: row.estimates_m[side])  # type: ignore[misc]
        label = f"estimate, {labels[side]}"
        lines.append(Series(label, times, MM * values, role, "stepped", width=width))
    ends = [(rows[0].time_ns, rows[-1].time_ns) for _, rows in pieces]
    near = [p for p in positions if any(a <= p.time_ns <= b for a, b in ends)]
    near_ms = np.array([(p.time_ns + base_ns) / NS_PER_MS for p in near])
    for label, position_m, dashed in (
        ("true position, recorded", [p.recorded_m for p in near], False),
        ("true position, plant replayed", [p.replayed_m for p in near], True),
    ):
        known = np.isfinite(position_m)
        if known.any():
            y = MM * np.array(position_m)[known]
            lines.append(Series(label, near_ms[known], y, "truth", dashed=dashed, width=1.2))
    return Panel("Position", "mm", lines, height=230)


def _coils(pieces: Sequence[Piece], labels: tuple[str, str]) -> Panel:
    """Coils energised: B on top, the replayed side (full) below the recorded one (pale)."""
    spans, ticks = [], []
    for lane, chamber in enumerate(reversed(CHAMBERS)):
        k = CHAMBERS.index(chamber)
        for side, low in ((1, lane + 0.08), (0, lane + 0.52)):
            ticks.append((low + 0.18, f"{chamber} {labels[side]}"))
            style = "solid" if side else "pale"
            for times, rows in pieces:
                on = [row.coils[side][k] for row in rows]
                spans += [
                    Span(a, b, chamber, "", low, low + 0.36, style)  # type: ignore[arg-type]
                    for a, b in spans_of(times, on, _end(times))
                ]
    rules = [Rule(float(lane), "", "grid", "y", "solid") for lane in range(3)]
    return Panel(
        "Coils energised", spans=spans, ticks=ticks, rules=rules, height=160, limits=(-0.02, 3.0)
    )


def _states(pieces: Sequence[Piece], labels: tuple[str, str]) -> Panel:
    spans = []
    for side, base in ((0, 1.0), (1, 0.0)):
        for times, rows in pieces:
            names = [row.states[side] for row in rows]
            for name in dict.fromkeys(names):
                role, text = name if name in STATES else "grid", name.lower()
                spans += [
                    Span(a, b, role, text, base + 0.06, base + 0.94)
                    for a, b in spans_of(times, [n == name for n in names], _end(times))
                ]
    ticks = [(1.5, f"state {labels[0]}"), (0.5, f"state {labels[1]}")]
    return Panel("Firmware state", spans=spans, ticks=ticks, height=76, limits=(0.0, 2.0))


def positions_figure(positions: Sequence[Position], base_ns: int) -> Figure:
    """Return the plant's recorded and replayed position, and their difference."""
    both = [p for p in positions if np.isfinite(p.recorded_m)]
    times = np.array([(p.time_ns + base_ns) / NS_PER_MS for p in both])
    recorded = MM * np.array([p.recorded_m for p in both])
    replayed = MM * np.array([p.replayed_m for p in both])
    lines = [
        Series("recorded", times, recorded, "truth", width=2.4),
        Series("plant replayed", times, replayed, "alarm", width=1.2),
    ]
    difference = [Series("replayed - recorded", times, replayed - recorded, "alarm", width=1.0)]
    panels = [
        Panel("Position of the plant", "mm", lines, height=230),
        Panel("Difference", "mm", difference, height=110),
    ]
    return Figure([Stack("time of the log, ms", panels, width=10.8)])
