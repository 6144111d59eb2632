"""The shell of all pages: what stands in it, what is escaped, what is left out without plots."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from jinja2 import UndefinedError

import sil.report
from sil.report.plots import plots
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
    for role in (
        "ink",
        "faint",
        "truth",
        "estimate",
        "alarm",
        "measured",
        "before",
        "after",
        *"BNF",
    ):
        assert contrast(theme[role], paper) > least.get(role, 2.8), role
