"""What a run writes besides its result: events, trace.csv, picture and page."""

from __future__ import annotations

import csv
import math
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from can_dbc.messages import Gear
from sil.recording.events import EventLog, read_events
from sil.recording.run_record import PlantEvent
from sil.recording.trace_csv import held, write_trace_csv
from sil.report.page import run_page
from sil.report.shell import told
from sil.simulation import metrics
from tests.unit.sil import made_run
from tests.unit.sil.simulation.test_results import made as made_result


def test_events_come_back_and_a_torn_last_line_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    log = EventLog(path)
    log(0.5, "stay_stop", {"speed_m_s": 0.1 + 0.2})
    log(0.6, "valve_B_open", {})
    log.close()
    wanted = [
        PlantEvent(0.5, "stay_stop", {"speed_m_s": 0.1 + 0.2}),
        PlantEvent(0.6, "valve_B_open"),
    ]
    assert read_events(path) == wanted
    path.write_bytes(path.read_bytes() + b'{"time_s": 0.7, "na')
    assert read_events(path) == wanted
    path.write_bytes(b'{"time_s": 0.7}\n')
    with pytest.raises(InputError, match="line 1: not an event"):
        read_events(path)


def test_held_values() -> None:
    at = np.array([0.0, 1.0, 1.5, 2.0, 3.0])
    values = held(np.array([1.0, 2.0]), np.array([10.0, 20.0]), at)
    assert math.isnan(values[0]) and values[1:].tolist() == [10.0, 10.0, 20.0, 20.0]


def test_trace_csv_begins_like_a_measured_stroke_and_keeps_every_bit(tmp_path: Path) -> None:
    record = made_run.made()
    truth = record.truth
    write_trace_csv(record, tmp_path / "trace.csv")
    with (tmp_path / "trace.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:9] == [
        "time_s",
        "position_m",
        "pressure_B_pa",
        "pressure_N_pa",
        "pressure_F_pa",
        "cmd_B",
        "cmd_N",
        "cmd_F",
        "position_internal_m",
    ]
    assert [float(r["position_m"]) for r in rows] == truth["position_m"].tolist()
    assert rows[0]["position_internal_m"] == ""  # before the first status frame
    assert float(rows[-1]["position_internal_m"]) == pytest.approx(made_run.STROKE, abs=1e-7)


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
    assert "<script>" not in page and "&lt;script&gt;" in page
    assert "50 ms" in page and "prefers-color-scheme: dark" in page
    assert run_page(
        made_result(complete=False, why="plant died", scenario={"description": ""}), None
    )


def test_told() -> None:
    assert told({"min": 1, "max": 2.5}) == "at least 1, at most 2.5"
    assert told([]) == "none" and told(True) == "yes" and told(["B", "N"]) == "B, N"
