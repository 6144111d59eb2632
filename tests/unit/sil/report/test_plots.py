"""The shell of all pages: what stands in it, what is escaped, what is left out without plots."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jinja2 import UndefinedError

import sil.report
from sil.report.figure import Figure, Panel, Series, Stack, Zoom
from sil.report.plots import MOST_POINTS, PlotGroup, on_axis, plots, rounded
from sil.report.shell import Head, Picture, render
from sil.report.theme import THEMES
from tests.support.figures import everything

TEMPLATES = sorted(Path(sil.report.__path__[0]).glob("*.html"))
PARTS = {"shell.html", "plots.html", "causes.html"}


def test_every_page_extends_the_shell_and_has_no_style_of_its_own() -> None:
    pages = [path for path in TEMPLATES if path.name not in PARTS]
    assert {"run.html", "diagnosis.html"} <= {path.name for path in pages}
    for path in pages:
        text = path.read_text(encoding="utf-8")
        assert text.startswith('{% extends "shell.html" %}'), path.name
        assert "<style" not in text and "<script" not in text, path.name


def test_names_are_escaped_and_nothing_is_asked_of_the_network() -> None:
    groups = plots(everything())
    head = Head("diagnose", "<b>x", "named", good=False, tiles=[("1", "</div>")], again="a && b")
    page = render(
        "shifts.html", head, groups, lines=[],
        pictures=[Picture(b"png", "what", "caption")],
    )  # fmt: skip
    assert "<title>&lt;b&gt;x: named</title>" in page and "<b>x" not in page
    assert "&lt;/div&gt;" in page and "a &amp;&amp; b" in page
    assert page.count("uPlot=function") == 1 and 'class="verdict bad"' in page
    assert not re.search(r"(?:src|href)=\"(?!data:)", page) and "://" not in page


def test_a_value_that_is_missing_is_an_error() -> None:
    with pytest.raises(UndefinedError):
        render("force.html", Head("diagnose", "x"))


def contrast(one: str, other: str) -> float:
    """Contrast ratio of two colours as WCAG 2 defines it."""

    def light(colour: str) -> float:
        parts = [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.03928 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    high, low = sorted((light(one), light(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("theme", THEMES.values(), ids=list(THEMES))
def test_text_and_lines_stand_out_from_the_paper(theme: dict[str, str]) -> None:
    paper = theme["paper"]
    least = {"ink": 7.0, "faint": 4.5}
    for role in [
        "ink",
        "faint",
        "truth",
        "estimate",
        "alarm",
        "measured",
        "before",
        "after",
        "B",
        "N",
        "F",
    ]:
        assert contrast(theme[role], paper) > least.get(role, 2.8), role


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
    assert np.isnan(on_axis(Series("a", np.array([]), np.array([]), "truth"), x)).all()


def test_all_content_is_in_the_page_with_a_group_per_stack() -> None:
    left, right = (content(group) for group in plots(everything()))
    assert [panel["title"] for panel in left["panels"]] == ["Position", "Page only"]
    panel = left["panels"][0]
    counts = {
        name: len(panel[name]) for name in ("series", "bands", "spans", "rules", "notes", "keys")
    }
    assert counts == {"series": 5, "bands": 1, "spans": 4, "rules": 2, "notes": 1, "keys": 1}
    assert panel["spans"][1][:4] == [None, None, -3.0, 3.0]
    assert right["panels"][0]["scale"][:3] == ["speed, m/s", 0.0, 1.0]
    assert right["ticks"] == [[0.0, "first"], [1.0, "second"]]
