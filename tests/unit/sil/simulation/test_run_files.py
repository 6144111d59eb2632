"""What a run writes besides its result: events, trace.csv, picture and page."""

from __future__ import annotations

from html.parser import HTMLParser

from can_dbc.messages import Gear
from sil.report.page import run_page
from sil.report.shell import value_text
from sil.simulation import metrics
from tests.unit.sil import made_run
from tests.unit.sil.simulation.test_results import made as made_result


class _Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "img", "source", "br"):
            self.open.append(tag)
        self.sources += [v or "" for k, v in attrs if k in ("src", "href", "srcset")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_page_is_well_formed_and_needs_no_network() -> None:
    record = made_run.made()
    shifts = metrics.shifts(record, Gear.NEUTRAL)
    figures = metrics.summary(record, shifts, None)
    result = made_result(
        metrics=figures,
        scenario={"description": "<script>alert(1)</script>"},
        bus={"bitrate": 500_000, "load": 0.3, "messages": []},
    )
    page = run_page(result, b"\x89PNG")
    tags = _Tags()
    tags.feed(page)
    assert tags.open == []
    assert tags.sources and all(s.startswith("data:image/png;base64,") for s in tags.sources)
    assert "<script>alert" not in page and "&lt;script&gt;" in page
    assert "50 ms" in page and "prefers-color-scheme: dark" in page
    assert run_page(
        made_result(complete=False, why="plant died", scenario={"description": ""}), None
    )


def test_values_as_text() -> None:
    assert value_text({"min": 1, "max": 2.5}) == "at least 1, at most 2.5"
    assert (
        value_text([]) == "none" and value_text(True) == "yes" and value_text(["B", "N"]) == "B, N"
    )
