"""Plots in the form that studies and diagnosis still use; new code uses `sil.report.figure`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sil.report import figure
from sil.report import plots as backend
from sil.report.figure import Span
from sil.report.figure import Zoom as Window
from sil.report.plots import Group

__all__ = ["Group", "Panel", "Series", "Window", "plots"]


@dataclass(frozen=True)
class Series:
    """A series over the axis of its group."""

    label: str
    values: NDArray[np.float64]
    role: str
    stepped: bool = False
    dashed: bool = False
    dotted: bool = False
    joined: bool = False


@dataclass(frozen=True)
class Panel:
    """Series over one vertical axis."""

    title: str
    unit: str
    series: Sequence[Series]
    height: int = 170
    marks: Sequence[tuple[float, str]] = ()
    band: tuple[float, float] | None = None


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
    """Return the plots of panels over one axis. Raises ValueError for a series of another length."""

    def ported(panel: Panel) -> figure.Panel:
        spans = []
        if panel.band is not None:
            spans = [Span(float("-inf"), float("inf"), "grid", "", *panel.band)]
        series = []
        for s in panel.series:
            known = np.isfinite(s.values) if s.joined and len(s.values) == len(x) else slice(None)
            style = "dots" if s.dotted else "stepped" if s.stepped else "line"
            width = 2.2 if s.role in ("truth", "measured") else 1.5
            series.append(
                figure.Series(s.label, x[known], s.values[known], s.role, style, s.dashed, width)  # type: ignore[arg-type]
            )
        return figure.Panel(
            panel.title, panel.unit, series, spans=spans, height=panel.height, ticks=panel.marks
        )

    ticks = [(float(k), name) for k, name in enumerate(names)]
    stack = figure.Stack(
        axis, [ported(p) for p in panels], title, windows, ticks, logarithmic=logarithmic
    )
    return backend.plots(figure.Figure([stack]), repeated=twin)[0]
