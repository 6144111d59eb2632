"""shift.png: what was true, what the controller believed, what valves and bus did, on one time axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from can_dbc.messages import Chamber, ControllerStatus, SafetyBlow
from sil.metrics import Shift
from sil.report.theme import LIGHT, Theme
from sil.run_record import CHAMBERS, NS, Floats, RunRecord

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MM = 1e3
BAR = 1e-5
MS = 1e3
MOST_COLUMNS = 3
AFTERMATH_S = 0.025
"""What is shown after everything has settled."""


@dataclass(frozen=True)
class Window:
    """One column of the picture: a span of simulated time, and the shift in it if there is one."""

    start_s: float
    end_s: float
    shift: Shift | None


@dataclass(frozen=True)
class Drawing:
    """What all panels of a picture share."""

    record: RunRecord
    theme: Theme
    figure: Figure


def windows(record: RunRecord, shifts: Sequence[Shift]) -> list[Window]:
    """Return the spans worth a zoom: each shift from just before its request until it has settled.

    Without a shift it is the whole run.
    """
    end = float(record.truth["time_s"][-1])
    found = []
    for index, shift in enumerate(shifts[:MOST_COLUMNS]):
        until = shifts[index + 1].requested_s if index + 1 < len(shifts) else end
        settled = [shift.arrived_s, shift.confirmed_s, shift.requested_s + 0.1]
        settled += [
            e.time_s
            for e in record.events
            if e.name.endswith("_close") and shift.requested_s <= e.time_s <= until
        ]
        last = max(instant for instant in settled if instant is not None)
        found.append(
            Window(max(shift.requested_s - 0.02, 0.0), min(last + AFTERMATH_S, until), shift)
        )
    return found or [Window(0.0, end, None)]


def draw_shift(
    record: RunRecord,
    shifts: Sequence[Shift],
    title: str,
    subtitle: str,
    theme: Theme = LIGHT,
    dots_per_inch: int = 140,
) -> bytes:
    """Return the picture of a run as PNG bytes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = draw(record, shifts, title, subtitle, theme)
    FigureCanvasAgg(figure)
    image = BytesIO()
    figure.savefig(image, format="png", dpi=dots_per_inch, facecolor=theme.paper)
    return image.getvalue()


def draw(
    record: RunRecord, shifts: Sequence[Shift], title: str, subtitle: str, theme: Theme
) -> Figure:
    """Return the picture as a matplotlib figure: an overview, then one column of panels per shift."""
    from matplotlib.figure import Figure

    columns = windows(record, shifts)
    width = 9.0 + 4.5 * len(columns)
    figure = Figure(figsize=(width, 11.0), facecolor=theme.paper)
    drawing = Drawing(record, theme, figure)
    grid = figure.add_gridspec(
        6,
        len(columns),
        height_ratios=[0.85, 3.6, 1.9, 2.4, 0.42, 2.5],
        width_ratios=[max(w.end_s - w.start_s, 0.15) ** 0.6 for w in columns],
        left=1.45 / width,
        right=1.0 - 0.3 / width,
        top=0.925,
        bottom=0.05,
        hspace=0.1,
        wspace=0.045 * len(columns),
    )
    figure.text(0.15 / width, 0.982, title, fontsize=15, weight="bold", color=theme.ink, va="top")
    figure.text(0.15 / width, 0.957, subtitle, fontsize=9.5, color=theme.faint, va="top")
    note = "top: whole run, ms; shaded: enlarged below"
    figure.text(
        1.0 - 0.2 / width, 0.957, note, fontsize=8.5, color=theme.faint, va="top", ha="right"
    )
    _overview(drawing, figure.add_subplot(grid[0, :]), columns)
    for number, window in enumerate(columns):
        first: Axes | None = None
        for row, panel in enumerate((_position, _valves, _pressures, _states, _bus), start=1):
            axes = figure.add_subplot(grid[row, number], sharex=first)
            first = first or axes
            _style(axes, theme)
            panel(drawing, axes, window, number == 0, number == len(columns) - 1)
            axes.tick_params(labelbottom=row == 5, length=0)
            if number and row > 1:  # the same scale as in the first column
                axes.tick_params(labelleft=False)
        assert first is not None
        first.set_xlim(window.start_s * MS, window.end_s * MS)
        axes.set_xlabel("simulated time, ms", color=theme.ink, fontsize=9)
    return figure


