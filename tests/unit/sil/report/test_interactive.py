"""What the pages' plots are given: numbers, colours, windows, nothing that could end the script."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sil.report.interactive import MOST_POINTS, Panel, Series, Window, plots, rounded
from sil.report.run_plots import held


def test_numbers_go_in_as_they_are() -> None:
    x = np.linspace(0.0, 1.0, 5)
    told = plots("time, s", x, [Panel("p", "m", [Series("a", x**2, "truth")])], [Window("w", 0, 1)])
    numbers = json.loads(told.numbers)
    assert numbers["x"] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert numbers["panels"][0]["series"][0]["y"] == [0.0, 0.0625, 0.25, 0.5625, 1.0]
    assert numbers["windows"] == [["w", 0, 1]]
    assert told.thinned == ""


def test_a_label_cannot_end_the_script() -> None:
    x = np.zeros(2)
    told = plots("t", x, [Panel("</script><b>", "m", [Series("<!--", x, "truth")])])
    assert "<" not in told.numbers
    assert json.loads(told.numbers)["panels"][0]["title"] == "</script><b>"


def test_long_records_are_thinned_and_say_so() -> None:
    x = np.arange(3.0 * MOST_POINTS)
    told = plots("t", x, [Panel("p", "m", [Series("a", x, "truth")])])
    assert len(json.loads(told.numbers)["x"]) == MOST_POINTS
    assert told.thinned == "one point in 3"


def test_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="3 values for 2 points"):
        plots("t", np.zeros(2), [Panel("p", "m", [Series("a", np.zeros(3), "truth")])])


def test_what_is_not_finite_is_a_gap() -> None:
    assert rounded(np.array([1.23456789, np.nan, np.inf])) == [1.23457, None, None]


def test_held_values() -> None:
    at = np.array([0.0, 1.0, 1.5, 2.0, 9.0])
    found = held(np.array([1.0, 2.0]), np.array([5.0, 6.0]), at)
    np.testing.assert_array_equal(found, [np.nan, 5.0, 5.0, 6.0, 6.0])
    assert np.isnan(held(np.array([]), np.array([]), at)).all()
