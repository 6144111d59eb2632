"""The page's backend: a figure as interactive plots by uPlot (MIT licence), without a network.

The page carries library and numbers. Checked by: tests/unit/sil/report/test_plots.py, tests/browser/
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from sil.report.figure import Figure, Floats, Panel, Series, Stack

MOST_POINTS = 8000  # a longer record is thinned to this many points; the trace has them all

DIGITS = 6


@dataclass(frozen=True)
class PlotGroup:
    """The plots of one stack for `plots.html`; repeated: a picture shows the same, paper does without."""

    title: str
    numbers: str
    thinned: str
    repeated: bool


def plots(figure: Figure, *, repeated: bool = True) -> list[PlotGroup]:
    """Return the plots of a figure, a group for each stack."""
    groups = []
    for stack in figure.stacks:
        plot = content(stack)
        stride = plot.pop("stride")
        text = json.dumps(plot, separators=(",", ":"), ensure_ascii=True)
        text = text.replace("<", "\\u003c")  # inside a script element, "<" could end it
        thinned = f"one point in {stride}" if stride > 1 else ""
        groups.append(PlotGroup(stack.title, text, thinned, repeated))
    return groups


def content(stack: Stack) -> dict[str, Any]:
    """Return what plots.js draws of a stack; `stride`: it has one point in so many."""
    xs = [series.x for panel in stack.panels for series in panel.series]
    ends = stack.ends()
    x = np.unique(np.concatenate(xs)) if xs else np.array(ends)
    x = x[(x >= ends[0]) & (x <= ends[1])]
    stride = max(1, -(-len(x) // MOST_POINTS))
    x = x[::stride]
    return {
        "axis": stack.axis,
        "log": stack.logarithmic,
        "ticks": [list(tick) for tick in stack.ticks],
        "ends": ends,
        "x": rounded(x, DIGITS + 2),
        "zooms": [[zoom.name, zoom.low, zoom.high] for zoom in stack.zooms],
        "panels": [_panel(panel, x) for panel in stack.panels],
        "stride": stride,
    }


def _panel(panel: Panel, x: Floats) -> dict[str, Any]:
    scale, look = panel.scale, attrgetter("role", "label", "style")
    return {
        "title": panel.title,
        "unit": panel.unit,
        "height": panel.height,
        "ticks": [list(tick) for tick in panel.ticks],
        "limits": panel.limits,
        "include": rounded(panel.fixed_heights()),
        "keys": [list(key) for key in panel.keys],
        "scale": scale and [scale.label, scale.low, scale.high, list(scale.colours)],
        "series": [
            {k: v for k, v in vars(s).items() if k != "x"} | {"y": rounded(on_axis(s, x))}
            for s in panel.series
        ],
        "bands": [[rounded(b.x), rounded(b.low), rounded(b.high), b.role] for b in panel.bands],
        "spans": [
            [*rounded((s.start, s.end), DIGITS + 2), *rounded((s.low, s.high)), *look(s)]
            for s in panel.spans
        ],
        "rules": [[r.at, r.text, r.role, r.axis, r.style] for r in panel.rules],
        "notes": [[n.x, n.y, n.text, n.role, n.align, n.up, n.bold] for n in panel.notes],
    }


def on_axis(series: Series, x: Floats) -> Floats:
    """Return a series' values at other x: [n], held or interpolated, NaN outside and between points."""
    if len(series.x) == len(x) and np.array_equal(series.x, x):
        return series.y
    if not len(series.x):
        return np.full(len(x), np.nan)
    outside = (x < series.x[0]) | (x > series.x[-1])
    index = np.clip(np.searchsorted(series.x, x, side="right") - 1, 0, None)
    if series.style == "line":
        values = np.interp(x, series.x, series.y)
    else:
        values = series.y[index]
        if series.style not in ("stepped", "sampled"):
            outside |= series.x[index] != x
    return np.where(outside, np.nan, values)


def rounded(values: Iterable[float], digits: int = DIGITS) -> list[float | None]:
    """Return numbers with so many significant digits; None for those that are not finite."""
    given = np.asarray(values if isinstance(values, np.ndarray) else list(values), dtype=float)
    finite = np.isfinite(given)
    scalable = np.where(finite & (given != 0.0), given, 1.0)
    places = digits - 1 - np.floor(np.log10(np.abs(scalable))).astype(int)
    # powers of ten up to 22 are exact, so that one rounding gives the nearest decimal
    scale = 10.0 ** np.minimum(np.abs(places), 22)
    whole = np.where(places >= 0, np.round(scalable * scale), np.round(scalable / scale))
    nearest = np.where(places >= 0, whole / scale, whole * scale)
    numbers: list[float | None] = np.where(given == 0.0, 0.0, nearest).tolist()
    for i in np.flatnonzero(~finite):
        numbers[i] = None
    return numbers