def _style(axes: Axes, theme: Theme) -> None:
    axes.set_facecolor(theme.paper)
    axes.grid(True, color=theme.grid, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=theme.ink, labelsize=8.5)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(theme.grid)


def _overview(drawing: Drawing, axes: Axes, columns: Sequence[Window]) -> None:
    theme, record = drawing.theme, drawing.record
    _style(axes, theme)
    time = record.truth["time_s"]
    axes.plot(time * MS, record.truth["position_m"] * MM, color=theme.truth, linewidth=1.2)
    for window in columns:
        axes.axvspan(window.start_s * MS, window.end_s * MS, color=theme.band, zorder=0)
    stroke = record.stroke_m * MM
    axes.set_yticks([-stroke, 0.0, stroke], ["forward", "neutral", "backward"])
    axes.set_ylim(-1.25 * stroke, 1.25 * stroke)
    axes.set_xlim(0.0, float(time[-1]) * MS)
    axes.tick_params(labeltop=True, labelbottom=False, length=0)


def _inside(window: Window, times: Floats, margin_s: float = 0.02) -> Any:
    return (times >= window.start_s - margin_s) & (times <= window.end_s + margin_s)


def _position(
    drawing: Drawing, axes: Axes, window: Window, is_first: bool, is_last: bool
) -> None:
    theme, record = drawing.theme, drawing.record
    shift = window.shift
    time = record.truth["time_s"]
    seen = _inside(window, time)
    t, x = time[seen] * MS, record.truth["position_m"][seen] * MM
    when, believed = record.believed
    stroke = record.stroke_m * MM
    ends = [float(x[0]), float(x[-1])]
    inside = _inside(window, when, 0.0)
    shown = np.concatenate([x, np.clip(believed[inside] * MM, -1.6 * stroke, 1.6 * stroke)])
    low, high = float(shown.min()) - 1.8, float(shown.max()) + 1.8
    if shift is not None:
        _instant(axes, theme, shift.requested_s, f"{shift.to_gear} requested")
        if shift.confirmed_s is not None:
            _instant(axes, theme, shift.confirmed_s, f"{shift.to_gear} confirmed")
        _plateau(drawing, axes, window)
    for name, line in _pistons(record, window):
        axes.plot(t, line[seen] * MM, color=theme.faint, linewidth=1.0, linestyle=(0, (4, 2)))
        _label_on_line(axes, theme, t, line[seen] * MM, name, theme.faint, low, high)
    axes.plot(t, x, color=theme.truth, linewidth=2.2, zorder=4)
    axes.step(
        when * MS, believed * MM, where="post", color=theme.believed, linewidth=1.8, zorder=5
    )
    axes.plot(
        when[inside] * MS, believed[inside] * MM, ".", color=theme.believed, markersize=5, zorder=5
    )
    axes.set_ylim(low, high)
    stops = [s for s in (-stroke, 0.0, stroke) if low < s < high]
    for stop in stops:
        axes.axhline(stop, color=theme.grid, linewidth=1.4, zorder=1)
    if shift is not None:
        _lag_arrows(drawing, axes, window, x, shift)
    if is_first:
        axes.set_ylabel("position, mm", color=theme.ink, fontsize=9)
        axes.legend(
            handles=_legend_lines(theme),
            loc="upper right" if ends[-1] < ends[0] else "lower right",
            bbox_to_anchor=(0.02, 0.02, 0.96, 0.96),
            fontsize=8.5,
            frameon=True,
            facecolor=theme.paper,
            edgecolor=theme.grid,
            labelcolor=theme.ink,
        ).set_zorder(9)


