"""The page and the statistics of a truck's log."""

from __future__ import annotations

from pathlib import Path

import pytest

from sil.log_replay import report
from sil.log_replay.figures import shift_figure
from sil.log_replay.truck_replay import (
    TruckReplay,
    quicker,
    replay_truck,
    statistics,
    truck_verdict,
)
from sil.logs import open_logs
from tests.support.truck_synthesis import DRIVE, Truck, write_log


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> TruckReplay:
    log = write_log(tmp_path_factory.mktemp("log") / "truck.log", Truck().frames())
    found = replay_truck(open_logs([log]), settings={"controller.shift.wait_for_sync": True})
    assert found is not None and len(found.shifts) == len(DRIVE)
    return found


def test_statistics_are_over_the_shifts(replay: TruckReplay) -> None:
    rows = {row["figure"]: row for row in statistics(replay)}
    recorded, ours, changed = rows["request to new gear"]["columns"]
    times = sorted(shift.recorded.times_s["engaged"] or 0.0 for shift in replay.shifts)
    assert recorded["shifts"] == 3 and recorded["median"] == times[1]
    assert times[1] < recorded["p95"] <= times[2]
    assert ours["median"] < recorded["median"] and ours["median"] < changed["median"]
    assert rows["impact speed"]["columns"][0] == {"shifts": 0, "median": None, "p95": None}
    for column in (0, 1):
        assert sum(quicker(replay, column)) == 3


def test_the_verdict_says_why_and_by_how_much(replay: TruckReplay) -> None:
    second = replay.shifts[1]
    first, *reasons = truck_verdict(second)
    theirs, mine = second.recorded.times_s["engaged"], second.ours[0].times_s["engaged"]
    assert theirs is not None and mine is not None
    assert first.startswith(f"{theirs - mine:.3f} s quicker: {mine:.3f} s against {theirs:.3f} s")
    assert any("our cone takes the last" in line for line in reasons)
    assert any(line.startswith("harder: ") for line in reasons)
    waiting = truck_verdict(second, 1)
    assert any(line.startswith("as soft: ") for line in waiting)


def test_the_page_has_a_picture_per_shift_up_to_a_number(
    replay: TruckReplay, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def empty(figure: object, folder: Path, name: str) -> bytes:
        (folder / f"{name}.png").touch()
        return bytes(64)

    monkeypatch.setattr(report, "save", empty)
    values = report.truck_dict(replay)
    page = report.truck_page(replay, values, "opc4 replay truck.log", tmp_path, max_pictures=2)
    assert page.count("<img") == 3
    assert "Pictures of 1 further shifts" in page
    assert {f"shift_{n}.png" for n in (1, 2, 3)} <= {path.name for path in tmp_path.iterdir()}
    assert "What-if: controller.shift.wait_for_sync=true" in page
    assert page.count("<details>") == 3 and "http" not in page.replace("http://www.w3.org", "")
    for row in values["statistics"]:
        assert row["figure"] in page


def test_the_figure_shows_both_sides(replay: TruckReplay) -> None:
    figure = shift_figure(replay, replay.shifts[1])
    panels = {panel.title: panel for panel in figure.stacks[0].panels}
    speeds = panels["Speed difference at the synchronizer"]
    assert [line.label for line in speeds.series] == ["recorded", "ours", "what-if"]
    assert [name for _, name in panels["Phases"].ticks] == ["recorded", "ours", "what-if"]
    lanes = {span.low for span in panels["Phases"].spans}
    assert len(lanes) == 3
    assert len(panels["Our stay"].series) == 2
