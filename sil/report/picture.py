"""shift.png: truth, belief, valves, pressures and bus of a run on one time axis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from sil.recording.run_record import RunRecord
from sil.report.bus_panel import draw_bus, draw_states
from sil.report.drawing import MM, MS, Drawing, Window
from sil.report.position_panel import draw_position
from sil.report.pressure_panel import draw_pressures
from sil.report.theme import Theme
from sil.report.valve_panel import draw_valves
from sil.simulation.metrics import Shift

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_COLUMNS = 3
AFTERMATH_S = 0.025
"""What is shown after everything has settled."""


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


def draw(
    record: RunRecord, shifts: Sequence[Shift], title: str, subtitle: str, theme: Theme
) -> Figure:
    """Return the picture as a figure: an overview, then one column of panels per shift."""
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
        for row, panel in enumerate(
            (draw_position, draw_valves, draw_pressures, draw_states, draw_bus), start=1
        ):
            axes = figure.add_subplot(grid[row, number], sharex=first)
            first = first or axes
            _style(axes, theme)
            panel(drawing, axes, window, number == 0)
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
