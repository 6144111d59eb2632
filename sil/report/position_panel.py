"""The position panel: truth, moving piston, and what the controller believed how late."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sil.recording.run_record import Floats, RunRecord
from sil.report.drawing import MM, MS, Drawing, Window, inside, outline
from sil.report.theme import Theme
from sil.simulation.metrics import Shift

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_position(drawing: Drawing, axes: Axes, window: Window, is_first: bool) -> None:
    """Draw truth, belief and moving piston, and mark how late the belief is."""
    theme, record = drawing.theme, drawing.record
    shift = window.shift
    time = record.truth["time_s"]
    seen = inside(window, time)
    t, x = time[seen] * MS, record.truth["position_m"][seen] * MM
    when, believed = record.believed
    stroke = record.stroke_m * MM
    ends = [float(x[0]), float(x[-1])]
    within = inside(window, when, 0.0)
    shown = np.concatenate([x, np.clip(believed[within] * MM, -1.6 * stroke, 1.6 * stroke)])
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
    axes.step(when * MS, believed * MM, where="post", color=theme.believed, linewidth=1.8, zorder=5)
    axes.plot(
        when[within] * MS, believed[within] * MM, ".", color=theme.believed, markersize=5, zorder=5
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
                text,
                (0.5 * (begun + event.time_s) * MS, where),
                xytext=(0, -4),
                textcoords="offset points",
                ha="center",
                va="top",
                fontsize=8,
                color=drawing.theme.ink,
                path_effects=outline(drawing.theme),
                zorder=6,
            )
            begun = None


def _legend_lines(theme: Theme) -> list[Any]:
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], color=theme.truth, linewidth=2.2, label="true position of the stay"),
        Line2D(
            [],
            [],
            color=theme.believed,
            linewidth=1.8,
            marker=".",
            label="what the controller believes",
        ),
        Line2D(
            [],
            [],
            color=theme.faint,
            linewidth=1.0,
            linestyle=(0, (4, 2)),
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
        text,
        (float(t[i]), float(y[i])),
        xytext=(-5, -2),
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=8,
        color=color,
    )


def _lag_arrows(drawing: Drawing, axes: Axes, window: Window, x: Floats, shift: Shift) -> None:
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
            arrowprops={
                "arrowstyle": "<->",
                "color": theme.alarm,
                "lw": 1.5,
                "shrinkA": 0,
                "shrinkB": 0,
            },
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
            path_effects=outline(theme),
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
