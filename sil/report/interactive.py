"""Interactive plots for the pages: panels over one axis, zoomed together, with no network.

Drawn in the browser by uPlot (MIT licence, beside this file); the page carries library and numbers.
Checked by: tests/unit/sil/report/test_interactive.py, tests/browser/
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sil.report.theme import Theme

MOST_POINTS = 8000
"""A longer record is thinned to this many points; the trace has them all."""

DIGITS = 6


@dataclass(frozen=True)
class Series:
    """One line: values over the panels' axis; `role` names its colour in the theme.

    dotted: points without a line. joined: the line goes on over values that are not finite.
    """

    label: str
    values: NDArray[np.float64]
    role: str
    stepped: bool = False
    dashed: bool = False
    dotted: bool = False
    joined: bool = False


@dataclass(frozen=True)
class Panel:
    """Lines that share a vertical axis of one unit."""

    title: str
    unit: str
    series: Sequence[Series]
    height: int = 170
    marks: Sequence[tuple[float, str]] = ()
    """Names at places of the vertical axis instead of numbers."""
    band: tuple[float, float] | None = None
    """Shaded from the one value to the other."""


@dataclass(frozen=True)
class Window:
    """A named piece of the axis that a button shows."""

    name: str
    low: float
    high: float


@dataclass(frozen=True)
class Group:
    """Panels that are zoomed together, as the template `plots.html` wants them.

    twin: a picture on the page shows the same, so paper does without the panels.
    """

    title: str
    numbers: str
    thinned: str
    twin: bool


def plots(
    axis: str,
    x: NDArray[np.float64],
    panels: Sequence[Panel],
    windows: Sequence[Window] = (),
    *,
    title: str = "",
    twin: bool = False,
    logarithmic: bool = False,
    names: Sequence[str] = (),
) -> Group:
    """Panels over one axis.

    `axis`: label of the common axis with its unit; `x` ascending, every series as long as `x`.
    names: what stands at each `x` instead of numbers.
    Raises ValueError for a series of another length.
    """
    for panel in panels:
        for series in panel.series:
            if len(series.values) != len(x):
                raise ValueError(f"{series.label}: {len(series.values)} values for {len(x)} points")
    stride = max(1, -(-len(x) // MOST_POINTS))
    told: dict[str, Any] = {
        "axis": axis,
        "log": logarithmic,
        "names": list(names),
        "x": rounded(x[::stride]),
        "windows": [[w.name, w.low, w.high] for w in windows],
        "panels": [
            {
                "title": panel.title,
                "unit": panel.unit,
                "height": panel.height,
                "marks": [list(mark) for mark in panel.marks],
                "band": panel.band,
                "series": [
                    {
                        "label": s.label,
                        "role": s.role,
                        "stepped": s.stepped,
                        "dashed": s.dashed,
                        "dotted": s.dotted,
                        "joined": s.joined,
                        "y": rounded(s.values[::stride]),
                    }
                    for s in panel.series
                ],
            }
            for panel in panels
        ],
    }
    text = json.dumps(told, separators=(",", ":"), ensure_ascii=True)
    return Group(
        title=title,
        # inside a script element, "<" could end it
        numbers=text.replace("<", "\\u003c"),
        thinned=f"one point in {stride}" if stride > 1 else "",
        twin=twin,
    )


def rounded(values: NDArray[np.float64]) -> list[float | None]:
    """Numbers with `DIGITS` significant digits; None for those that are not finite."""
    return [float(f"{v:.{DIGITS}g}") if np.isfinite(v) else None for v in values]


def colours(theme: Theme) -> dict[str, str]:
    """Colours of the roles in one theme."""
    return {
        "paper": theme.paper,
        "ink": theme.ink,
        "faint": theme.faint,
        "grid": theme.grid,
        "band": theme.band,
        "truth": theme.truth,
        "believed": theme.believed,
        "alarm": theme.alarm,
        "measured": theme.measured,
        "before": theme.before,
        "after": theme.after,
        **theme.chamber,
        **{f"series{k}": colour for k, colour in enumerate(theme.series)},
    }
