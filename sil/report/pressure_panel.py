"""The pressure panel: the three chambers against the supply."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sil.recording.run_record import CHAMBERS, Floats
from sil.report.drawing import BAR, MS, Drawing, Window, inside

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_pressures(drawing: Drawing, axes: Axes, window: Window, is_first: bool) -> None:
    """Draw the three chambers' pressures against the supply."""
    theme, record = drawing.theme, drawing.record
    time = record.truth["time_s"]
    seen = inside(window, time)
    t = time[seen] * MS
    supply = record.supply_pressure_pa * BAR
    axes.axhline(supply, color=theme.faint, linewidth=0.9, linestyle="--")
    axes.annotate(
        "supply",
        (0.005, supply),
        xycoords=("axes fraction", "data"),
        xytext=(0, -3),
        textcoords="offset points",
        va="top",
        fontsize=8,
        color=theme.faint,
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
            chamber,
            (x, y),
            ha="center",
            va="center",
            fontsize=9,
            weight="bold",
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