def _instant(axes: Axes, theme: Theme, at_s: float, text: str) -> None:
    axes.axvline(at_s * MS, color=theme.faint, linewidth=0.9, linestyle=":")
    axes.annotate(
        text,
        (at_s * MS, 0.5),
        xycoords=("data", "axes fraction"),
        xytext=(-2, 0),
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=8,
        color=theme.faint,
        rotation=90,
        annotation_clip=True,
    )


def _plateau(drawing: Drawing, axes: Axes, window: Window) -> None:
    """Say where the synchronizer holds the stay."""
    begun: float | None = None
    for event in drawing.record.events:
        if not window.start_s <= event.time_s <= window.end_s:
            continue
        if event.name == "sync_block":
            begun = event.time_s
        elif event.name in ("sync_unblock", "breakaway") and begun is not None:
            where = float(event.values["position_m"]) * MM
            text = f"synchronizer holds {(event.time_s - begun) * MS:.0f} ms"
            axes.annotate(
                text, (0.5 * (begun + event.time_s) * MS, where), xytext=(0, -4),
                textcoords="offset points", ha="center", va="top", fontsize=8,
                color=drawing.theme.ink, path_effects=_outline(drawing.theme), zorder=6,
            )
            begun = None


def _outline(theme: Theme) -> list[Any]:
    """Return text effects that keep letters readable on top of lines."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=2.5, foreground=theme.paper)]


def _legend_lines(theme: Theme) -> list[Any]:
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], color=theme.truth, linewidth=2.2, label="true position of the stay"),
        Line2D(
            [], [], color=theme.believed, linewidth=1.8, marker=".", label="what the controller believes"
        ),
        Line2D(
            [], [], color=theme.faint, linewidth=1.0, linestyle=(0, (4, 2)),
            label="moving piston, where it would touch the stay",
        ),
    ]


def _pistons(record: RunRecord, window: Window) -> list[tuple[str, Floats]]:
    """Return the piston that carries this shift, drawn where its driving contact meets the stay.

    Out of neutral it pushes on the collar, so its free travel is taken off; towards neutral it
    pulls on the nut. Piston 2 is the mirror image.
    """
    shift = window.shift
    if shift is None:
        return []
    away = shift.to_gear != "neutral"
    side = shift.to_gear if away else shift.from_gear
    free = record.free_travel_m if away else 0.0
    if side == "backward":
        return [("piston 1", record.truth["piston_1_m"] - free)]
    if side == "forward":
        return [("piston 2", -(record.truth["piston_2_m"] - free))]
    return []


def _label_on_line(
    axes: Axes, theme: Theme, t: Floats, y: Floats, text: str, color: str, low: float, high: float
) -> None:
    moving = np.flatnonzero((y > low + 0.3) & (y < high - 0.3) & (np.abs(np.gradient(y)) > 1e-3))
    if len(moving) == 0:
        return
    i = int(moving[0])
    axes.annotate(
        text, (float(t[i]), float(y[i])), xytext=(-5, -2), textcoords="offset points",
        ha="right", va="center", fontsize=8, color=color,
    )


def _lag_arrows(
    drawing: Drawing, axes: Axes, window: Window, x: Floats, shift: Shift
) -> None:
    """Mark how late the believed position is at 10 % and 90 % of travel, and the impact."""
    theme, record = drawing.theme, drawing.record
    if shift.arrived_s is None:
        return
    time, position = record.truth["time_s"], record.truth["position_m"]
    start = float(np.interp(shift.requested_s, time, position))
    goal = float(np.interp(shift.arrived_s, time, position))
    for share, lag, mean in (
        (0.1, shift.position_lag_10_held_s, shift.position_lag_10_s),
        (0.9, shift.position_lag_90_held_s, shift.position_lag_90_s),
    ):
        if lag is None or mean is None:
            continue
        level = start + share * (goal - start)
        after = (time >= shift.requested_s) & (time <= shift.arrived_s + 1e-3)
        beyond = after & ((position >= level) if goal > start else (position <= level))
        if not beyond.any():
            continue
        true_at = float(time[int(np.argmax(beyond))]) * MS
        axes.annotate(
            "",
            (true_at + lag * MS, level * MM),
            (true_at, level * MM),
            arrowprops={"arrowstyle": "<->", "color": theme.alarm, "lw": 1.5, "shrinkA": 0, "shrinkB": 0},
            zorder=7,
        )
        axes.annotate(
            f"{lag * MS:.0f} ms late",
            (true_at + 0.5 * lag * MS, level * MM),
            xytext=(0, -3),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=9,
            weight="bold",
            color=theme.alarm,
            zorder=7,
            path_effects=_outline(theme),
        )
    if shift.impact_speed_m_s is not None and shift.impact_energy_j is not None:
        rising = goal > start
        axes.annotate(
            f"stop: {shift.impact_speed_m_s:.2f} m/s, {shift.impact_energy_j:.1f} J",
            (shift.arrived_s * MS, goal * MM),
            xytext=(0, 7 if rising else -7),
            textcoords="offset points",
            ha="center",
            va="bottom" if rising else "top",
            fontsize=8.5,
            color=theme.ink,
            zorder=8,
        )


def _spans(times: Floats, on: Any, end: float) -> list[tuple[float, float]]:
    """Return the (start, length) of each run of True in a held boolean series."""
    spans = []
    begun: float | None = None
    for at, is_on in zip(times, on, strict=True):
        if is_on and begun is None:
            begun = float(at)
        elif not is_on and begun is not None:
            spans.append((begun, float(at) - begun))
            begun = None
    if begun is not None:
        spans.append((begun, end - begun))
    return spans


Span = tuple[float, float]


def valve_spans(record: RunRecord, chamber: str) -> tuple[list[Span], list[Span], list[Span]]:
    """Return (start, length) in s of a coil energised, a safety blow under way, a valve open.

    The coil is what commands and blows amount to at the valve driver, timeouts included.
    """
    end = float(record.truth["time_s"][-1])
    times, active = record.series(SafetyBlow, "active")
    _, chambers = record.series(SafetyBlow, "chamber")
    blowing = [a and c == Chamber[chamber] for a, c in zip(active, chambers, strict=True)]
    coil = _event_spans(record, f"coil_{chamber}_", ("on", "off"), False, end)
    is_open = bool(record.truth[f"valve_{chamber}"][0] > 0.5)
    valve = _event_spans(record, f"valve_{chamber}_", ("open", "close"), is_open, end)
    return coil, _overlap(_spans(times, blowing, end), coil), valve


def _event_spans(
    record: RunRecord, prefix: str, names: tuple[str, str], at_start: bool, end: float
) -> list[Span]:
    """Return the spans between a pair of plant events that switch something on and off."""
    moves = [(e.time_s, e.name) for e in record.events if e.name.startswith(prefix)]
    times = np.array([0.0, *(t for t, _ in moves)])
    return _spans(times, [at_start, *(n == prefix + names[0] for _, n in moves)], end)


def _overlap(spans: list[Span], others: list[Span]) -> list[Span]:
    """Return the parts of spans that lie within other spans."""
    pairs = [
        (max(a, c), min(a + b, c + d)) for a, b in spans for c, d in others if a < c + d and c < a + b
    ]
    return [(start, stop - start) for start, stop in pairs]


def _valves(drawing: Drawing, axes: Axes, window: Window, is_first: bool, is_last: bool) -> None:
    theme, record = drawing.theme, drawing.record
    ticks, names = [], []
    for lane, chamber in enumerate(reversed(CHAMBERS)):
        color = theme.chamber[chamber]
        commanded, blowing, actual = valve_spans(record, chamber)
        base = lane * 1.0
        for spans, offset, alpha in ((actual, 0.08, 1.0), (commanded, 0.52, 0.35)):
            axes.broken_barh(
                [(a * MS, b * MS) for a, b in spans],
                (base + offset, 0.36),
                facecolors=color,
                alpha=alpha,
                linewidth=0,
            )
            ticks.append(base + offset + 0.18)
        axes.broken_barh(
            [(a * MS, b * MS) for a, b in blowing],
            (base + 0.52, 0.36),
            facecolors="none",
            edgecolors=color,
            hatch="////",
            linewidth=0,
        )
        for start, length in blowing:
            if window.start_s <= start <= window.end_s:
                axes.text(
                    (start + 0.5 * length) * MS, base + 0.70, "safety blow", ha="center",
                    va="center", fontsize=8, color=theme.ink, clip_on=True,
                    bbox={"facecolor": theme.paper, "edgecolor": "none", "pad": 0.8, "alpha": 0.8},
                )
        names += [f"{chamber} valve", f"{chamber} command"]
        _delays(axes, theme, window, commanded, actual, base, color)
        axes.axhline(base, color=theme.grid, linewidth=0.8)
    axes.set_yticks(ticks, names)
    axes.set_ylim(-0.02, 3.0)
    axes.grid(False, axis="y")


def _delays(
    axes: Axes,
    theme: Theme,
    window: Window,
    commanded: list[tuple[float, float]],
    actual: list[tuple[float, float]],
    base: float,
    color: str,
) -> None:
    """Write the opening and closing delay beside each pair of bars."""
    for opened, length in actual:
        closed = opened + length
        before = [a for a, n in commanded if a <= opened <= a + n]
        after = [a + n for a, n in commanded if opened < a + n <= closed]
        for causes, reacted, side in ((before, opened, "left"), (after, closed, "right")):
            if not causes or not window.start_s <= reacted <= window.end_s:
                continue
            wanted = causes[-1]
            axes.plot(
                [wanted * MS, wanted * MS, reacted * MS, reacted * MS],
                [base + 0.52, base + 0.48, base + 0.48, base + 0.44],
                color=theme.ink,
                linewidth=1.0,
            )
            axes.annotate(
                f"{(reacted - wanted) * MS:.0f} ms",
                (reacted * MS, base + 0.25),
                xytext=(4 if side == "left" else -4, 0),
                textcoords="offset points",
                fontsize=8.5,
                ha=side,
                va="center",
                color=theme.ink,
                path_effects=_outline(theme),
                clip_on=True,
            )


def _pressures(
    drawing: Drawing, axes: Axes, window: Window, is_first: bool, is_last: bool
) -> None:
    theme, record = drawing.theme, drawing.record
    time = record.truth["time_s"]
    seen = _inside(window, time)
    t = time[seen] * MS
    supply = record.supply_pressure_pa * BAR
    axes.axhline(supply, color=theme.faint, linewidth=0.9, linestyle="--")
    axes.annotate(
        "supply", (0.005, supply), xycoords=("axes fraction", "data"), xytext=(0, -3),
        textcoords="offset points", va="top", fontsize=8, color=theme.faint,
    )
    peaks = {}
    for chamber in CHAMBERS:
        pressure = record.truth[f"pressure_{chamber}_pa"][seen] * BAR
        axes.plot(t, pressure, color=theme.chamber[chamber], linewidth=1.8)
        peaks[chamber] = pressure
    top = supply * 1.12
    axes.set_ylim(0.0, top)
    for chamber, (x, y) in _label_places(window, t, peaks, top).items():
        axes.annotate(
            chamber, (x, y), ha="center", va="center", fontsize=9, weight="bold",
            color=theme.chamber[chamber],
            bbox={"facecolor": theme.paper, "edgecolor": "none", "pad": 0.8},
        )
    if is_first:
        axes.set_ylabel("pressure, bar abs", color=theme.ink, fontsize=9)


def _label_places(
    window: Window, t: Floats, lines: dict[str, Floats], top: float
) -> dict[str, tuple[float, float]]:
    """Return a place on each line where it is furthest from the others."""
    places: dict[str, tuple[float, float]] = {}
    usable = (t > (window.start_s + 0.04 * (window.end_s - window.start_s)) * MS) & (
        t < (window.end_s - 0.04 * (window.end_s - window.start_s)) * MS
    )
    if not usable.any():
        return places
    for order, (name, line) in enumerate(lines.items()):
        others = [np.abs(line - other) for key, other in lines.items() if key != name]
        gap = np.minimum(np.minimum.reduce(others), 0.25 * top)
        # Lines that lie on one another get their letters side by side.
        gap = gap + 1e-3 * top * np.cos((t - t[0]) / (t[-1] - t[0] + 1e-9) * 6.0 + 2.0 * order)
        i = int(np.argmax(np.where(usable, gap, -1.0)))
        places[name] = (float(t[i]), float(line[i]))
    return places


def _states(drawing: Drawing, axes: Axes, window: Window, is_first: bool, is_last: bool) -> None:
    theme, record = drawing.theme, drawing.record
    times, states = record.series(ControllerStatus, "state")
    axes.set_yticks([0.5], ["firmware state"])
    axes.set_ylim(0.0, 1.0)
    axes.grid(False)
    end = float(record.truth["time_s"][-1])
    span = window.end_s - window.start_s
    for since, until, name in state_spans(times, [state.name for state in states], end):
        color = theme.state.get(name, theme.paper)
        axes.axvspan(
            since * MS,
            until * MS,
            facecolor=color,
            edgecolor=theme.faint,
            linewidth=0,
            hatch=None if name in theme.state else "////",
        )
        left, right = max(since, window.start_s), min(until, window.end_s)
        for size in (8.5, 6.5):
            if right - left > 0.00135 * size * len(name) * span:
                axes.text(
                    0.5 * (left + right) * MS, 0.46, name.lower(), ha="center", va="center",
                    fontsize=size, color=theme.ink, path_effects=_outline(theme)
                    if name not in theme.state
                    else [],
                )
                break


SILENT = "SILENT"


def state_spans(times: Floats, names: Sequence[str], end: float) -> list[tuple[float, float, str]]:
    """Return (start, end, state) of each state as reported; SILENT where three reports are missing."""
    if len(times) == 0:
        return [(0.0, end, SILENT)]
    step = float(np.median(np.diff(times))) if len(times) > 1 else end
    spans: list[tuple[float, float, str]] = []
    for i, name in enumerate(names):
        since = float(times[i])
        until = float(times[i + 1]) if i + 1 < len(times) else end
        heard = until if until - since < 3.5 * step else since + step
        if spans and spans[-1][2] == name and spans[-1][1] == since:
            spans[-1] = (spans[-1][0], heard, name)
        else:
            spans.append((since, heard, name))
        if heard < until:
            spans.append((heard, until, SILENT))
    return spans


def _bus(drawing: Drawing, axes: Axes, window: Window, is_first: bool, is_last: bool) -> None:
    """One lane per message, lowest identifier (highest priority) on top: queued to arrived."""
    theme, record = drawing.theme, drawing.record
    lanes = sorted(
        ((entries[0][0].frame.can_id, kind, entries) for kind, entries in record.messages.items()),
        key=lambda lane: -lane[0],
    )
    sender_color = {"controller": theme.believed, "plant": theme.truth}
    names = []
    for lane, (_, kind, entries) in enumerate(lanes):
        names.append(kind.__name__)
        seen = [
            (e.released_ns / NS * MS, e.arrival_ns / NS * MS)
            for e, _ in entries
            if window.start_s - 0.01 <= e.arrival_ns / NS <= window.end_s + 0.01
        ]
        if not seen:
            continue
        color = sender_color.get(entries[0][0].sender, theme.chamber["B"])
        axes.broken_barh(
            [(a, max(b - a, 0.1)) for a, b in seen], (lane - 0.32, 0.64), facecolors=color,
            edgecolors=color, linewidth=0.7,
        )
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", labelsize=7.5)
    axes.set_ylim(-0.7, len(names) - 0.3)
    if is_first:
        handles = [
            ("driver", theme.chamber["B"]),
            ("controller", theme.believed),
            ("plant", theme.truth),
        ]
        for i, (name, color) in enumerate(handles):
            axes.annotate(
                f"■ {name}", (0.004 + 0.0, 1.0), xycoords="axes fraction",
                xytext=(62 * i, 2), textcoords="offset points", fontsize=7.5, color=color,
            )
