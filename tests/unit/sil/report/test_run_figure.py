"""The figure of a run: spans of valves and states, texts, the same lags as the metrics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from can_dbc.messages import Gear
from sil.recording.run_record import PlantEvent
from sil.report.picture import draw, save
from sil.report.run_figure import SILENT, run_figure, state_spans, valve_spans
from sil.simulation import metrics
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import load
from sil.simulation.safety import fault_lines, fault_spans
from tests.support import made_run


def test_valve_spans_are_those_of_the_events() -> None:
    record = made_run.made()
    events = [PlantEvent(0.110, "coil_B_on"), *record.events, PlantEvent(0.2005, "coil_B_off")]
    record.__dict__["events"] = sorted(events, key=lambda e: e.time_s)
    coil, blow, valve = valve_spans(record, "B")
    assert coil == [(0.110, 0.2005)]
    assert valve == [(0.118, pytest.approx(0.2355))]
    assert blow[0][0] == pytest.approx(0.17075) and len(blow) == 1
    assert valve_spans(record, "N") == ([], [], [])


def test_state_spans_merge_and_show_silence() -> None:
    times = np.array([0.0, 0.01, 0.02, 0.03, 0.2, 0.21])
    names = ["IDLE", "IDLE", "PUSH", "PUSH", "PUSH", "IDLE"]
    spans = [(round(a, 3), round(b, 3), n) for a, b, n in state_spans(times, names, 0.22)]
    assert spans == [
        (0.0, 0.02, "IDLE"),
        (0.02, 0.04, "PUSH"),
        (0.04, 0.2, SILENT),
        (0.2, 0.21, "PUSH"),
        (0.21, 0.22, "IDLE"),
    ]
    assert state_spans(np.array([]), [], 1.0) == [(0.0, 1.0, SILENT)]


def test_figure_of_a_shift() -> None:
    record = made_run.made()
    figure = run_figure(record, metrics.shifts(record, Gear.NEUTRAL), "a", "b")
    (zoom,) = figure.stacks[0].zooms
    assert zoom.low == pytest.approx(80.0) and zoom.high == pytest.approx(235.5 + 25.0)
    texts = {text.get_text() for axes in draw(figure).axes for text in axes.texts}
    assert {"backward requested", "backward confirmed", "stop: 0.64 m/s, 0.2 J"} <= texts


@pytest.mark.parametrize(
    ("time_s", "position_m", "look"),
    [(0.13, 0.001, ("right", 7.0)), (0.13, 0.012, ("right", 0.0)), (0.2, 0.012, ("left", -9.0))],
)
def test_the_hardest_impact_is_named_where_no_other_name_is(
    time_s: float, position_m: float, look: tuple[str, float]
) -> None:
    record = made_run.made()
    (shift,) = metrics.shifts(record, Gear.NEUTRAL)
    own = {"time_s": time_s, "name": "collar_1_contact", "position_m": position_m}
    impact = metrics.Impact(**own, energy_j=0.3, peak_force_n=1000.0)
    shift = replace(shift, impacts=[impact, *shift.impacts])
    panels = run_figure(record, [shift]).stacks[0].panels
    notes = {note.text: note for panel in panels for note in panel.notes}
    found = notes["collar 1 contact: 0.30 J"]
    assert (found.align, found.up) == look
    assert notes["stop: 0.64 m/s, 0.2 J"].up == 7.0


@pytest.mark.parametrize(
    ("open_s", "gap_s", "looks"),
    [
        (0.05, 0.05, [("8 ms", "left"), ("5 ms", "right")] * 2),  # in the bar
        (0.008, 0.05, [("8 ms", "right"), ("5 ms", "left")] * 2),  # beside it
        (0.008, 0.008, []),  # no room
    ],
)
def test_the_delays_of_a_valve_do_not_cover_each_other(
    open_s: float, gap_s: float, looks: list[tuple[str, str]]
) -> None:
    record, events = made_run.made(), []
    for opened in (0.110, 0.110 + open_s + gap_s):
        closed = opened + open_s
        events += [
            PlantEvent(opened - 0.008, "coil_B_on"), PlantEvent(opened, "valve_B_open"),
            PlantEvent(closed - 0.005, "coil_B_off"), PlantEvent(closed, "valve_B_close"),
        ]  # fmt: skip
    record.__dict__["events"] = sorted(events, key=lambda e: e.time_s)
    panels = run_figure(record, []).stacks[0].panels
    (panel,) = [panel for panel in panels if panel.title.startswith("Valves")]
    assert [(note.text, note.align) for note in panel.notes] == looks


def test_the_picture_shows_the_lag_of_the_metrics() -> None:
    record = made_run.made()
    shifts = metrics.shifts(record, Gear.NEUTRAL)
    lags_s = (shifts[0].position_lag_10_s, shifts[0].position_lag_90_s)
    lags = [f"{1e3 * lag_s:.0f} ms late" for lag_s in lags_s if lag_s]
    notes = [note.text for note in run_figure(record, shifts).stacks[0].panels[0].notes]
    assert lags and [text for text in notes if text.endswith("late")] == lags


def test_every_state_in_the_picture_has_its_name() -> None:
    record = made_run.made()
    (panel,) = [p for p in run_figure(record, []).stacks[0].panels if p.title == "Firmware state"]
    assert panel.spans and all(span.label == span.role.lower() for span in panel.spans)


def test_figure_of_a_run_without_a_shift(tmp_path: Path) -> None:
    figure = run_figure(made_run.made(), [])
    (zoom,) = figure.stacks[0].zooms
    assert zoom.low == 0.0 and len(draw(figure).axes) > 3
    image = save(figure, tmp_path, "run", dots_per_inch=40)
    assert image.startswith(b"\x89PNG") and len(image) > 10_000


def test_faults_and_their_detection_are_marked_in_every_panel() -> None:
    run = run_in_memory(load("frozen_counter"))
    (stack,) = run_figure(run.record, run.shifts, faults=fault_spans(run.scenario)).stacks
    for panel in stack.panels:
        (span,) = [span for span in panel.spans if span.role == "fault"]
        assert (span.start, span.end) == (pytest.approx(120.0), pytest.approx(1500.0))
        (alarm,) = [rule.at for rule in panel.rules if rule.role == "alarm"]
        assert alarm == pytest.approx(161.4, abs=0.1)
    position = stack.panels[0]
    assert position.keys == [("fault: frozen counter PositionPulse", "fault")]
    (alarm,) = [rule.text for rule in position.rules if rule.role == "alarm"]
    assert alarm == "POSITION_LOST reported"
    assert stack.zooms[0].low < 161.4 < stack.zooms[0].high
    assert fault_lines(run.record, run.scenario) == [
        "fault: frozen counter PositionPulse, from 120 ms on",
        "controller reports POSITION_LOST at 161.4 ms, 41.4 ms after the first fault began",
    ]
    quiet = run_in_memory(load("late_valve_commands"))
    assert fault_lines(quiet.record, quiet.scenario)[-1] == "the controller reported no fault"
