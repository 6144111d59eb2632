"""The figure model: what it refuses, limits, colours of a scale, spans of a switch."""

from __future__ import annotations

from math import nan

import numpy as np
import pytest

from sil.report.figure import ColourScale, Panel, Series, Stack, spans_of
from tests.support.figures import everything


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
