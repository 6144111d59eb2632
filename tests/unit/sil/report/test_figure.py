"""The figure model: what it refuses, limits, colours of a scale, spans of a switch."""

from __future__ import annotations

from math import inf, nan

import numpy as np
import pytest

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
    spans_of,
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
            *(Span(0.2, 0.4, "B", "", 0.0, 1.0, s) for s in ("pale", "hatched", "frame", "dashed frame")),  # type: ignore[arg-type]
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


def test_values_of_another_length_are_refused() -> None:
    with pytest.raises(ValueError, match="a: 3 values for 2 points"):
        Series("a", np.zeros(2), np.zeros(3), "truth")


def test_ends_of_an_axis() -> None:
    left, right = everything().stacks
    assert left.ends() == (0.0, 2.0)
    assert right.ends() == (-0.5, 1.5)
    assert Stack("t", []).ends() == (0.0, 1.0)
    assert Stack("t", [], limits=(3.0, 4.0)).ends() == (3.0, 4.0)


def test_heights_are_those_in_the_view() -> None:
    x = np.array([0.0, 1.0, 2.0])
    panel = Panel("p", "m", [Series("a", x, np.array([5.0, nan, 1.0]), "truth")])
    assert list(panel.heights()) == [1.0, 5.0]
    assert list(panel.heights((0.5, 2.0))) == [1.0, 1.0]
    assert list(panel.heights((0.5, 1.5))) == []


def test_a_scale_has_a_colour_for_each_value_and_a_cell_for_each_known_one() -> None:
    scale = ColourScale("m/s", 0.0, 2.0, ("#000000", "#ff0000", "#ffffff"))
    assert [scale.colour(v) for v in (-1.0, 0.0, 0.5, 1.0, 2.0, 9.0)] == [
        "#000000", "#000000", "#800000", "#ff0000", "#ffffff", "#ffffff"
    ]  # fmt: skip
    cells = scale.cells(np.array([[0.0, nan], [1.0, 2.0]]), "{:g}".format)
    assert [(c.start, c.low, c.label) for c in cells] == [
        (-0.5, -0.5, "0"), (-0.5, 0.5, "1"), (0.5, 0.5, "2")
    ]  # fmt: skip


def test_spans_of_a_switch() -> None:
    assert spans_of([0.0, 1.0, 2.0, 3.0], [True, False, True, True], 5.0) == [
        (0.0, 1.0),
        (2.0, 5.0),
    ]
    assert spans_of([], [], 1.0) == []
