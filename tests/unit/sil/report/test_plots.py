"""What the pages' plots are given: numbers on one axis, nothing that could end the script."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from sil.report.figure import Figure, Panel, Series, Stack, Zoom
from sil.report.plots import MOST_POINTS, PlotGroup, on_axis, plots, rounded
from tests.support.figures import everything


def one(*series: Series, title: str = "p", zooms: list[Zoom] | None = None) -> PlotGroup:
    (group,) = plots(Figure([Stack("time, s", [Panel(title, "m", series)], zooms=zooms or [])]))
    return group


def content(group: PlotGroup) -> Any:
    return json.loads(group.numbers)


def test_numbers_are_unchanged() -> None:
    x = np.linspace(0.0, 1.0, 5)
    group = one(Series("a", x, x**2, "truth"), zooms=[Zoom("w", 0.0, 1.0)])
    numbers = content(group)
    assert numbers["x"] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert numbers["panels"][0]["series"][0]["y"] == [0.0, 0.0625, 0.25, 0.5625, 1.0]
    assert numbers["zooms"] == [["w", 0.0, 1.0]] and numbers["ends"] == [0.0, 1.0]
    assert group.thinned == ""


def test_a_label_cannot_end_the_script() -> None:
    group = one(Series("<!--", np.zeros(2), np.zeros(2), "truth"), title="</script><b>")
    assert "<" not in group.numbers
    assert content(group)["panels"][0]["title"] == "</script><b>"


def test_long_records_are_thinned_and_say_so() -> None:
    x = np.arange(3.0 * MOST_POINTS)
    group = one(Series("a", x, x, "truth"))
    assert len(content(group)["x"]) == MOST_POINTS
    assert group.thinned == "one point in 3"


def test_a_value_that_is_not_finite_is_a_gap() -> None:
    assert rounded(np.array([1.23456789, np.nan, np.inf])) == [1.23457, None, None]


def test_series_of_different_instants_share_one_axis() -> None:
    x = np.array([0.0, 1.0, 1.5, 2.0, 9.0])
    own, values = np.array([1.0, 2.0]), np.array([5.0, 6.0])
    for style, expected in (
        ("stepped", [np.nan, 5.0, 5.0, 6.0, np.nan]),
        ("line", [np.nan, 5.0, 5.5, 6.0, np.nan]),
        ("dots", [np.nan, 5.0, np.nan, 6.0, np.nan]),
    ):
        found = on_axis(Series("a", own, values, "truth", style), x)  # type: ignore[arg-type]
        np.testing.assert_array_equal(found, expected)
    empty = Series("a", np.array([]), np.array([]), "truth")
    assert np.isnan(on_axis(empty, x)).all()


def test_all_content_is_in_the_page_with_a_group_per_stack() -> None:
    left, right = (content(group) for group in plots(everything()))
    assert [panel["title"] for panel in left["panels"]] == ["Position", "Page only"]
    panel = left["panels"][0]
    counts = {
        name: len(panel[name]) for name in ("series", "bands", "spans", "rules", "notes", "keys")
    }
    assert counts == {"series": 5, "bands": 1, "spans": 6, "rules": 2, "notes": 1, "keys": 1}
    assert panel["spans"][1][:4] == [None, None, -3.0, 3.0]
    assert right["panels"][0]["scale"][:3] == ["speed, m/s", 0.0, 1.0]
    assert right["ticks"] == [[0.0, "first"], [1.0, "second"]]
