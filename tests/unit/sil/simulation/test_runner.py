"""What a run writes besides its result: events, trace.csv, picture and page."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path

import pytest

from can_dbc.messages import Gear
from sil.cli import main
from sil.report.run_page import run_page
from sil.simulation import metrics
from tests.support import made_run
from tests.support.results import finished_result


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
    figures = metrics.summary(shifts, None, 2, 200)
    result = finished_result(
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
        finished_result(complete=False, why="plant died", scenario={"description": ""}), None
    )


def test_an_overloaded_bus_is_a_warning_with_its_cause_in_result_and_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = ("bus.bitrate=250000", "duration_s=0.3", "expect.min_frames=1")
    settings = [word for value in values for word in ("--set", value)]
    assert main(["run", "firmware_2500us", *settings, "--out", str(tmp_path / "out")]) == 1
    shown = capsys.readouterr()
    (warning,) = json.loads((tmp_path / "out" / "result.json").read_text())["warnings"]
    assert "the bus is 100 % loaded at 250 kbit/s" in warning
    assert "ControllerStatus are sent every 2.5 ms" in warning
    assert f"warning: {warning}\n" in shown.err
    assert "  not met: PlantMotion frames on the bus: 0, expected at least 1\n" in shown.out
    assert "the bus is 100 % loaded" in (tmp_path / "out" / "report.html").read_text()
