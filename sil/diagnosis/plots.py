"""Interactive plots of a diagnosis: the strokes of its picture, each over its own time axis.

Checked by: tests/browser/
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sil.diagnosis.pictures import parts, worst
from sil.report.interactive import Group, Panel, Series, plots

if TYPE_CHECKING:
    from sil.diagnosis.diagnosis import Diagnosis

BAND = (-3.0, 3.0)
UNITS = {"position": ("mm", 1e3), "pressure": ("bar", 1e-5), "oil": ("bar", 1e-5)}


def stroke_plots(result: Diagnosis) -> list[Group]:
    """A group of plots for each stroke drawn: channels, then residuals over their scatter."""
    return [_stroke(result, k) for k in worst(result)]


def _stroke(result: Diagnosis, k: int) -> Group:
    stroke = result.model.strokes[k]
    before, after = parts(result, result.healthy, k), parts(result, result.final, k)
    changed = result.final is not result.healthy
    models = (
        ("healthy model", before, "before", False),
        ("model that stands", after, "after", True),
    )
    panels, left = [], []
    for channel in stroke.channels:
        unit, scale = UNITS[channel.kind]

        def over(
            values: NDArray[np.float64], rows: NDArray[np.intp] = channel.rows
        ) -> NDArray[np.float64]:
            whole = np.full(len(stroke.time_s), np.nan)
            whole[rows] = values
            return whole

        told = models if changed else models[:1]
        lines = [Series("measured", scale * over(channel.measured), "measured", joined=True)]
        lines += [
            Series(name, scale * over(found[channel.name][0]), role, dashed=dashed, joined=True)
            for name, found, role, dashed in told
        ]
        title = channel.name.removesuffix("_m").removesuffix("_pa").replace("_", " ")
        panels.append(Panel(title, unit, lines, height=150))
        residuals = [
            Series(name, over(found[channel.name][1]), role, joined=True)
            for name, found, role, _dashed in told
        ]
        left.append(Panel(f"{title}: residual over its scatter", "sd", residuals, 110, band=BAND))
    both = [panel for pair in zip(panels, left, strict=True) for panel in pair]
    title = f"{stroke.entry.label} ({stroke.entry.file})"
    return plots("time, ms", 1e3 * stroke.time_s, both, title=title, twin=True)
