"""A figure with every kind of content."""

from __future__ import annotations

from math import inf, nan

import numpy as np

from sil.report.figure import (
    Band,
    ColourScale,
    Figure,
    Note,
    Panel,
    Rule,
    Series,
    Span,
    Stack,
    Zoom,
)


def everything() -> Figure:
    """A figure with every kind of content."""
    x = np.array([0.0, 1.0, 2.0])
    scale = ColourScale("speed, m/s", 0.0, 1.0)
    lines = [
        Series(style, x, x + k, f"series{k}", style, dashed=k == 1)  # type: ignore[arg-type]
        for k, style in enumerate(("line", "stepped", "sampled", "dots", "marked"))
    ]
    content = Panel(
        "Position", "mm", lines,
        bands=[Band(x, x - 1.0, x + 1.0, "truth")],
        spans=[
            Span(0.5, 1.0, "PUSH", "inside", 0.0, 1.0), Span(-inf, inf, "grid", "", -3.0, 3.0),
            *(Span(0.2, 0.4, "B", "", 0.0, 1.0, s) for s in ("pale", "hatched")),  # type: ignore[arg-type]
        ],
        rules=[Rule(1.0, "moment"), Rule(0.5, "level", "alarm", "y", "dashed")],
        notes=[Note(1.0, 0.5, "a note", up=4.0)],
        keys=[("driver", "B")],
    )  # fmt: skip
    cells = Panel("Map", spans=scale.cells(np.array([[0.0, nan], [0.5, 1.0]]), "{:.1f}".format),
                  ticks=[(0.0, "low"), (1.0, "high")], scale=scale)  # fmt: skip
    only = Panel("Page only", "m", lines[:1], page_only=True)
    stacks = [
        Stack("time, s", [content, only], "left", [Zoom("start", 0.0, 1.0)]),
        Stack("kind", [cells], "right", ticks=[(0.0, "first"), (1.0, "second")]),
    ]
    return Figure(stacks, "All kinds", "of content")
